// The viewer: loads the object, and redraws on changes. In motion it draws as
// sharply and completely as the frame time allows; at rest, everything at full size.

const SETTLE = 160; // milliseconds after the last motion
const SIZES = [1, 0.8, 0.64, 0.5, 0.4, 0.32]; // fractions of the canvas's sides, in motion
const SLOW = 42, QUICK = 21; // milliseconds of a frame: above, less is drawn; below, more
const PIECE = 131072; // Gaussians drawn at once at rest
const LEAST = 40000; // Gaussians that are always drawn
const TURN = (2 * Math.PI) / 30000; // radians per millisecond, until the object is touched

class Viewer {
  constructor(canvas, about) {
    Object.assign(this, { canvas, about, showInput: false });
    this.changed = this.asked = -Infinity;
    this.waiting = [];
    this.picks = new Map();
    this.stats = { frames: 0, sorts: 0, cost: 0 };
    this.act = {
      turn: (dx, dy) => this.moving(() => this.camera.turn(...[dx, dy].map((d) => d * this.perPixel()))),
      pan: (dx, dy) => this.moving(() => this.camera.pan(dx, dy, this.camera.focal(...this.shownSize()))),
      zoom: (factor) => this.moving(() => this.camera.zoom(factor)),
      focus: (x, y) => this.focus(x, y),
    };
    this.camera = new OrbitCamera(about.home, about.home.fov);
    this.choose = asked("controls") === "0" ? () => {} : takeFiles(this);
    this.act.keys = startButtons(this);
    this.editor = new Editor(this);
    this.turning = !matchMedia("(prefers-reduced-motion: reduce)").matches && asked("turn") !== "0";
    for (const kind of ["pointerdown", "wheel", "keydown"])
      window.addEventListener(kind, () => { this.turning = false; }, { capture: true, passive: true });
    this.send = startSorter((message) => this[message.kind](message));
  }

  perPixel() {
    return Math.PI / Math.max(240, Math.min(...this.shownSize()));
  }

  shownSize() {
    return [this.canvas.clientWidth || 1, this.canvas.clientHeight || 1];
  }

  start() {
    const gl = this.canvas.getContext("webgl2", { antialias: false, alpha: true, powerPreference: "high-performance" });
    if (!gl) return say("It needs WebGL2 to show the object in 3D.", "This browser cannot show it");
    this.gl = gl;
    const text = (name) => {
      const element = byId(name), found = element ? element.textContent : "";
      element?.remove(); // frees the text, which may be large
      return found;
    };
    this.open(this.about, { gaussians: text("gaussians"), harmonics: text("harmonics"), mesh: text("mesh") });
    takeHands(this.canvas, this.act);
    this.canvas.addEventListener("webglcontextlost", () => {
      this.renderer = null;
      say("The graphics card was needed elsewhere. Load the page again to go on.", "Stopped");
    });
    new ResizeObserver(() => this.redraw()).observe(this.canvas);
  }

  // Shows an object, instead of one that is shown; `parts` are base64 or buffers.
  open(about, parts) {
    if (!Renderer.fits(this.gl, about.count, about.degree))
      return say("It has more Gaussians than this graphics card takes.", "Too many");
    this.renderer?.free();
    this.renderer = new Renderer(this.gl, about.count, about.degree, about.antialiased);
    this.camera = new OrbitCamera(about.home, about.home.fov);
    this.coarse = this.quick = 0; // index into SIZES; quick frames in a row
    this.some = about.count; // Gaussians drawn in motion
    this.ready = this.shownOnce = this.showInput = false;
    this.fence = this.spare = this.sortedFor = this.askedFor = null;
    this.about = about;
    dressPage(about);
    this.setWipe(0);
    this.setMode(about.count ? "gaussians" : "mesh");
    this.send({ kind: "load", ...parts, vertices: about.vertices, faces: about.faces });
  }

  // Unpacked words from the sorter, uploaded in pieces, one per frame.
  loaded({ records, harmonics, mesh }) {
    const { renderer } = this, parts = [];
    const cut = (unit, words, rows) => {
      for (let row = 0; row < rows; row += 128)
        parts.push(() => renderer.upload(unit, words, row, Math.min(128, rows - row)));
    };
    cut(0, new Uint32Array(records), renderer.rows);
    if (this.about.degree) cut(1, new Uint32Array(harmonics), renderer.harmonicRows);
    if (mesh) parts.push(() => renderer.setMesh(mesh));
    const next = () => {
      parts.shift()();
      if (parts.length) return requestAnimationFrame(next);
      this.ready = true;
      this.editor.load(records, this.about.edit);
      this.redraw();
    };
    next();
  }

