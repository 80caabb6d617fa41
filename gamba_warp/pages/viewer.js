"use strict";
// Shows one object's Gaussians (.splat records, inlined as base64) in WebGL2: sorted by depth, each
// an instanced quad that covers the projected ellipse. The camera is cameras.py's orbit().

const VERTEX = `#version 300 es
precision highp float;
uniform highp sampler2D splats;
uniform mat3 view;
uniform float distance, focal;
uniform vec2 size;
in uint index;
in vec2 corner;
out vec2 at;
out vec4 colour;
void main() {
  ivec2 p = ivec2(int(index & 255u) * 4, int(index >> 8));
  vec4 a = texelFetch(splats, p, 0), b = texelFetch(splats, p + ivec2(1, 0), 0);
  vec4 c = texelFetch(splats, p + ivec2(2, 0), 0), d = texelFetch(splats, p + ivec2(3, 0), 0);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  vec3 m = view * a.xyz + vec3(0.0, 0.0, distance);
  if (m.z < 0.02 || a.w < 1.0 / 255.0) return;
  mat3 world = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  float f = focal / m.z;
  vec3 u = vec3(f, 0.0, -f * m.x / m.z) * view, v = vec3(0.0, f, -f * m.y / m.z) * view;
  float xx = dot(u, world * u) + 0.3, xy = dot(u, world * v), yy = dot(v, world * v) + 0.3;
  float mid = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = abs(xy) > 1e-6 * mid ? normalize(vec2(xy, mid + spread - xx))
    : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  at = corner * sqrt(2.0 * log(255.0 * a.w));
  vec2 shift = at.x * sqrt(mid + spread) * axis
    + at.y * sqrt(max(mid - spread, 0.05)) * vec2(-axis.y, axis.x);
  vec2 pixel = f * m.xy + shift;
  gl_Position = vec4(2.0 * pixel.x / size.x, -2.0 * pixel.y / size.y, 0.0, 1.0);
  colour = vec4(d.rgb, a.w);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 at;
in vec4 colour;
out vec4 result;
void main() {
  float alpha = min(0.99, colour.a * exp(-0.5 * dot(at, at)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(colour.rgb * alpha, alpha);
}`;

function decode(base64) {
  const bytes = Uint8Array.from(atob(base64.trim()), (letter) => letter.charCodeAt(0));
  const numbers = new DataView(bytes.buffer), count = bytes.length >> 5;
  const rows = Math.max(1, Math.ceil(count / 256));
  const texels = new Float32Array(rows * 256 * 16);
  for (let i = 0; i < count; i++) {
    const byte = i * 32, out = i * 16;
    const s = [12, 16, 20].map((at) => numbers.getFloat32(byte + at, true));
    let [w, x, y, z] = [28, 29, 30, 31].map((at) => (bytes[byte + at] - 128) / 128);
    const norm = Math.hypot(w, x, y, z) || 1;
    w /= norm; x /= norm; y /= norm; z /= norm;
    const r = [
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ];
    const cov = (p, q) => [0, 1, 2].reduce((t, k) => t + r[3 * p + k] * r[3 * q + k] * s[k] * s[k], 0);
    for (let k = 0; k < 3; k++) {
      texels[out + k] = numbers.getFloat32(byte + 4 * k, true);
      texels[out + 12 + k] = bytes[byte + 24 + k] / 255;
    }
    texels[out + 3] = bytes[byte + 27] / 255;
    texels.set([cov(0, 0), cov(0, 1), cov(0, 2), cov(1, 1), cov(1, 2), cov(2, 2)], out + 4);
  }
  return { count, rows, texels };
}

function sortByDepth(splats, forward, order) {
  const { count, texels } = splats, depths = new Float32Array(count);
  let low = Infinity, high = -Infinity;
  for (let i = 0; i < count; i++) {
    const p = i * 16;
    depths[i] = forward[0] * texels[p] + forward[1] * texels[p + 1] + forward[2] * texels[p + 2];
    low = Math.min(low, depths[i]);
    high = Math.max(high, depths[i]);
  }
  const factor = 65535 / (high - low || 1), starts = new Uint32Array(65537), keys = new Uint16Array(count);
  for (let i = 0; i < count; i++) {
    keys[i] = (high - depths[i]) * factor;
    starts[keys[i] + 1]++;
  }
  for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
  for (let i = 0; i < count; i++) order[starts[keys[i]]++] = i;
}

