// Draws Gaussians and lines with WebGL 2, by the equations of the twin's own rasteriser:
// image covariance J W Sigma W^T J^T (Zwicker et al. 2001), a low-pass of 0.1 px^2 with the
// opacity it takes away, alpha cut at 1/255, farthest first with premultiplied alpha.

const PER_ROW = 512; // Gaussians in a row of the texture; three texels each
const SPLATS = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D; precision highp sampler2D;
uniform usampler2D u_splats; uniform sampler2D u_parts;
uniform vec3 u_x, u_y, u_z, u_eye; // rows of R_camera_root, and the camera's centre
uniform vec4 u_lens; // fx, fy, cx, cy [pixels]
uniform vec2 u_size; uniform float u_harmonics;
layout(location = 0) in uint a_ref;
out vec2 v_offset; flat out vec3 v_conic; flat out vec4 v_color;

vec4 signed_bytes(uint packed) {
  ivec4 bytes = ivec4(packed << 24, packed << 16, packed << 8, packed) >> 24;
  return vec4(bytes) / 127.0;
}

mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside, unless all goes well
  int id = int(a_ref & 0xfffffu), part = int(a_ref >> 20);
  ivec2 at = ivec2(3 * (id % ${PER_ROW}), id / ${PER_ROW});
  uvec4 a = texelFetch(u_splats, at, 0);
  uvec4 b = texelFetch(u_splats, at + ivec2(1, 0), 0);
  uvec4 c = texelFetch(u_splats, at + ivec2(2, 0), 0);
  vec4 row0 = texelFetch(u_parts, ivec2(0, part), 0);
  vec4 row1 = texelFetch(u_parts, ivec2(1, part), 0);
  vec4 row2 = texelFetch(u_parts, ivec2(2, part), 0);
  vec4 tint = texelFetch(u_parts, ivec2(3, part), 0);
  if (tint.a < 0.0) return; // a part that is not shown
  mat3 turn = transpose(mat3(row0.xyz, row1.xyz, row2.xyz));
  vec3 p_root = turn * uintBitsToFloat(a.xyz) + vec3(row0.w, row1.w, row2.w);

  vec3 ray = p_root - u_eye;
  vec3 p = vec3(dot(u_x, ray), dot(u_y, ray), dot(u_z, ray));
  if (p.z < 0.02) return;
  vec2 margin = 0.3 * u_size;
  vec2 t = clamp(p.xy / p.z, (-margin - u_lens.zw) / u_lens.xy,
                 (u_size + margin - u_lens.zw) / u_lens.xy);
  vec3 T0 = u_lens.x / p.z * (u_x - t.x * u_z);
  vec3 T1 = u_lens.y / p.z * (u_y - t.y * u_z);

  vec2 b_opacity = unpackHalf2x16(b.x), s01 = unpackHalf2x16(b.y), s2 = unpackHalf2x16(b.z);
  vec4 q = normalize(vec4(unpackSnorm2x16(b.w), unpackSnorm2x16(c.x)));
  mat3 axes = turn * rotation(q);
  vec3 s = vec3(s01, s2.x);
  vec3 A0 = (T0 * axes) * s, A1 = (T1 * axes) * s;
  float xx = dot(A0, A0), xy = dot(A0, A1), yy = dot(A1, A1);
  vec3 n = cross(A0, A1);
  float raw = dot(n, n), full = raw + 0.1 * (xx + yy) + 0.01;
  float opacity = b_opacity.y * sqrt(max(raw / full, 2.5e-5));
  if (opacity * 255.0 < 1.0) return;
  xx += 0.1; yy += 0.1;
  v_conic = vec3(yy, -xy, xx) / full;

  vec3 d = normalize(ray) * turn; // into the part's frame, in which its harmonics are
  vec3 basis = 0.4886025119029199 * vec3(-d.y, d.z, -d.x) * u_harmonics;
  vec4 h0 = signed_bytes(c.y), h1 = signed_bytes(c.z), h2 = signed_bytes(c.w);
  vec3 color = vec3(unpackHalf2x16(a.w), b_opacity.x)
    + basis.x * h0.xyz + basis.y * vec3(h0.w, h1.xy) + basis.z * vec3(h1.zw, h2.x);
  v_color = vec4(mix(color, tint.rgb, tint.a), opacity);

  float reach2 = 2.0 * log(255.0 * opacity);
  vec2 corner = 2.0 * vec2(gl_VertexID & 1, gl_VertexID >> 1) - 1.0;
  v_offset = corner * sqrt(reach2 * vec2(xx, yy));
  vec2 pixel = u_lens.xy * p.xy / p.z + u_lens.zw + v_offset;
  gl_Position = vec4(2.0 * pixel.x / u_size.x - 1.0, 1.0 - 2.0 * pixel.y / u_size.y, 0.0, 1.0);
}`;
const SPLATS_COLOR = `#version 300 es
precision highp float;
in vec2 v_offset; flat in vec3 v_conic; flat in vec4 v_color;
out vec4 color;
void main() {
  vec2 d = v_offset;
  float distance2 = v_conic.x * d.x * d.x + 2.0 * v_conic.y * d.x * d.y + v_conic.z * d.y * d.y;
  float alpha = min(v_color.a * exp(-0.5 * distance2), 0.999);
  if (alpha * 255.0 < 1.0) discard;
  color = vec4(v_color.rgb * alpha, alpha);
}`;
const LINES = `#version 300 es
precision highp float;
uniform vec3 u_x, u_y, u_z, u_eye; uniform vec4 u_lens; uniform vec2 u_size;
uniform vec2 u_width; // of a line, and of its dark rim beside it [pixels]
layout(location = 0) in vec3 a_from; layout(location = 1) in vec3 a_to;
layout(location = 2) in vec4 a_color;
flat out vec4 v_color;
vec3 seen(vec3 p) { vec3 r = p - u_eye; return vec3(dot(u_x, r), dot(u_y, r), dot(u_z, r)); }
vec2 pixel(vec3 p) { return u_lens.xy * p.xy / p.z + u_lens.zw; }
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  vec3 a = seen(a_from), b = seen(a_to);
  if (max(a.z, b.z) < 0.02) return;
  if (a.z < 0.02) a = mix(a, b, (0.02 - a.z) / (b.z - a.z));
  if (b.z < 0.02) b = mix(b, a, (0.02 - b.z) / (a.z - b.z));
  vec2 from = pixel(a), along = pixel(b) - from;
  float size = length(along);
  vec2 unit = size > 1e-6 ? along / size : vec2(1.0, 0.0);
  float half_width = 0.5 * u_width.x + u_width.y;
  vec2 aside = vec2(-unit.y, unit.x) * half_width * (2.0 * float(gl_VertexID & 1) - 1.0);
  float end = float(gl_VertexID >> 1);
  vec2 at = from + along * end + unit * half_width * 0.5 * (2.0 * end - 1.0) + aside;
  gl_Position = vec4(2.0 * at.x / u_size.x - 1.0, 1.0 - 2.0 * at.y / u_size.y, 0.0, 1.0);
  v_color = u_width.y > 0.0 ? vec4(0.05, 0.06, 0.08, a_color.a) : a_color;
}`;
const LINES_COLOR = `#version 300 es
precision highp float;
flat in vec4 v_color; out vec4 color;
void main() { color = vec4(v_color.rgb * v_color.a, v_color.a); }`;

function program(gl, vertices, colors) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertices], [gl.FRAGMENT_SHADER, colors]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  const places = new Map();
  return { made, place: (name) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(made, name));
    return places.get(name);
  } };
}

// Wait for the driver without holding the page up, and see that it took the program.
async function compiled(gl, made) {
  const parallel = gl.getExtension("KHR_parallel_shader_compile");
  while (parallel && !gl.getProgramParameter(made, parallel.COMPLETION_STATUS_KHR)) {
    await new Promise((done) => { setTimeout(done, 10); });
  }
  if (gl.getProgramParameter(made, gl.LINK_STATUS)) return;
  const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
  throw new Error("the graphics driver refuses a shader: " + logs.join(" "));
}

function texture(gl, unit) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.deleteTexture(gl.getParameter(gl.TEXTURE_BINDING_2D));
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  }
}

function attribute(gl, place, size, stride, offset) {
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, size, gl.FLOAT, false, stride, offset);
  gl.vertexAttribDivisor(place, 1);
}

// One canvas. A view is { x, y, z, eye, lens }: rows of R_camera_root, centre, fx fy cx cy.
export class Painter {
  constructor(gl) {
    this.gl = gl;
    this.splats = program(gl, SPLATS, SPLATS_COLOR);
    this.lines = program(gl, LINES, LINES_COLOR);
    this.order = this.inputs(() => {
      gl.enableVertexAttribArray(0);
      gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
      gl.vertexAttribDivisor(0, 1);
    });
    this.strokes = this.inputs(() => {
      attribute(gl, 0, 3, 40, 0);
      attribute(gl, 1, 3, 40, 12);
      attribute(gl, 2, 4, 40, 24);
    });
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  // Compile, and draw one Gaussian and one stroke of nothing: drivers translate a program when it
  // first draws. That takes a second in software, best spent while the scene is on its way.
  async ready() {
    for (const { made } of [this.splats, this.lines]) await compiled(this.gl, made);
    this.load(new Uint32Array(12), 1, 1, 1);
    this.place(new Float32Array(16));
    this.sorted(new Uint32Array(1));
    this.stroke(new Float32Array(10));
    this.draw({ x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1], eye: [0, 0, 0], lens: [1, 1, 0, 0] }, 1);
    this.gl.flush();
  }

  load(splats, count, numParts, harmonics) {
    const { gl } = this;
    const rows = Math.max(1, Math.ceil(count / PER_ROW));
    const padded = new Uint32Array(rows * PER_ROW * 12);
    padded.set(splats);
    texture(gl, 0);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, 3 * PER_ROW, rows, 0,
      gl.RGBA_INTEGER, gl.UNSIGNED_INT, padded);
    texture(gl, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 4, Math.max(1, numParts), 0, gl.RGBA, gl.FLOAT, null);
    this.numParts = numParts;
    this.harmonics = harmonics;
    this.drawn = 0;
    this.numLines = 0;
  }

  inputs(describe) {
    const { gl } = this;
    const found = { array: gl.createVertexArray(), buffer: gl.createBuffer() };
    gl.bindVertexArray(found.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, found.buffer);
    describe();
    return found;
  }

  fill(inputs, data) {
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, inputs.buffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, data, this.gl.DYNAMIC_DRAW);
  }

  // 16 numbers for each part: three rows of its pose, then colour and strength of its tint.
  place(parts) {
    const { gl } = this;
    if (!this.numParts) return;
    gl.activeTexture(gl.TEXTURE1);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 4, this.numParts, gl.RGBA, gl.FLOAT, parts);
  }

  sorted(order) {
    this.fill(this.order, order);
    this.drawn = order.length;
  }

  // Ten numbers for each stroke: from, to, colour with alpha.
  stroke(numbers) {
    this.fill(this.strokes, numbers);
    this.numLines = numbers.length / 10;
  }

  look({ made, place }, view) {
    const { gl } = this;
    gl.useProgram(made);
    for (const name of ["x", "y", "z", "eye"]) gl.uniform3fv(place("u_" + name), view[name]);
    gl.uniform4fv(place("u_lens"), view.lens);
    gl.uniform2f(place("u_size"), gl.drawingBufferWidth, gl.drawingBufferHeight);
  }

  draw(view, lineWidth) {
    const { gl } = this;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.look(this.splats, view);
    gl.uniform1i(this.splats.place("u_splats"), 0);
    gl.uniform1i(this.splats.place("u_parts"), 1);
    gl.uniform1f(this.splats.place("u_harmonics"), this.harmonics);
    gl.bindVertexArray(this.order.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.drawn);
    if (!this.numLines) return;
    this.look(this.lines, view);
    gl.bindVertexArray(this.strokes.array);
    for (const rim of [lineWidth / 2, 0]) {
      gl.uniform2f(this.lines.place("u_width"), lineWidth, rim);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.numLines);
    }
  }
}
