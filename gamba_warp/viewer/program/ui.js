// User interface: buttons, help, the input's camera as lines, messages.

const STEP = 26; // pixels of a drag equal to an arrow key

const GROUNDS = ["light", "dark", "grey", "clear"]; // in the order of the button

// An option in the page's address, such as `controls` of viewer.html?controls=0.
const asked = (name) => new URLSearchParams(location.search).get(name);
const byId = (name) => document.getElementById(name);

function dressPage(about) {
  document.title = about.title;
  byId("name").textContent = about.title;
  const parts = about.total ? [`${about.total.toLocaleString("en")} Gaussian${about.total === 1 ? "" : "s"}`] : [];
  if (about.faces) parts.push(`${about.faces.toLocaleString("en")} faces`);
  if (about.note) parts.push(about.note);
  byId("about").textContent = parts.join(" · ");
  for (const button of document.querySelectorAll("[data-mode]"))
    button.hidden = !about[button.dataset.mode === "mesh" ? "faces" : "count"];
  byId("do-input").hidden = !about.input;
  const wipe = byId("wipe"), [left, right] = wipe.querySelectorAll("span"), slider = wipe.querySelector("input");
  wipe.hidden = !about.image && !(about.faces && about.count);
  document.documentElement.classList.toggle("wipes", !wipe.hidden);
  left.textContent = about.image ? "Input" : "Gaussians";
  right.textContent = about.faces ? "Mesh" : "Gaussians";
  Object.assign(slider, { min: about.image ? -1 : 0, max: about.faces ? 1 : 0 });
  if (about.image) byId("seen").src = about.image;
  byId("do-full").hidden = !document.fullscreenEnabled;
  document.documentElement.classList.toggle("bare", asked("controls") === "0");
}

// Shows `wipe`: to -1 the input's image covers the left of the view, to 1 the mesh does.
function showWipe(wipe) {
  const fraction = 100 * Math.abs(wipe), seen = byId("seen"), edge = byId("edge");
  byId("wipe").querySelector("input").value = wipe;
  seen.hidden = wipe >= 0;
  edge.hidden = wipe === 0;
  edge.style.left = `${fraction}%`;
  seen.style.clipPath = `inset(0 ${100 - fraction}% 0 0)`;
  byId("canvas").style.clipPath = wipe < 0 ? `inset(0 0 0 ${fraction}%)` : "";
}

function say(text, title = "") {
  byId("message").hidden = !text;
  byId("message-title").textContent = title;
  byId("message-text").textContent = text;
}

// The background: the system's choice of light or dark, until the user chooses.
function startGround(changed) {
  const system = matchMedia("(prefers-color-scheme: dark)"), root = document.documentElement;
  const set = (ground) => {
    root.dataset.ground = ground;
    changed();
  };
  const first = () => set(GROUNDS.includes(asked("ground")) ? asked("ground") : system.matches ? "dark" : "light");
  first();
  system.addEventListener("change", first);
  return () => set(GROUNDS[(GROUNDS.indexOf(root.dataset.ground) + 1) % GROUNDS.length]);
}

// Colour of the background and its alpha.
function background() {
  const text = getComputedStyle(document.documentElement).getPropertyValue("--stage").trim();
  if (document.documentElement.dataset.ground === "clear") return [0, 0, 0, 0];
  return [...[1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255), 1];
}

function toggleFull() {
  const done = document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen();
  done.catch(() => say("This browser does not let the page fill the screen."));
}

function toggleDialog(name) {
  const dialog = byId(name);
  if (dialog.open) dialog.close();
  else dialog.showModal();
}

const toggleHelp = () => toggleDialog("help");

