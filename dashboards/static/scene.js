// The 3D view of a trial: at the player's instant, turned by mouse, touch and keys.
import { Painter } from "./splats.js";

const HEAD = 16; // bytes before the header
const SPLAT = 48;
const TINT = 0.55; // how much of a replayed object is in the twin's colour
const HIDDEN = -1;
const SLOW_MS = 90; // a frame that takes longer is drawn coarser while things move
const REST_MS = 250;
const EDGES = [0, 1, 1, 3, 3, 2, 2, 0, 4, 5, 5, 7, 7, 6, 6, 4, 0, 4, 1, 5, 2, 6, 3, 7];
const STYLE = getComputedStyle(document.documentElement);
const COLORS = Object.fromEntries(["recorded", "planned", "twin-planned", "twin-executed", "unknown"].map((name) =>
  [name, STYLE.getPropertyValue("--in-scene-" + name).match(/[0-9a-f]{2}/g).map((part) => parseInt(part, 16) / 255)]));

function read(buffer) {
  const [magic, version, length] = new Uint32Array(buffer, 0, 3);
  if (magic !== 0x44335347 || version !== 1) throw new Error("the file of the scene is another's");
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, HEAD, length)));
  const start = HEAD + length;
  const count = head.poses / SPLAT;
  const splats = new Uint32Array(buffer, start, count * 12);
  const floats = new Float32Array(buffer, start, count * 12);
  const positions = new Float32Array(count * 3);
  for (let id = 0; id < count; id += 1) {
    for (let axis = 0; axis < 3; axis += 1) positions[3 * id + axis] = floats[12 * id + axis];
  }
  const poses = new Float32Array(buffer, start + head.poses, (head.points - head.poses) / 4);
  const points = new Float32Array(buffer, start + head.points);
  return { ...head, count, splats, positions, poses, points };
}

// Rows of the 3 x 4 matrix of a track at a time; between two samples the shorter way round.
function poseAt(file, [first, count], t) {
  const at = count === 1 ? 0 : Math.min(Math.max(t / file.end_s, 0), 1) * (count - 1);
  const before = Math.min(Math.floor(at), Math.max(count - 2, 0));
  const a = file.poses.subarray(7 * (first + before), 7 * (first + before) + 7);
  const next = first + Math.min(before + 1, count - 1);
  const b = file.poses.subarray(7 * next, 7 * next + 7);
  const share = at - before;
  const same = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6] < 0 ? -1 : 1;
  const m = Array.from(a, (value, k) => value + share * ((k < 3 ? 1 : same) * b[k] - value));
  const size = Math.hypot(m[3], m[4], m[5], m[6]);
  const [w, x, y, z] = m.slice(3).map((value) => value / size);
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), m[0],
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), m[1],
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), m[2]];
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => a.map((value, axis) => value - b[axis]);
const along = (p, direction, distance) => p.map((value, axis) => value + distance * direction[axis]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

// Where the eye is: around a target, or where a recorded camera was.
class Eye {
  constructor(file) {
    this.file = file;
    this.start();
  }

  start() {
    this.camera = null;
    this.lens = this.file.view;
    this.around(this.file.view.eye_m, this.file.view.target_m);
  }

  around(eye, target) {
    const away = minus(eye, target);
    this.target = target;
    this.distance = Math.max(Math.hypot(...away), 0.05);
    this.yaw = Math.atan2(away[1], away[0]);
    this.pitch = Math.asin(Math.min(Math.max(away[2] / this.distance, -1), 1));
  }

  axes(t) {
    if (this.camera) {
      const m = poseAt(this.file, this.camera.track, t);
      return { x: [m[0], m[4], m[8]], y: [m[1], m[5], m[9]], z: [m[2], m[6], m[10]],
        eye: [m[3], m[7], m[11]] };
    }
    const level = Math.cos(this.pitch);
    const back = [level * Math.cos(this.yaw), level * Math.sin(this.yaw), Math.sin(this.pitch)];
    const z = back.map((value) => -value);
    const x = unit(cross(z, [0, 0, 1]));
    return { x, y: cross(z, x), z, eye: along(this.target, back, this.distance) };
  }

  // All of the camera's image is seen, more only beside it.
  at(t, width, height) {
    const lens = this.camera || this.lens;
    const factor = Math.min(width / lens.width, height / lens.height);
    return { ...this.axes(t), lens: [lens.fx * factor, lens.fy * factor,
      lens.cx * factor + (width - lens.width * factor) / 2,
      lens.cy * factor + (height - lens.height * factor) / 2] };
  }

  // Leave the recorded camera where it is now, and go on around what it looks at.
  leave(t) {
    if (!this.camera) return;
    const { z, eye } = this.axes(t);
    const distance = Math.max(dot(minus(this.file.view.target_m, eye), z), 0.15);
    this.lens = this.camera;
    this.camera = null;
    this.around(eye, along(eye, z, distance));
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(Math.max(this.pitch + pitch, -1.5), 1.5);
  }

  move(right, down, t) {
    const { x, y } = this.axes(t);
    const scale = this.distance / this.lens.fx;
    this.target = along(along(this.target, x, -right * scale), y, -down * scale);
  }

  near(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 0.05), 20);
  }
}