  // Shows another mesh with the object, as packedMesh returns it.
  addMesh(packed) {
    this.about.faces = packed.faces;
    dressPage(this.about);
    this.send({ kind: "addMesh", ...packed });
  }

  meshed({ mesh }) {
    if (!this.renderer) return;
    this.renderer.setMesh(mesh);
    this.setMode("mesh");
  }

  sorted({ buffer, used, id }) {
    if (!this.renderer || !this.ready) return; // not an order of the former object
    this.renderer.setOrder(new Uint32Array(buffer), used);
    this.spare = buffer;
    this.sortedFor = id;
    this.askedFor = null;
    this.stats.sorts++;
    this.finished = false;
    this.progress = 0;
    this.schedule();
  }

  picked({ depth, id }) {
    this.picks.get(id)(depth);
    this.picks.delete(id);
  }

  moving(change) {
    if (this.wipe < 0) this.setWipe(0); // the image is of the first view only
    change();
    this.redraw();
  }

  redraw() {
    this.changed = performance.now();
    this.finished = false;
    this.progress = 0;
    this.schedule();
  }

  schedule() {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((now) => {
      this.scheduled = false;
      if (this.ready && this.renderer) this.frame(now);
    });
  }

  // True if the graphics card has finished the last draw.
  idle(now) {
    if (!this.fence) return true;
    const { gl } = this, state = gl.clientWaitSync(this.fence, 0, 0);
    if (state === gl.TIMEOUT_EXPIRED && now - this.asked < 4000) return false;
    gl.deleteSync(this.fence);
    this.fence = null;
    this.stats.cost = now - this.asked;
    if (this.fast) this.adapt(this.stats.cost);
    return true;
  }

  ask(now, fast) {
    this.fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.asked = now;
    this.fast = fast;
  }

  // First fewer pixels, then fewer Gaussians (the smallest are last); the reverse
  // once several frames in a row were quick.
  adapt(cost) {
    const { count } = this.about;
    this.quick = cost < QUICK ? this.quick + 1 : 0;
    if (cost > SLOW) {
      const last = SIZES.length - 1, least = Math.min(count, LEAST), far = cost > 8 * SLOW;
      if (far || this.coarse === last)
        this.some = Math.max(least, Math.round(this.some * Math.max(0.1, SLOW / cost)));
      this.coarse = Math.min(last, this.coarse + (far ? last : cost > 3 * SLOW ? 2 : 1));
    } else if (this.quick >= 6) {
      this.quick = 0;
      if (this.some < count) this.some = Math.min(count, Math.round(this.some * 1.3));
      else this.coarse = Math.max(0, this.coarse - 1);
    }
  }

  frame(now) {
    if (!this.idle(now)) return this.schedule();
    if (this.camera.step(now) || this.turn(now)) this.changed = now;
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const [width, height] = this.fixed || this.shownSize().map((side) => Math.round(side * ratio));
    const { renderer } = this;
    if (renderer.resize(width, height)) {
      this.progress = 0;
      this.finished = false;
      this.changed = now;
    }
    const fast = now - this.changed < SETTLE && this.shownOnce;
    const ordered = this.sortNow(fast ? this.some : this.about.count);
    if (fast) {
      // An order of all begins with the farthest, so wait for one of the drawn ones only.
      if (renderer.ordered === this.some || this.mode !== "gaussians") {
        renderer.draw(this.mode, this.camera, background(), SIZES[this.coarse], 0, this.some);
        this.show(now, true);
      }
      this.finished = false;
      this.progress = 0;
    } else if (!this.finished && ordered) this.drawRest(now);
    if (fast || this.turning || (!this.finished && ordered)) this.schedule();
  }

  // Turns the object a little, however slow the frames are; returns true if it does.
  turn(now) {
    if (!this.turning || !this.shownOnce) return false;
    this.camera.azimuth -= TURN * Math.min(100, now - (this.turnedAt ?? now));
    this.turnedAt = now;
    return true;
  }

