// A picture of a trial becomes its short clip while it is pointed at, focused, or while all play.

const shots = [...document.querySelectorAll("[data-clip]")];
const all = document.getElementById("play-all");

function start(shot) {
  if (shot.querySelector("video")) return;
  const image = shot.querySelector("img");
  const video = document.createElement("video");
  Object.assign(video, { muted: true, loop: true, playsInline: true, src: shot.dataset.clip });
  video.setAttribute("aria-label", image.alt);
  video.addEventListener("playing", () => { image.hidden = true; video.hidden = false; }, { once: true });
  video.addEventListener("error", () => { video.remove(); image.hidden = false; });
  video.hidden = true;
  shot.append(video);
  video.play().catch(() => {});
}

function stop(shot) {
  const video = shot.querySelector("video");
  if (!video || all?.getAttribute("aria-pressed") === "true") return;
  video.pause();
  video.remove();
  shot.querySelector("img").hidden = false;
}

// Someone who asked for less motion presses the button; nothing plays by itself.
const still = matchMedia("(prefers-reduced-motion: reduce)");
for (const shot of shots) {
  for (const event of ["mouseenter", "focus"]) {
    shot.addEventListener(event, () => { if (!still.matches) start(shot); });
  }
  for (const event of ["mouseleave", "blur"]) shot.addEventListener(event, () => stop(shot));
}

if (all && shots.length) {
  all.hidden = false;
  all.addEventListener("click", () => {
    const on = all.getAttribute("aria-pressed") !== "true";
    all.setAttribute("aria-pressed", String(on));
    all.textContent = on ? "Stop all" : "Play all";
    shots.forEach(on ? start : stop);
  });
}
