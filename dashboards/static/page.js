"use strict";
// One time for the whole page: slider, cursors in every plot, and the address. Whatever else shows
// an instant listens to "page-time".

const clock = document.getElementById("clock");
const charts = [...document.querySelectorAll("svg.timed")].map((svg) => ({
  svg,
  cursor: svg.querySelector(".cursor"),
  series: [...svg.querySelectorAll(".series")].map(readSeries),
  outputs: svg.closest("figure") ? [...svg.closest("figure").querySelectorAll("output[data-value]")] : [],
}));

function readSeries(group) {
  return [...group.querySelectorAll("polyline")].map((line) =>
    line.getAttribute("points").split(" ").map((pair) => pair.split(",").map(Number)));
}

// The drawn height of a line at a pixel column, or null in a gap.
function heightAt(pieces, x) {
  for (const points of pieces) {
    if (x < points[0][0] || x > points[points.length - 1][0]) continue;
    let low = 0;
    let high = points.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (points[middle][0] <= x) low = middle; else high = middle;
    }
    const [x0, y0] = points[low];
    const [x1, y1] = points[high];
    return x1 === x0 ? y0 : y0 + ((x - x0) / (x1 - x0)) * (y1 - y0);
  }
  return null;
}

function showCharts(t) {
  const share = t / Number(clock.max);
  for (const { svg, cursor, series, outputs } of charts) {
    const x0 = Number(svg.dataset.x0);
    const x = x0 + share * (Number(svg.dataset.x1) - x0);
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
    for (const output of outputs) {
      const y = heightAt(series[Number(output.dataset.value)], x);
      output.textContent = y === null ? "" : valueOf(svg, y);
    }
  }
}

function valueOf(svg, y) {
  const { y0, y1, yLow, yHigh } = svg.dataset;
  const value = Number(yLow) + ((y - y0) / (y1 - y0)) * (yHigh - yLow);
  const span = Math.abs(yHigh - yLow);
  return value.toFixed(span < 0.5 ? 3 : span < 5 ? 2 : 1).replace("-", "\u2212");
}

let addressTimer = 0;
function keepInAddress(t) {
  clearTimeout(addressTimer);
  addressTimer = setTimeout(() => {
    const address = new URL(location.href);
    address.searchParams.set("t", t.toFixed(2));
    history.replaceState(null, "", address);
  }, 200);
}

function setTime(t, { remember = true } = {}) {
  const bounded = Math.min(Math.max(t, 0), Number(clock.max));
  clock.value = bounded;
  document.getElementById("clock-text").textContent = bounded.toFixed(2) + " s";
  showCharts(bounded);
  document.dispatchEvent(new CustomEvent("page-time", { detail: bounded }));
  if (remember) keepInAddress(bounded);
}

function timeAt(svg, event) {
  const box = svg.getBoundingClientRect();
  const x = ((event.clientX - box.left) / box.width) * svg.viewBox.baseVal.width;
  const x0 = Number(svg.dataset.x0);
  return ((x - x0) / (Number(svg.dataset.x1) - x0)) * Number(clock.max);
}

let playing = false;
function play(on) {
  playing = on;
  const button = document.getElementById("play");
  button.textContent = on ? "Pause" : "Play";
  button.setAttribute("aria-pressed", String(on));
  if (!on) return;
  if (Number(clock.value) >= Number(clock.max) - 0.02) setTime(0);
  let last = performance.now();
  const step = (now) => {
    if (!playing) return;
    const t = Number(clock.value) + (now - last) / 1000;
    last = now;
    setTime(t, { remember: false });
    if (t >= Number(clock.max)) { play(false); keepInAddress(t); } else requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
}

if (clock) {
  clock.step = "any";
  document.getElementById("go").hidden = true;
  document.getElementById("play").hidden = false;
  document.getElementById("play").addEventListener("click", () => {
    play(!playing);
    if (!playing) keepInAddress(Number(clock.value));
  });
  clock.addEventListener("input", () => { playing = false; play(false); setTime(Number(clock.value)); });
  clock.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: -0.1, ArrowRight: 0.1, PageDown: -1, PageUp: 1 };
    if (event.key in steps) {
      event.preventDefault();
      setTime(Number(clock.value) + steps[event.key]);
    }
  });
  clock.form.addEventListener("submit", (event) => event.preventDefault());
  for (const button of document.querySelectorAll("[data-jump]")) {
    button.hidden = false;
    button.addEventListener("click", () => { play(false); setTime(Number(button.dataset.jump)); });
  }
  for (const { svg } of charts) {
    svg.addEventListener("click", (event) => setTime(timeAt(svg, event)));
  }
  showCharts(Number(clock.value));
}

// Keys of the player, wherever the focus is.
function playerKey(event) {
  const onControl = event.target.matches("button, a, summary");
  if (event.key === " " && !onControl && !event.repeat) document.getElementById("play").click();
  else if (event.key === "ArrowLeft") setTime(Number(clock.value) - 0.1);
  else if (event.key === "ArrowRight") setTime(Number(clock.value) + 0.1);
  else if (event.key === "c") document.getElementById("camera")?.click();
  else if (event.key === "v") document.getElementById("mode")?.dispatchEvent(new Event("next"));
  else if (event.key === "j") document.querySelector(".joints > summary")?.click();
  else if (event.key === "d") document.getElementById("divergence")?.click();
  else return;
  event.preventDefault();
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
  if (event.target.matches("input:not([type=range]), select, textarea")) return;
  if (clock) playerKey(event);
  const relation = { "[": "prev", "]": "next" }[event.key];
  const link = relation && document.querySelector(`a[rel="${relation}"]`);
  if (link) link.click();
});

for (const button of document.querySelectorAll("[data-copy]")) {
  if (!navigator.clipboard) continue;
  button.hidden = false;
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(button.dataset.copy);
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  });
}

// A page whose numbers are being recomputed is loaded again once they are there, unless somebody works in it.
async function awaitNumbers() {
  const page = await fetch(location.href).then((answer) => answer.text()).catch(() => 'id="recomputed"');
  if (page.includes('id="recomputed"')) setTimeout(awaitNumbers, 2000); else location.reload();
}
if (document.getElementById("recomputed") && !document.querySelector("form.scrub")) setTimeout(awaitNumbers, 2000);

// A choice in the filters is taken at once; without a script the button does it.
for (const choice of document.querySelectorAll(".filters select")) {
  choice.addEventListener("change", () => choice.form.requestSubmit());
}