// The input's camera as an SVG path: its centre, and the rectangle of its image.
function inputLines(input, camera, width, height) {
  const rows = axesOf(input.azimuth, input.elevation), half = Math.tan((input.fov * Math.PI) / 360), depth = 0.3 * input.distance;
  const eye = [0, 1, 2].map((k) => input.target[k] - input.distance * rows[2][k]);
  const corner = (x, y, z) => [0, 1, 2].map((k) => eye[k] + z * (half * (x * rows[0][k] + y * rows[1][k]) + rows[2][k]));
  const [a, b, c, d] = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => corner(x, y, depth));
  const up = [corner(-0.35, -1.08, depth), corner(0, -1.5, depth), corner(0.35, -1.08, depth)];
  const lines = [[eye, a], [eye, b], [eye, c], [eye, d], [a, b], [b, c], [c, d], [d, a],
    [up[0], up[1]], [up[1], up[2]], [up[2], up[0]]];
  return lines.map(([p, q]) => projectedLine(p, q, camera, width, height)).join("");
}

function projectedLine(p, q, camera, width, height) {
  const rows = camera.rotation(), eye = camera.position(), near = 0.02, focal = camera.focal(width, height);
  let [m, n] = [p, q].map((point) => rows.map((row) =>
    row.reduce((sum, value, k) => sum + value * (point[k] - eye[k]), 0)));
  if (m[2] < near && n[2] < near) return "";
  const cut = (from, to) => from.map((value, k) => value + ((near - from[2]) / (to[2] - from[2])) * (to[k] - value));
  if (m[2] < near) m = cut(m, n);
  if (n[2] < near) n = cut(n, m);
  const [a, b] = [m, n].map((v) =>
    `${(width / 2 + (focal * v[0]) / v[2]).toFixed(1)} ${(height / 2 + (focal * v[1]) / v[2]).toFixed(1)}`);
  return `M${a}L${b}`;
}

function saveImage(canvas, name) {
  canvas.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${name.replace(/\.(ply|splat|spz|glb)$/i, "").replace(/[^\p{L}\p{N}._-]+/gu, "-") || "view"}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }, "image/png");
}

// Buttons and keys; `viewer` does what they ask for.
function startButtons(viewer) {
  const nextGround = startGround(() => viewer.redraw());
  const press = {
    home: () => viewer.goHome(), input: () => viewer.toggleInput(), theme: nextGround,
    image: () => toggleDialog("image"), help: toggleHelp, full: toggleFull,
  };
  for (const [name, action] of Object.entries(press)) byId(`do-${name}`).onclick = action;
  const modes = [...document.querySelectorAll("[data-mode]")];
  for (const button of modes) button.onclick = () => viewer.setMode(button.dataset.mode);
  for (const dialog of document.querySelectorAll("dialog"))
    dialog.onclick = (event) => {
      if (event.target === dialog || event.target.closest("button")) dialog.close();
    };
  for (const button of document.querySelectorAll("[data-side]"))
    button.onclick = () => viewer.save(Number(button.dataset.side));
  byId("wipe").oninput = (event) => viewer.setWipe(Number(event.target.value));
  const turn = (x, y) => () => viewer.act.turn(x * STEP, y * STEP);
  const pan = (x, y) => () => viewer.act.pan(x * STEP, y * STEP);
  const zoom = (factor) => () => viewer.act.zoom(factor);
  return {
    ArrowLeft: turn(-1, 0), ArrowRight: turn(1, 0), ArrowUp: turn(0, -1), ArrowDown: turn(0, 1),
    "Shift+ArrowLeft": pan(-1, 0), "Shift+ArrowRight": pan(1, 0),
    "Shift+ArrowUp": pan(0, -1), "Shift+ArrowDown": pan(0, 1),
    "+": zoom(0.9), "=": zoom(0.9), "-": zoom(1 / 0.9), _: zoom(1 / 0.9),
    1: () => viewer.setMode("gaussians"), 2: () => viewer.setMode("centres"), 3: () => viewer.setMode("mesh"),
    r: press.home, Home: press.home, c: press.input, l: press.theme, s: () => viewer.save(0),
    o: viewer.choose, f: () => document.fullscreenEnabled && toggleFull(), h: toggleHelp, "?": toggleHelp,
  };
}
