"use strict";
// Orders Gaussians by depth, farthest first, in a thread of its own.
// Counting sort on 16 bits of depth: linear, whatever the order was before.

const LEVELS = 1 << 16;
const INDEX = 0xfffff;
let positions = new Float32Array(0);
let references = new Uint32Array(0);
let keys = new Uint16Array(0);
let depths = new Float32Array(0);

// What is drawn: a Gaussian's number in the low 20 bits, its part above them.
function take({ points, refs }) {
  if (points) positions = points;
  references = refs;
  keys = new Uint16Array(refs.length);
  depths = new Float32Array(refs.length);
}

// rows: for each part the four numbers whose product with (x, y, z, 1) is the depth.
function ordered(rows) {
  const count = references.length;
  let low = Infinity;
  let high = -Infinity;
  for (let index = 0; index < count; index += 1) {
    const at = 3 * (references[index] & INDEX);
    const row = 4 * (references[index] >>> 20);
    const depth = rows[row] * positions[at] + rows[row + 1] * positions[at + 1]
      + rows[row + 2] * positions[at + 2] + rows[row + 3];
    depths[index] = depth;
    if (depth < low) low = depth;
    if (depth > high) high = depth;
  }
  const scale = high > low ? (LEVELS - 1) / (high - low) : 0;
  const starts = new Uint32Array(LEVELS + 1);
  for (let index = 0; index < count; index += 1) {
    keys[index] = (high - depths[index]) * scale;
    starts[keys[index] + 1] += 1;
  }
  for (let level = 0; level < LEVELS; level += 1) starts[level + 1] += starts[level];
  const order = new Uint32Array(count);
  for (let index = 0; index < count; index += 1) {
    order[starts[keys[index]]] = references[index];
    starts[keys[index]] += 1;
  }
  return order;
}

self.onmessage = ({ data }) => {
  if (data.refs) take(data);
  if (!data.rows) return;
  const order = ordered(data.rows);
  self.postMessage({ order, number: data.number }, [order.buffer]);
};
