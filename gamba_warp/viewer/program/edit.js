// Edits in the page of the app, which gives `about.edit`. A brush marks Gaussians to remove, those whose
// centres are below it, at any depth. The page around the frame sets the elevation, and is told of edits.

const MARKED = 1, REMOVED = 2; // states of a Gaussian
const MARK = [0x3b480000, 0x2a66359a]; // the records' colour of a marked one: red; green and blue
const MOST_STEPS = 50; // that can be undone
const PAUSE = 150; // milliseconds after the last change, before an elevation is told

class Editor {
  constructor(viewer) {
    this.viewer = viewer;
    const { canvas, act } = viewer, size = byId("brush-size"), ring = byId("ring");
    const press = { brush: () => this.use(!act.paint), remove: () => this.remove(), undo: () => this.undo() };
    for (const [name, action] of Object.entries(press)) byId(`do-${name}`).onclick = () => this.edit && action();
    const resize = (step) => () => { size.value = Number(size.value) + step; };
    const keys = { e: "brush", Delete: "remove", Backspace: "remove", "Ctrl+z": "undo" };
    for (const [key, name] of Object.entries(keys)) act.keys[key] = () => byId(`do-${name}`).click();
    Object.assign(act.keys, { "[": resize(-4), "]": resize(4) });
    window.addEventListener("message", ({ data, source }) => {
      if (source === parent && this.edit && Number.isFinite(data?.elevation)) this.rotate(data.elevation);
    });
    canvas.addEventListener("pointerdown", () => { this.begun = false; });
    canvas.addEventListener("pointerleave", () => { ring.hidden = true; });
    canvas.addEventListener("pointermove", ({ offsetX, offsetY }) => {
      ring.hidden = !act.paint;
      ring.style = `left: ${offsetX}px; top: ${offsetY}px; width: ${2 * size.value}px`;
    });
  }

  // Takes the records of an object; without `edit` it cannot be edited.
  load(records, edit) {
    this.edit = edit;
    this.use(false);
    document.documentElement.classList.toggle("edits", !!edit);
    if (!edit) return;
    const bits = atob(edit.removed);
    this.words = new Uint32Array(records);
    this.looks = this.words.filter((_, at) => (at & 7) === 3 || (at & 7) === 4); // opacities, colours
    this.state = new Uint8Array(this.words.length >> 3);
    this.steps = [this.state];
    this.state = this.state.map((_, i) => ((bits.charCodeAt(i >> 3) >> (i & 7)) & 1) * REMOVED);
    if (!this.state.includes(REMOVED)) this.steps = [];
    this.total = this.viewer.about.total;
    this.count();
    this.show();
  }

  // Rotates the object for another elevation of the input's camera, in degrees; the view stays.
  rotate(degrees) {
    const { viewer, edit } = this, { home, input } = viewer.about;
    viewer.turning = false;
    edit.elevation = degrees;
    home.elevation = (degrees * Math.PI) / 180;
    viewer.moving(() => { viewer.camera.tilt = home.elevation - input.elevation; });
    clearTimeout(this.later);
    this.later = setTimeout(() => parent.postMessage({ edit }, "*"), PAUSE);
  }

  // Takes the brush, or leaves it and what is marked.
  use(brush) {
    const { act } = this.viewer;
    act.paint = brush ? (...place) => this.paint(...place) : null;
    act.keys.Escape = brush ? () => this.use(false) : null; // else it closes a dialog
    byId("do-brush").setAttribute("aria-pressed", brush);
    document.documentElement.classList.toggle("brushing", brush);
    byId("ring").hidden = true;
    if (brush && this.viewer.mode === "mesh") this.viewer.setMode("gaussians");
    if (!brush && this.state?.includes(MARKED)) {
      this.state = this.state.map((kind) => kind & REMOVED);
      this.show();
    }
  }

  // Marks along the last (dx, dy) pixels of the pointer's way to (x, y), or clears marks.
  paint(x, y, dx, dy, clear) {
    const { viewer, words } = this, [width, height] = viewer.shownSize(), { camera } = viewer;
    const rows = camera.rotation(), eye = camera.position(), focal = camera.focal(width, height);
    const means = new Float32Array(words.buffer), radius = Number(byId("brush-size").value);
    const along = ([a, b, c], at) => a * (means[at] - eye[0]) + b * (means[at + 1] - eye[1]) + c * (means[at + 2] - eye[2]);
    const state = this.state.map((kind, i) => {
      const depth = along(rows[2], 8 * i);
      if (kind === REMOVED || depth < 0.01) return kind;
      const u = (focal * along(rows[0], 8 * i)) / depth + width / 2 - x;
      const v = (focal * along(rows[1], 8 * i)) / depth + height / 2 - y;
      const t = Math.max(-1, Math.min(0, (u * dx + v * dy) / (dx * dx + dy * dy || 1)));
      return Math.hypot(u - t * dx, v - t * dy) < radius ? (clear ? 0 : MARKED) : kind;
    });
    if (viewer.wipe) viewer.setWipe(0);
    if (state.every((kind, i) => kind === this.state[i])) return;
    if (!this.begun) this.keep();
    this.begun = true;
    this.state = state;
    this.show();
  }

  remove() {
    if (!this.state.includes(MARKED)) return;
    if (!this.state.includes(0)) {
      say("This removes all Gaussians.");
      setTimeout(say, 3000, "");
      return;
    }
    this.keep();
    this.state = this.state.map((kind) => (kind ? REMOVED : 0));
    this.tell();
  }

  undo() {
    if (!this.steps.length) return;
    this.state = this.steps.pop();
    this.tell();
  }

  keep() {
    this.steps = [...this.steps, this.state].slice(-MOST_STEPS);
  }

  // Writes the states into the records on the graphics card.
  show() {
    const { words, looks, viewer: { renderer } } = this;
    this.state.forEach((kind, i) => {
      const [look, paint] = looks.subarray(2 * i, 2 * i + 2);
      words[8 * i + 3] = kind === REMOVED ? 0 : kind ? (look & 65535) | MARK[0] : look;
      words[8 * i + 4] = kind ? MARK[1] : paint;
    });
    renderer?.upload(0, words, 0, renderer.rows);
    byId("do-remove").disabled = !this.state.includes(MARKED);
    byId("do-undo").disabled = !this.steps.length;
    this.viewer.redraw();
  }

  // Shows the number of Gaussians that are left; what is removed cannot be looked at.
  count() {
    const { viewer, state } = this;
    viewer.about.total = this.total - state.reduce((sum, kind) => sum + (kind === REMOVED), 0);
    dressPage(viewer.about);
    viewer.send({ kind: "edit", states: state });
  }

  tell() {
    const bits = new Uint8Array(Math.ceil(this.state.length / 8)), { viewer, edit } = this;
    this.state.forEach((kind, i) => { bits[i >> 3] |= (kind === REMOVED) << (i & 7); });
    const removed = btoa(Array.from(bits, (byte) => String.fromCharCode(byte)).join(""));
    this.show();
    if (removed === edit.removed) return;
    edit.removed = removed;
    viewer.about.faces = 0; // the mesh was that of another object
    if (viewer.mode === "mesh") viewer.setMode("gaussians");
    if (viewer.wipe > 0) viewer.setWipe(0);
    this.count();
    parent.postMessage({ edit }, "*");
  }
}
