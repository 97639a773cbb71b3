"use strict";
// One trial after another. What the operator pressed is sent until a server answers, also one that was
// started anew; what the page shows is what the server says of recorder and run.

const state = document.getElementById("state");
const told = document.getElementById("told");
const PENDING = "console pending";
let key = "";
let correct = "";
let busy = false;
let startedAt = null;

function tell(text, trouble = false) {
  told.textContent = text;
  told.classList.toggle("trouble", trouble);
}

const pause = (ms) => new Promise((done) => { setTimeout(done, ms); });

async function ask(address, record) {
  const options = record && {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(record),
  };
  const answer = await fetch(address, options || {});
  return { status: answer.status, ...(await answer.json().catch(() => ({ message: answer.statusText }))) };
}

// The form for a code.
const enter = document.getElementById("enter");
enter?.addEventListener("submit", async (event) => {
  event.preventDefault();
  const { name, code } = enter.elements;
  try {
    const reply = await ask("/console/enter", { name: name.value, code: code.value });
    if (reply.status === 200) location.reload();
    else { tell(reply.message, true); code.select(); }
  } catch {
    tell("The server does not answer.", true);
  }
});

function show(reply) {
  if (reply.kind === "recording" && Number.isFinite(reply.elapsed_s)) startedAt = performance.now() - 1000 * reply.elapsed_s;
  if (reply.html === undefined || reply.key === key) return;
  key = reply.key;
  state.innerHTML = reply.html;
  const form = document.getElementById("answer");
  form?.addEventListener("change", () => choose(form));
  form?.addEventListener("submit", (event) => { event.preventDefault(); answer(form); });
  for (const button of state.querySelectorAll("[data-do]")) button.addEventListener("click", () => press(button));
  drawClock();
}

function choose(form) {
  const failed = form.elements.result.value === "failure";
  form.querySelector("[data-for]").hidden = !failed;
  for (const name of ["reached", "cause"]) if (form.elements[name]) form.elements[name].required = failed;
}

function answer(form) {
  const { result, reached, placed, cause, note } = form.elements;
  send({
    do: "answer",
    trial: form.dataset.trial,
    seen: form.dataset.seen,
    result: result.value,
    reached: Number(reached?.value || 0),
    placed: Number(placed?.value || 0),
    cause: result.value === "failure" ? cause.value : "",
    note: note.value,
  });
}

function press(button) {
  const { do: what, trial } = button.dataset;
  if (what === "correct" || what === "keep") {
    correct = what === "correct" ? trial : "";
    look();
  } else {
    send({ do: what, trial });
  }
}

// Send until somebody answers: a press is never lost because the server was away.
async function send(record) {
  if (busy) return;
  busy = true;
  sessionStorage.setItem(PENDING, JSON.stringify(record));
  tell({ start: "Starting …", stop: "Stopping …", answer: "Saving …" }[record.do] || "");
  for (;;) {
    try {
      const reply = await ask("/console/act", record);
      if (reply.status === 401) { location.reload(); return; }
      sessionStorage.removeItem(PENDING);
      busy = false;
      if (reply.status === 200) { correct = ""; tell({ answer: "Saved." }[record.do] || ""); } else tell(reply.message, true);
      key = reply.html === undefined ? key : "";
      show(reply);
      return;
    } catch {
      tell("NOT DONE YET: the server does not answer. Leave this page open; it tries again.", true);
      await pause(700);
    }
  }
}

async function look() {
  if (busy) return;
  try {
    const reply = await ask("/console/state" + (correct ? "?correct=" + encodeURIComponent(correct) : ""));
    if (busy) return;
    if (reply.status === 401) { location.reload(); return; }
    if (told.dataset.away) { tell(""); delete told.dataset.away; }
    show(reply);
  } catch {
    tell("The server does not answer. The recorder goes on without it.", true);
    told.dataset.away = "yes";
  }
}

function drawClock() {
  const clock = document.getElementById("clock");
  if (!clock || startedAt === null) return;
  const seconds = Math.max(0, (performance.now() - startedAt) / 1000);
  clock.textContent = Math.floor(seconds / 60) + ":" + String(Math.floor(seconds % 60)).padStart(2, "0");
}

function drawNow() {
  const now = state.querySelector("[data-now]");
  if (!now || document.hidden) return;
  const next = new Image();
  next.onload = () => {
    now.src = next.src;
    now.hidden = false;
    const over = state.querySelector(".over");
    if (over) { over.hidden = false; now.style.opacity = document.getElementById("over").value / 100; }
  };
  next.src = now.dataset.now + "?" + Date.now();
}

if (state) {
  const pending = JSON.parse(sessionStorage.getItem(PENDING) || "null");
  if (pending) send(pending); // pressed before the server, or this page, went away
  (async () => {
    for (;;) {
      await look();
      drawNow();
      await pause(1000);
    }
  })();
  setInterval(drawClock, 250);
  state.addEventListener("input", (event) => {
    if (event.target.id === "over") state.querySelector(".now").style.opacity = event.target.value / 100;
  });
}