class View {
  constructor(painter, file) {
    this.file = file;
    this.painter = painter;
    this.gl = painter.gl;
    this.canvas = painter.gl.canvas;
    painter.load(file.splats, file.count, file.parts.length, file.harmonics);
    this.eye = new Eye(file);
    this.t = Number(clock.value);
    this.side = "";
    this.withLines = true;
    this.rows = new Float32Array(16 * file.parts.length);
    this.sorting = false;
    this.number = 0;
    this.moved = 0;
    this.frameMs = 0;
    this.isFirst = true; // the first picture is coarse, and there soon
    this.worker = new Worker("/static/splat_sort.js");
    this.worker.onmessage = ({ data }) => this.ordered(data);
    this.worker.onerror = () => this.fail("the sorting thread ended");
    this.worker.postMessage({ points: file.positions, refs: new Uint32Array(0) });
    new ResizeObserver(() => this.changed()).observe(this.canvas);
    this.lost = false;
    this.canvas.addEventListener("webglcontextlost", () => this.fail("the graphics driver gave up"));
  }

  fail(why) {
    this.lost = true;
    this.worker.terminate();
    refuse(why);
  }

  isShown(side) {
    if (side !== "recorded" && side !== "" && side !== this.side) return false;
    const span = this.file.spans_s[side];
    return !span || (this.t >= span[0] - 0.05 && this.t <= span[1] + 0.05);
  }

  show(side, withLines) {
    this.side = side;
    this.withLines = withLines;
    const refs = [];
    this.file.parts.forEach((part, number) => {
      if (part.side && part.side !== "recorded" && part.side !== side) return;
      const [first, count] = this.file.ranges[part.splats];
      for (let id = first; id < first + count; id += 1) refs.push((number << 20 | id) >>> 0);
    });
    this.worker.postMessage({ refs: Uint32Array.from(refs) });
    this.changed();
  }

  changed() {
    if (this.lost || !panel.open) return;
    this.moved = performance.now();
    this.number += 1;
    this.canvas.dataset.settled = "";
    if (!this.sorting) this.sort();
  }

  sort() {
    const { file, t } = this;
    const box = this.canvas.getBoundingClientRect();
    const view = this.eye.at(t, box.width || 1, box.height || 1);
    const rows = new Float32Array(4 * file.parts.length);
    file.parts.forEach((part, number) => {
      const m = poseAt(file, part.track, t);
      this.rows.set(m, 16 * number);
      const tint = part.side && part.side !== "recorded" ? [...COLORS["twin-" + part.side], TINT] : [0, 0, 0, 0];
      this.rows.set(this.isShown(part.side) ? tint : [0, 0, 0, HIDDEN], 16 * number + 12);
      for (let column = 0; column < 3; column += 1) {
        rows[4 * number + column] = dot(view.z, [m[column], m[4 + column], m[8 + column]]);
      }
      rows[4 * number + 3] = dot(view.z, minus([m[3], m[7], m[11]], view.eye));
    });
    this.sorting = true;
    this.worker.postMessage({ rows, number: this.number }, [rows.buffer]);
  }

