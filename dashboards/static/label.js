"use strict";
// One trial, one answer. An answer counts as saved only when the server says it is on disk.

const form = document.getElementById("label");
const note = document.getElementById("note");
const told = document.getElementById("said");
const WORDS = { success: "✓ success", failure: "✗ failure", unknown: "? cannot tell", unrated: "no answer yet" };
const NO_LABEL = { result: "", cause: "", flag: false, note: "" };
const undoKey = "undo " + form.dataset.action;
const pendingKey = "pending " + form.dataset.action;
let busy = false;

const read = (key, otherwise) => JSON.parse(sessionStorage.getItem(key) || otherwise);
const keep = (key, value) => sessionStorage.setItem(key, JSON.stringify(value));

function saved() {
  const { result, cause, flag } = form.dataset;
  return result ? { result, cause, note: note.defaultValue, flag: flag === "yes" } : null;
}

function tell(text, trouble = false) {
  told.textContent = text;
  form.classList.toggle("trouble", trouble);
}

function describe() {
  const now = saved();
  if (!now) return "not labelled yet";
  return "saved: " + WORDS[now.result] + (now.cause ? ", " + now.cause : "") + (now.flag ? ", flagged" : "");
}

function draw() {
  const now = saved();
  for (const button of form.querySelectorAll("[data-answer], [data-because]")) {
    const { answer, because } = button.dataset;
    const isOn = now && (answer ? now.result === answer : now.cause === because);
    button.setAttribute("aria-pressed", String(Boolean(isOn)));
  }
  form.querySelector("[data-do=flag]").setAttribute("aria-pressed", String(Boolean(now) && now.flag));
}

function take(reply) {
  const { result, cause, flag, note: text } = reply.saved || NO_LABEL;
  Object.assign(form.dataset, { seen: reply.version, result, cause, flag: flag ? "yes" : "" });
  note.defaultValue = text;
  draw();
}

// Ask until the server answers: a label is never dropped because the server was away.
async function post(label) {
  busy = true;
  keep(pendingKey, label);
  for (;;) {
    try {
      const answer = await fetch(form.dataset.action, {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify(label),
      });
      const text = await answer.text();
      busy = false;
      sessionStorage.removeItem(pendingKey);
      try {
        return { status: answer.status, ...JSON.parse(text) };
      } catch {
        return { status: answer.status, message: text };
      }
    } catch {
      tell("NOT SAVED YET: the server does not answer. Leave this page open; it tries again.", true);
      await new Promise((done) => { setTimeout(done, 500); });
    }
  }
}

// Save what is said of this trial. Returns whether it is on disk.
async function save(change, { onward = false, words = "" } = {}) {
  if (busy) return false;
  const before = saved();
  const label = {
    trial_id: form.dataset.trial,
    seen: form.dataset.seen,
    ...(before || { result: "unrated", cause: "", flag: false }),
    note: note.value,
    ...change,
  };
  tell("saving …");
  const reply = await post(label);
  if (reply.status === 409) {
    const typed = note.value === note.defaultValue ? null : note.value;
    take(reply);
    note.value = typed ?? note.defaultValue; // the other tab's note stays, unless one was typed here
    tell("NOT SAVED. " + reply.message + " Now " + describe() + ".", true);
    return false;
  }
  if (reply.status !== 200) {
    tell("NOT SAVED: " + reply.message, true);
    return false;
  }
  const undo = read(undoKey, "[]");
  undo.push({ trial: label.trial_id, before, seen: reply.version });
  keep(undoKey, undo.slice(-500));
  take(reply);
  tell(words || describe());
  if (onward) go(reply.next);
  return true;
}

function go(trial) {
  busy = true; // no key belongs to the page that is left
  const address = new URL(form.dataset.action, location.href);
  if (trial) address.searchParams.set("at", trial);
  location.assign(address);
}

async function undo() {
  const stack = read(undoKey, "[]");
  const last = stack.pop();
  if (busy) return;
  if (!last) { tell("nothing to undo in this tab; " + describe()); return; }
  const label = { trial_id: last.trial, seen: last.seen, ...(last.before || { result: null }) };
  const reply = await post(label);
  if (reply.status !== 200) {
    tell("NOT UNDONE: " + reply.message, true);
    if (reply.status === 409) keep(undoKey, stack);
    return;
  }
  const previous = stack[stack.length - 1];
  if (previous && previous.trial === last.trial) previous.seen = reply.version;
  keep(undoKey, stack);
  go(last.trial);
}

const answers = {
  success: () => save({ result: "success", cause: "" }, { onward: true }),
  unknown: () => save({ result: "unknown", cause: "" }, { onward: true }),
  failure: () => save({ result: "failure" }, { words: "saved: ✗ failure. Why? 1 to 9, or Enter for the next trial." }),
};
const because = (cause) => save({ result: "failure", cause }, { onward: true });
const flag = () => save({ flag: form.dataset.flag !== "yes" });
const toNote = () => note.focus();
const follow = (id) => document.getElementById(id)?.click();

const KEYS = {
  y: answers.success, n: answers.failure, u: answers.unknown, f: flag, z: undo, m: toNote,
  s: () => follow("after"), b: () => follow("before"), Enter: () => go(null),
};

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target === note) {
    if (event.key === "Escape") note.blur();
    return;
  }
  if (event.target.matches("button, a") && event.key === "Enter") return;
  const causes = form.querySelectorAll("[data-because]");
  const cause = /^[1-9]$/.test(event.key) && causes[Number(event.key) - 1];
  const action = cause ? () => because(cause.dataset.because) : KEYS[event.key];
  if (!action) return;
  event.preventDefault();
  if (!event.repeat) action(); // a key that is held down answers once
});

for (const button of form.querySelectorAll("[data-answer]")) button.addEventListener("click", answers[button.dataset.answer]);
for (const button of form.querySelectorAll("[data-because]")) button.addEventListener("click", () => because(button.dataset.because));
form.querySelector("[data-do=flag]").addEventListener("click", flag);
form.querySelector("[data-do=undo]").addEventListener("click", undo);
form.addEventListener("submit", (event) => event.preventDefault());
note.addEventListener("change", () => { if (note.value !== note.defaultValue) save({}); });
window.addEventListener("beforeunload", (event) => { if (sessionStorage.getItem(pendingKey)) event.preventDefault(); });

draw();
tell(describe());

// A label that was on its way when the page was left is sent again.
const pending = read(pendingKey, "null");
if (pending) {
  post(pending).then((reply) => {
    if (pending.trial_id === form.dataset.trial && reply.version !== undefined) take(reply);
    tell(reply.status === 200 ? describe() : "NOT SAVED: " + pending.trial_id + ": " + reply.message, reply.status !== 200);
  });
}