  // One more piece of the image at full size.
  drawRest(now) {
    const { renderer } = this, all = this.mode === "gaussians" ? renderer.ordered : 1;
    const to = Math.min(all, this.progress + PIECE);
    renderer.draw(this.mode, this.camera, background(), 1, this.progress, to);
    this.progress = to;
    if (to < all) return this.ask(now, false);
    this.show(now, false);
    this.finished = true;
    if (!this.shownOnce) say("");
    this.shownOnce = true;
    for (const resolve of this.waiting.splice(0)) resolve();
  }

  show(now, fast) {
    if (this.wipe > 0)
      this.renderer.draw("mesh", this.camera, background(), fast ? SIZES[this.coarse] : 1, 0, 0, this.wipe);
    this.renderer.present();
    this.ask(now, fast);
    this.stats.frames++;
    // If frames are slow, hide the lines and the blur above them.
    const slow = fast && this.coarse >= SIZES.length / 2;
    document.documentElement.classList.toggle("slow", slow);
    const { input } = this.about, visible = input && this.showInput && !slow;
    byId("lines").firstElementChild.setAttribute("d", visible ? inputLines(input, this.camera, ...this.shownSize()) : "");
  }

  // Requests the order for the camera; returns true if it exists already.
  sortNow(wanted) {
    if (this.mode !== "gaussians") return true;
    const forward = this.camera.rotation()[2], id = [...forward, wanted].join();
    if (this.sortedFor === id) return true;
    if (this.askedFor === null) {
      this.askedFor = id;
      const buffer = this.spare;
      this.spare = null;
      this.send({ kind: "sort", forward, wanted, buffer, id }, buffer ? [buffer] : []);
    }
    return false;
  }

  setMode(mode) {
    if (!this.about[mode === "mesh" ? "faces" : "count"]) return;
    this.mode = mode;
    for (const button of document.querySelectorAll("[data-mode]"))
      button.setAttribute("aria-pressed", button.dataset.mode === mode);
    this.redraw();
  }

  // Compares with the input's image (to -1), from its camera, or with the mesh (to 1).
  setWipe(wipe) {
    if (wipe < 0 && !(this.wipe < 0)) this.goHome();
    this.wipe = wipe;
    showWipe(wipe);
    this.redraw();
  }

  toggleInput() {
    if (!this.about.input) return;
    this.showInput = !this.showInput;
    byId("do-input").setAttribute("aria-pressed", this.showInput);
    this.redraw();
  }

  travel(where) {
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.camera.go(where, performance.now(), still ? 0 : 320);
    this.redraw();
  }

  goHome() {
    this.travel(this.about.home);
  }

  // Moves the point under the pointer to the middle, and a little nearer.
  async focus(x, y) {
    const [width, height] = this.shownSize(), { camera } = this, focal = camera.focal(width, height);
    const origin = camera.position(), ray = camera.ray(x - width / 2, y - height / 2, focal);
    const id = Math.random();
    const depth = await new Promise((resolve) => {
      this.picks.set(id, resolve);
      this.send({ kind: "pick", origin, ray, mode: this.mode, width: 4 / focal, id });
    });
    if (depth === null) return;
    this.travel({ target: origin.map((value, k) => value + depth * ray[k]), distance: Math.max(0.1, 0.8 * camera.distance) });
  }

  // Resolves when the image of the current camera is complete.
  rest() {
    this.turning = false;
    this.schedule();
    return new Promise((resolve) => {
      if (this.finished && !this.camera.goal && this.ready) resolve();
      else this.waiting.push(resolve);
    });
  }

  // Saves the image, with its longer side of that many pixels, or as shown.
  async save(side) {
    const shown = this.shownSize(), scale = side / Math.max(...shown);
    this.fixed = side ? shown.map((length) => Math.max(1, Math.round(length * scale))) : null;
    if (side) this.redraw();
    await this.rest();
    this.renderer.present();
    saveImage(this.canvas, this.about.title);
    this.fixed = null;
    if (side) this.redraw();
  }

  // For programs: an image of the canvas, as a data URL.
  async png() {
    await this.rest();
    this.renderer.present();
    return this.canvas.toDataURL("image/png");
  }

  // For programs: azimuth and elevation in radians, distance, target; missing values stay.
  setCamera(where) {
    this.camera.go(where, 0, 0);
    this.camera.step(1);
    this.redraw();
  }
}

window.gambaViewer = new Viewer(byId("canvas"), JSON.parse(byId("object").textContent));
window.gambaViewer.start();