  ordered({ order, number }) {
    this.pending = { order, number };
    requestAnimationFrame(() => this.paint());
  }

  // One frame at a time: the next is drawn when the graphics driver has done this one.
  paint() {
    if (this.lost) return;
    const { gl, painter } = this;
    const resting = performance.now() - this.moved > REST_MS;
    const coarse = this.isFirst || (!resting && this.frameMs > SLOW_MS) ? 0.5 : 1;
    this.isFirst = false;
    const box = this.canvas.getBoundingClientRect();
    const density = Math.min(devicePixelRatio, 2) * coarse;
    const width = Math.max(1, Math.round(box.width * density));
    const height = Math.max(1, Math.round(box.height * density));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    painter.sorted(this.pending.order);
    painter.place(this.rows);
    painter.stroke(this.withLines ? this.strokes() : new Float32Array(0));
    const view = this.eye.at(this.t, width, height);
    const began = performance.now();
    painter.draw(view, 2.2 * density);
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const drawn = this.pending.number;
    const wait = () => {
      if (this.lost) return;
      const state = gl.clientWaitSync(fence, 0, 0);
      if (state === gl.TIMEOUT_EXPIRED) { setTimeout(wait, 5); return; }
      gl.deleteSync(fence);
      if (coarse === 1) this.frameMs = performance.now() - began;
      this.canvas.dataset.ready = "1";
      this.sorting = false;
      if (drawn !== this.number) this.sort();
      else if (coarse === 1) this.canvas.dataset.settled = "1";
      else setTimeout(() => { if (drawn === this.number && !this.sorting) this.sort(); }, REST_MS);
    };
    setTimeout(wait, 0);
  }

  strokes() {
    const { file, t } = this;
    const found = [];
    const stroke = (a, b, color, alpha) => found.push(...a, ...b, ...color, alpha);
    const point = (index) => file.points.subarray(4 * index, 4 * index + 3);
    for (const { style, points: [first, count] } of file.paths) {
      if (style.startsWith("twin-") && style !== "twin-" + this.side) continue;
      for (let at = first; at < first + count - 1; at += 1) {
        const done = file.points[4 * at + 3] <= t;
        stroke(point(at), point(at + 1), COLORS[style], done ? 1 : 0.35);
      }
    }
    const hasRobot = file.parts.some((part) => part.splats.startsWith("link "));
    for (const { side, points: [first], per_sample: each } of file.arms) {
      if ((side === "recorded" && hasRobot) || !this.isShown(side)) continue;
      const sample = Math.round(Math.min(t / file.end_s, 1) * (file.samples - 1));
      for (let at = first + sample * each; at < first + (sample + 1) * each - 1; at += 1) {
        stroke(point(at), point(at + 1), COLORS[side === "recorded" ? side : "twin-" + side], 0.9);
      }
    }
    for (const box of file.boxes) {
      const hasSplats = file.ranges["object " + box.name];
      if ((box.side === "recorded" && hasSplats && !box.not_scanned) || !this.isShown(box.side)) continue;
      const m = poseAt(file, box.track, t);
      const corners = [...Array(8).keys()].map((bits) => {
        const p = box.half_m.map((h, axis) => box.centre_m[axis] + (bits >> axis & 1 ? h : -h));
        return [0, 4, 8].map((row) => dot(m.slice(row, row + 3), p) + m[row + 3]);
      });
      const color = COLORS[box.side !== "recorded" ? "twin-" + box.side : box.not_scanned ? "unknown" : box.side];
      for (let edge = 0; edge < 24; edge += 2) {
        stroke(corners[EDGES[edge]], corners[EDGES[edge + 1]], color, 1);
      }
    }
    return Float32Array.from(found);
  }
}

