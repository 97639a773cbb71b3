"use strict";
// Sliders, questions to the server, and the strip of what came out.
const whatIf = document.querySelector(".what-if");
const whatIfForm = whatIf.querySelector("form");
const sliders = [...whatIfForm.querySelectorAll("input[type=range]")];
const said = whatIfForm.querySelector(".said");

// Factors go in equal ratios from one end to the other, all else in equal steps.
function sliderValue(slider) {
  const { low, high, factor } = slider.dataset;
  const share = slider.value / 1000;
  const value = factor === "true" ? low * (high / low) ** share : Number(low) + share * (high - low);
  return Number(value.toPrecision(3));
}
function setSlider(slider, value) {
  const { low, high, factor } = slider.dataset;
  slider.value = 1000 * (factor === "true"
    ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low));
  tell(slider);
}
function text(slider, value) {
  const { unit } = slider.dataset;
  if (unit === "x") return `× ${value.toPrecision(2)}`;
  if (unit === "m") return `${value > 0 ? "+" : ""}${Number((1000 * value).toFixed(1))} mm`.replace("-", "\u2212");
  return `${value > 0 ? "+" : ""}${value.toFixed(2)} ${unit}`.replace("-", "\u2212");
}
function tell(slider) {
  whatIfForm.querySelector(`output[for="${slider.id}"]`).textContent = text(slider, sliderValue(slider));
}
const sliderOf = (name) => sliders.find((slider) => slider.name === name);

function change() {
  const found = { object: whatIfForm.elements.object?.value ?? "" };
  for (const slider of sliders) found[slider.name] = sliderValue(slider);
  return found;
}

async function post(address, body) {
  const answer = await fetch(address, { method: "POST", headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body) });
  const found = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new Error(found.message || `the server answered ${answer.status}`);
}

async function askIf(sweep) {
  try {
    await post(whatIf.dataset.source, { plan: whatIf.dataset.plan, change: change(), sweep });
    await follow();
  } catch (error) {
    said.textContent = error.message;
  }
}

function element(tag, className, content) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (content !== undefined) made.textContent = content;
  return made;
}

function outcomeOf({ accepted }) {
  if (accepted === true) return ["good", "✓", "success"];
  if (accepted === false) return ["bad", "✗", "failure"];
  return ["unknown", "?", "undecided"];
}

// What was set besides the quantity that goes through its values.
function others(answer) {
  return sliders.filter((slider) => slider.name !== answer.sweep)
    .filter((slider) => Math.abs(answer.change[slider.name] - slider.dataset.nominal) > 1e-9)
    .map((slider) => `${whatIfForm.querySelector(`label[for="${slider.id}"]`).textContent} ${text(slider, answer.change[slider.name])}`)
    .concat(answer.change.object ? [`of ${answer.change.object}`] : []).join(", ");
}

function shown(answer) {
  const item = element("li");
  const slider = sliderOf(answer.sweep);
  const title = slider ? whatIfForm.querySelector(`label[for="${slider.id}"]`).textContent : "As set";
  const head = element("p", "", "");
  head.append(element("strong", "", title));
  const set = others(answer);
  if (set) head.append(element("span", "quiet", ` ${set}`));
  if (answer.state === "running") {
    head.append(element("span", "quiet", ` ${answer.outcomes.length} of ${answer.total} replays`));
  }
  item.append(head);
  const strip = element("ul", "strip-of");
  for (const outcome of answer.outcomes) {
    const [tone, sign, word] = outcomeOf(outcome);
    const cell = element("li", tone);
    if (slider) cell.append(element("span", "value", text(slider, outcome.value)));
    cell.append(element("span", "sign", `${sign} ${word}`));
    cell.title = [outcome.why, outcome.file].filter(Boolean).join("\n");
    strip.append(cell);
  }
  item.append(strip);
  const last = answer.outcomes.filter((outcome) => outcome.why && outcome.accepted !== true)[0];
  if (answer.flip) {
    item.append(element("p", "", `Smallest change found that flips the verdict to ${answer.flip.accepted ? "success" : "failure"}: ${text(slider, answer.flip.value)} (${text(slider, answer.flip.kept)} does not).`));
  } else if (slider && answer.state === "done") {
    item.append(element("p", "", "No value that was tried flips the verdict."));
  }
  if (last) item.append(element("p", "quiet small", last.why));
  if (answer.message) item.append(element("p", "small", answer.message));
  return item;
}

let following = false;
async function follow() {
  if (following) return;
  following = true;
  for (;;) {
    const found = await (await fetch(whatIf.dataset.source)).json();
    const running = found.current && found.current.state === "running";
    const unkept = found.current && found.current.state !== "done" && !running ? [found.current] : [];
    const answers = running ? [found.current, ...found.answers] : [...unkept.filter((a) => !a.outcomes.length), ...found.answers];
    whatIf.querySelector(".answers").replaceChildren(...answers.map(shown));
    whatIf.dataset.state = found.busy ? "busy" : "idle";
    for (const button of whatIfForm.querySelectorAll("button:not(.nominal):not(.cancel)")) button.disabled = found.busy;
    whatIfForm.querySelector(".cancel").hidden = !running;
    said.textContent = found.busy && !running ? "A job on another trial is running." : "";
    if (!found.busy) break;
    await new Promise((done) => { setTimeout(done, 400); });
  }
  following = false;
}

whatIfForm.hidden = false;
whatIfForm.addEventListener("submit", (event) => event.preventDefault());
for (const slider of sliders) {
  setSlider(slider, Number(slider.dataset.nominal));
  slider.addEventListener("input", () => tell(slider));
}
for (const button of whatIfForm.querySelectorAll("[data-sweep]")) {
  button.addEventListener("click", () => askIf(button.dataset.sweep));
}
whatIfForm.querySelector(".as-set").addEventListener("click", () => askIf(""));
whatIfForm.querySelector(".nominal").addEventListener("click", () => {
  for (const slider of sliders) setSlider(slider, Number(slider.dataset.nominal));
});
whatIfForm.querySelector(".cancel").addEventListener("click", () => post(whatIf.dataset.cancel, {}));
follow();
