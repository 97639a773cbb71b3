"use strict";
// Two methods of one view on top of each other; keys choose which. All else is in the address.

const figure = document.querySelector(".wipe");
if (figure) {
  const slider = document.getElementById("wipe");
  const mode = document.getElementById("wipe-mode");
  const form = document.querySelector(".filters");
  let blinking = 0;

  const place = () => figure.style.setProperty("--share", `${slider.value}%`);
  const choose = () => {
    figure.dataset.mode = mode.value;
    slider.hidden = !["wipe", "overlay"].includes(mode.value);
    clearInterval(blinking);
    figure.classList.remove("off");
    if (mode.value === "blink") blinking = setInterval(() => figure.classList.toggle("off"), 500);
  };
  const put = (side, method) => {
    const select = form.elements[side];
    if (method === undefined || select.value === method) return;
    select.value = method;
    form.requestSubmit();
  };

  figure.hidden = false;
  document.querySelector(".keys").hidden = false;
  slider.addEventListener("input", place);
  mode.addEventListener("change", choose);
  figure.querySelector(".difference").addEventListener("pointermove", (event) => {
    if (event.pointerType === "touch" || !["wipe", "overlay"].includes(mode.value)) return;
    const box = event.currentTarget.getBoundingClientRect();
    slider.value = Math.round((100 * (event.clientX - box.left)) / box.width);
    place();
  });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    if (event.target.matches("select, textarea, input:not([type=range])")) return;
    const digit = /^(?:Digit|Numpad)([0-9])$/.exec(event.code) || /^([0-9])$/.exec(event.key);
    const methods = [...form.elements.right.options].map((option) => option.value);
    if (digit) put(event.shiftKey ? "left" : "right", methods[Number(digit[1])]);
    else if (event.key === "v") {
      mode.selectedIndex = (mode.selectedIndex + 1) % mode.options.length;
      choose();
    } else if (event.key.startsWith("Arrow") && event.target !== slider) {
      const step = { ArrowLeft: -5, ArrowRight: 5 }[event.key];
      if (!step) return;
      slider.value = Number(slider.value) + step;
      place();
    } else return;
    event.preventDefault();
  });
  place();
  choose();
}