function steer(view) {
  const { canvas, eye } = view;
  const pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [right, down] = [event.clientX - before.x, event.clientY - before.y];
    const apart = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    eye.leave(view.t);
    if (apart) {
      eye.near(apart / Math.max(spread(), 1));
      eye.move(right / 2, down / 2, view.t);
    } else if (event.shiftKey || event.buttons & 6) eye.move(right, down, view.t);
    else eye.turn(-right * 0.008, down * 0.008);
    view.changed();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    eye.leave(view.t);
    eye.near(Math.exp(Math.min(Math.max(event.deltaY, -300), 300) * 0.0015));
    view.changed();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const zoom = { "+": 0.88, "=": 0.88, "-": 1 / 0.88 }[event.key];
    if (!way && !zoom && event.key !== "Home") return;
    event.preventDefault();
    event.stopPropagation();
    if (event.key === "Home") eye.start();
    else eye.leave(view.t);
    if (zoom) eye.near(zoom);
    else if (way && event.shiftKey) eye.move(-24 * way[0], -24 * way[1], view.t);
    else if (way) eye.turn(0.09 * way[0], -0.09 * way[1]);
    view.changed();
  });
}

function buttons(panel, view) {
  const { eye, file } = view;
  const bar = panel.querySelector(".space-bar");
  const add = (text, act) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.addEventListener("click", () => { act(); view.changed(); });
    bar.querySelector(".eyes").append(button);
  };
  for (const camera of file.cameras) {
    add("From camera " + camera.id, () => { eye.camera = camera; });
  }
  add("First view", () => eye.start());
  const side = bar.querySelector("select");
  for (const name of Object.keys(file.spans_s)) {
    if (name !== "recorded") side.add(new Option(name, name));
  }
  side.add(new Option("not shown", ""));
  const lines = bar.querySelector("input");
  const choose = () => {
    view.show(side.value, lines.checked);
    for (const text of panel.querySelectorAll("[data-side]")) {
      text.hidden = text.dataset.side !== side.value;
    }
  };
  side.addEventListener("change", choose);
  lines.addEventListener("change", choose);
  choose();
  const notes = panel.querySelector(".space-notes");
  for (const text of file.notes) {
    const line = document.createElement("li");
    line.textContent = text;
    notes.append(line);
  }
  bar.hidden = false;
}

const panel = document.querySelector("details.space");
const clock = document.getElementById("clock");
let opened = false;
function refuse(why) {
  panel.querySelector(".space-state").textContent = `No 3D view: ${why}.`;
  panel.classList.remove("drawn");
  panel.classList.add("refused");
}
async function open() {
  const state = panel.querySelector(".space-state");
  try {
    state.textContent = "Loading the scene …";
    const began = performance.now();
    const asked = fetch(panel.dataset.source);
    const gl = panel.querySelector("canvas").getContext("webgl2", { alpha: false, antialias: false });
    if (!gl) throw new Error("no WebGL 2 here");
    const painter = new Painter(gl);
    const [answer] = await Promise.all([asked, painter.ready()]);
    if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
    const view = new View(painter, read(await answer.arrayBuffer()));
    document.addEventListener("page-time", ({ detail }) => { view.t = detail; view.changed(); });
    steer(view);
    buttons(panel, view);
    const ready = () => {
      if (view.lost) return;
      if (!view.canvas.dataset.ready) { setTimeout(ready, 20); return; }
      panel.classList.add("drawn");
      view.canvas.dataset.firstMs = String(Math.round(performance.now() - began));
      state.textContent = `${view.file.count.toLocaleString("en")} Gaussians`;
    };
    ready();
  } catch (error) {
    refuse(error.message);
  }
}
function toggled() {
  const address = new URL(location.href);
  if (panel.open) address.searchParams.set("space", "1");
  else address.searchParams.delete("space");
  history.replaceState(null, "", address);
  if (panel.open && !opened) { opened = true; open(); }
}
if (panel) {
  panel.addEventListener("toggle", toggled);
  if (new URL(location.href).searchParams.get("space") === "1") panel.open = true;
}
