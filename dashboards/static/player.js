"use strict";
// Pictures of the cameras at the page's time. All pictures of one camera change together, so that
// recorded and twin are never of two instants. Once a camera's pictures are here, none is asked for
// one by one.

const SAME_INSTANT_S = 0.02; // a comparison means something only where both are of one instant
const BLINK_MS = 500;
const frames = [...document.querySelectorAll("img.frame")].map((img) => ({
  img,
  canvas: null,
  times: img.dataset.times.split(" ").map(Number),
  // What names a frame in its address: its time, or the stamp of a picture of the twin.
  stamps: img.dataset.stamps ? img.dataset.stamps.split(" ") : null,
  label: img.closest("figure").querySelector(".frame-time"),
  shown: null,
  wanted: null,
}));
const groups = [...new Set(frames.map(placeOf))].map((element) => (
  { element, members: frames.filter((frame) => placeOf(frame) === element), loading: false }));
const packs = new Map(); // address of a camera's pictures -> their files by index
const decoded = new Map(); // and as bitmaps, as far as memory allows: these are drawn at once
let pixelsLeft = 24e6; // 96 MB of bitmaps

function placeOf({ img }) {
  return img.closest(".camera") || img.closest("figure");
}

function nearest(times, t) {
  let best = 0;
  for (let index = 1; index < times.length; index += 1) {
    if (Math.abs(times[index] - t) < Math.abs(times[best] - t)) best = index;
  }
  return best;
}

async function blobOf(frame, index) {
  const packed = packs.get(frame.img.dataset.pack)?.get(index);
  if (packed) return packed;
  const source = frame.img.dataset.source;
  const name = frame.stamps ? "stamp=" + frame.stamps[index] : "t=" + frame.times[index];
  const answer = await fetch(source + (source.includes("?") ? "&" : "?") + name);
  if (!answer.ok) throw new Error(`no picture: ${answer.status}`);
  return answer.blob();
}

function draw(frame, bitmap) {
  if (!frame.canvas) {
    frame.canvas = document.createElement("canvas");
    frame.canvas.className = "frame";
    if (frame.img.alt) {
      frame.canvas.setAttribute("role", "img");
      frame.canvas.setAttribute("aria-label", frame.img.alt);
    }
    frame.img.replaceWith(frame.canvas);
  }
  const { canvas } = frame;
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
  }
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
}

// One instant at a time, always the newest that is wanted.
async function showGroup(group) {
  if (group.loading || group.element.closest("[hidden]")) return;
  group.loading = true;
  const differs = () => group.members.some((frame) => frame.wanted !== frame.shown);
  while (differs()) {
    const wanted = group.members.map((frame) => frame.wanted);
    try {
      const ready = group.members.map((frame, at) => decoded.get(frame.img.dataset.pack)?.get(wanted[at]));
      const bitmaps = ready.every(Boolean) ? ready : await Promise.all(group.members.map(
        async (frame, at) => ready[at] || createImageBitmap(await blobOf(frame, wanted[at]))));
      group.members.forEach((frame, at) => draw(frame, bitmaps[at]));
      bitmaps.forEach((bitmap, at) => { if (!ready[at]) bitmap.close(); });
    } catch {
      // A picture that cannot be read leaves the one before; the time says which that is.
      group.members.forEach((frame, at) => { frame.shown = wanted[at]; });
      continue;
    }
    group.members.forEach((frame, at) => {
      frame.shown = wanted[at];
      if (frame.label) frame.label.textContent = frame.times[wanted[at]].toFixed(2);
    });
  }
  group.loading = false;
}

function showPictures(t) {
  for (const frame of frames) frame.wanted = nearest(frame.times, t);
  for (const figure of document.querySelectorAll(".beside")) {
    const [recorded, twin] = frames.filter(({ img, canvas }) => figure.contains(canvas || img));
    const apart = Math.abs(recorded.times[recorded.wanted] - twin.times[twin.wanted]) > SAME_INSTANT_S;
    figure.classList.toggle("apart", apart);
    figure.querySelector(".apart").hidden = !apart;
  }
  for (const group of groups) showGroup(group);
}

// All pictures of a camera in one answer: a header with their places in time, then the files.
async function fetchPack(address) {
  packs.set(address, new Map());
  const answer = await fetch(address);
  if (!answer.ok) return;
  const whole = await answer.blob();
  const length = new DataView(await whole.slice(0, 4).arrayBuffer()).getUint32(0, true);
  const head = JSON.parse(await whole.slice(4, 4 + length).text());
  let start = 4 + length;
  const found = new Map();
  head.indices.forEach((index, at) => {
    found.set(index, whole.slice(start, start + head.sizes[at], head.types[at]));
    start += head.sizes[at];
  });
  packs.set(address, found);
  const bitmaps = new Map();
  decoded.set(address, bitmaps);
  for (const [index, file] of found) {
    if (pixelsLeft <= 0) break;
    const bitmap = await createImageBitmap(file).catch(() => null);
    if (!bitmap) continue;
    pixelsLeft -= bitmap.width * bitmap.height;
    bitmaps.set(index, bitmap);
  }
}

async function fetchPacks() {
  for (const frame of frames) {
    const address = frame.img.dataset.pack;
    const place = frame.canvas || frame.img;
    if (address && !packs.has(address) && !place.closest("[hidden]")) await fetchPack(address);
  }
  document.documentElement.dataset.pictures = "here";
}

// With the twin's pictures beside the recorded ones there is room for one camera at a time.
const trios = [...document.querySelectorAll(".trio")];
function showCamera(index) {
  trios.forEach((camera, at) => { camera.hidden = at !== index % trios.length; });
  showPictures(Number(clock.value));
  if (document.readyState === "complete") fetchPacks();
}

// Difference, wipe, blink and overlay of recorded and twin.
let blinking = 0;
function compare(mode, share) {
  clearInterval(blinking);
  document.getElementById("share").hidden = mode !== "wipe" && mode !== "overlay";
  for (const figure of document.querySelectorAll(".beside")) {
    figure.dataset.mode = mode;
    figure.style.setProperty("--share", share + "%");
    figure.querySelector(".mode-name").textContent =
      mode === "difference" ? "difference, four times as bright" : mode;
    figure.classList.remove("off");
  }
  if (mode !== "blink") return;
  blinking = setInterval(() => {
    for (const figure of document.querySelectorAll(".beside")) figure.classList.toggle("off");
  }, BLINK_MS);
}

if (clock && frames.length) {
  document.addEventListener("page-time", ({ detail }) => showPictures(detail));
  for (const frame of frames) frame.shown = frame.wanted = nearest(frame.times, Number(clock.value));
  if (trios.length > 1) {
    const other = document.getElementById("camera");
    other.hidden = false;
    other.addEventListener("click", () => showCamera(trios.findIndex((camera) => !camera.hidden) + 1));
    showCamera(0);
  } else showPictures(Number(clock.value));
  if (document.readyState === "complete") fetchPacks();
  else window.addEventListener("load", fetchPacks);
  const mode = document.getElementById("mode");
  if (mode && trios.length) {
    const share = document.getElementById("share");
    const apply = () => compare(mode.value, share.value);
    mode.closest("label").hidden = false;
    mode.addEventListener("change", apply);
    mode.addEventListener("next", () => {
      mode.selectedIndex = (mode.selectedIndex + 1) % mode.options.length;
      apply();
    });
    share.addEventListener("input", apply);
    apply();
  }
}