function program(gl) {
  const result = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(result, shader);
  }
  gl.bindAttribLocation(result, 0, "corner");
  gl.bindAttribLocation(result, 1, "index");
  gl.linkProgram(result);
  if (!gl.getProgramParameter(result, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(result));
  gl.useProgram(result);
  return result;
}

function upload(gl, splats, order) {
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 1024, splats.rows, 0, gl.RGBA, gl.FLOAT, splats.texels);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, order.byteLength, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(1);
  gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(1, 1);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
}

function start(viewer) {
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
  if (!gl) {
    viewer.parentElement.classList.add("without");
    return;
  }
  const splats = decode(document.getElementById(viewer.dataset.splat).textContent);
  const order = new Uint32Array(splats.count), shader = program(gl);
  upload(gl, splats, order);
  const uniform = (name) => gl.getUniformLocation(shader, name);
  const elevation = (Number(viewer.dataset.elevation) * Math.PI) / 180;
  const home = { azimuth: 0, elevation, distance: Number(viewer.dataset.distance) };
  const camera = { ...home }, half = Math.tan((Number(viewer.dataset.fov) * Math.PI) / 360);
  let waiting = false;

  function draw() {
    waiting = false;
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    const [sa, ca] = [Math.sin(camera.azimuth), Math.cos(camera.azimuth)];
    const [se, ce] = [Math.sin(camera.elevation), Math.cos(camera.elevation)];
    const right = [ca, 0, sa], down = [se * sa, ce, -se * ca], forward = [-sa * ce, se, ca * ce];
    sortByDepth(splats, forward, order);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    const view = [0, 1, 2].flatMap((k) => [right[k], down[k], forward[k]]);
    gl.uniformMatrix3fv(uniform("view"), false, view);
    gl.uniform1f(uniform("distance"), camera.distance);
    gl.uniform1f(uniform("focal"), canvas.height / 2 / half);
    gl.uniform2f(uniform("size"), canvas.width, canvas.height);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, splats.count);
  }
  const redraw = () => {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  };
  const orbit = (dx, dy) => {
    camera.azimuth -= dx;
    camera.elevation = Math.max(-1.5, Math.min(1.5, camera.elevation + dy));
    redraw();
  };
  const zoom = (factor) => {
    camera.distance = Math.max(0.3, Math.min(6, camera.distance * factor));
    redraw();
  };
  const keys = {
    ArrowLeft: () => orbit(-0.1, 0), ArrowRight: () => orbit(0.1, 0),
    ArrowUp: () => orbit(0, -0.1), ArrowDown: () => orbit(0, 0.1),
    "+": () => zoom(0.9), "-": () => zoom(1.1),
    Home: () => { Object.assign(camera, home); redraw(); },
  };
  canvas.tabIndex = 0;
  canvas.setAttribute("aria-label", "3D view: drag or arrow keys to turn, wheel or + and - to zoom");
  canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
  canvas.onpointermove = (event) => {
    if (event.buttons && event.isPrimary) orbit(event.movementX * 0.01, event.movementY * 0.01);
  };
  canvas.ondblclick = keys.Home;
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.03 : 0.001)));
  }, { passive: false });
  canvas.onkeydown = (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  };
  // A page with many viewers may lose the oldest: it goes back to its picture.
  canvas.addEventListener("webglcontextlost", () => {
    canvas.remove();
    viewer.classList.remove("running");
  });
  viewer.append(canvas);
  viewer.classList.add("running");
  new ResizeObserver(redraw).observe(canvas);
}

for (const viewer of document.querySelectorAll(".viewer")) {
  viewer.querySelector("button").onclick = () => start(viewer);
  if ("auto" in viewer.dataset) start(viewer);
}
