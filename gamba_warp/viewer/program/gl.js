// Drawing of the object into a texture of any size, and of that onto the canvas. An image that
// is drawn in several pieces, over several frames, is shown once it is complete.

const ROW = 1024; // Gaussians in a row of the texture: pack.py's records, two texels each
const TEXELS = [0, 2, 3, 6]; // of the harmonics, by degree

function glProgram(gl, vertex, fragment, attributes = []) {
  const program = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  attributes.forEach((name, place) => gl.bindAttribLocation(program, place, name));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error([gl.getProgramInfoLog(program), ...logs].join("\n"));
  }
  const places = {};
  const set = (name, kind, ...values) => {
    if (!(name in places)) places[name] = gl.getUniformLocation(program, name);
    gl[`uniform${kind}`](places[name], ...values);
  };
  return { program, set };
}

class Renderer {
  constructor(gl, count, degree, antialiased) {
    Object.assign(this, { gl, count, degree, antialiased, ordered: 0, width: 0, height: 0 });
    this.splats = glProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.points = glProgram(gl, POINT_VERTEX, POINT_FRAGMENT);
    this.surface = glProgram(gl, MESH_VERTEX, MESH_FRAGMENT, ["vertex", "normal", "paint"]);
    this.shown = glProgram(gl, PRESENT_VERTEX, PRESENT_FRAGMENT);
    this.rows = Math.ceil(count / ROW);
    this.harmonicRows = Math.ceil((count * TEXELS[degree]) / 2048);
    this.records = this.table(0, this.rows, gl.RGBA32UI);
    this.harmonics = this.table(1, this.harmonicRows, gl.RGBA32UI);
    this.order = this.table(2, Math.ceil(count / 2048), gl.R32UI);
    this.empty = gl.createVertexArray();
    this.makeSplats();
    this.makeTarget();
  }

  static fits(gl, count, degree) {
    const rows = Math.max(count / ROW, (count * TEXELS[degree]) / 2048);
    return rows <= gl.getParameter(gl.MAX_TEXTURE_SIZE);
  }

  // Frees the memory on the graphics card, all but that of a mesh, which goes with this object.
  free() {
    const { gl } = this;
    for (const texture of [this.records, this.harmonics, this.order, this.image]) gl.deleteTexture(texture);
    gl.deleteRenderbuffer(this.depth);
    gl.deleteFramebuffer(this.frame);
  }

  table(unit, rows, format) {
    const { gl } = this, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, 2048, Math.max(1, rows));
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
  }

  // The corners of a batch of rectangles; their Gaussians are looked up in the order.
  makeSplats() {
    const { gl } = this, corners = new Uint16Array(6 * BATCH);
    for (let i = 0; i < BATCH; i++) corners.set([0, 1, 2, 2, 1, 3].map((k) => 4 * i + k), 6 * i);
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  makeTarget() {
    const { gl } = this;
    this.frame = gl.createFramebuffer();
    this.depth = gl.createRenderbuffer();
    this.image = gl.createTexture();
    gl.activeTexture(gl.TEXTURE3);
    gl.bindTexture(gl.TEXTURE_2D, this.image);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  }

  // Uploads rows of a table of words, of `unit` 0 the records, 1 the harmonics; pads the last row.
  upload(unit, words, first, rows) {
    const { gl } = this, size = 2048 * 4;
    let part = words.subarray(first * size, (first + rows) * size);
    if (part.length < rows * size) {
      const filled = new Uint32Array(rows * size);
      filled.set(part);
      part = filled;
    }
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, 2048, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, part);
  }

  // `order` has `used` places, and as many more as fill the last row of 2048.
  setOrder(order, used) {
    const { gl } = this, rows = Math.ceil(used / 2048);
    gl.activeTexture(gl.TEXTURE2);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 2048, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    this.ordered = used;
  }

  setMesh({ vertices, normals, colours, faces }) {
    const { gl } = this;
    this.meshArray = gl.createVertexArray();
    gl.bindVertexArray(this.meshArray);
    for (const [place, values, size] of [[0, vertices, 3], [1, normals, 3], [2, colours, 4]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      const bytes = values instanceof Uint8Array;
      gl.vertexAttribPointer(place, size, bytes ? gl.UNSIGNED_BYTE : gl.FLOAT, bytes, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.corners = faces.length;
  }

  // Allocates the largest image, of which smaller ones use a part. Returns true if it changed.
  resize(width, height) {
    if (width === this.width && height === this.height) return false;
    const { gl } = this;
    Object.assign(this, { width, height });
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.activeTexture(gl.TEXTURE3);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
    gl.bindRenderbuffer(gl.RENDERBUFFER, this.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.depth);
    return true;
  }

  // Draws one piece: Gaussians `from` to `to` of the order, or all of the centres or of the mesh,
  // in the left `fraction` of the image.
  draw(mode, camera, background, scale, from, to, fraction = 1) {
    const { gl } = this;
    const width = Math.max(1, Math.round(this.width * scale)), height = Math.max(1, Math.round(this.height * scale));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, 0, Math.round(fraction * width), height);
    if (from === 0) {
      gl.clearColor(...background);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    }
    const { program, set } = { gaussians: this.splats, centres: this.points, mesh: this.surface }[mode];
    gl.useProgram(program);
    const rows = camera.rotation();
    set("view", "Matrix3fv", false, [0, 1, 2].flatMap((k) => rows.map((row) => row[k])));
    set("eye", "3fv", camera.position());
    set("size", "2f", width, height);
    set("focal", "1f", camera.focal(width, height));
    if (mode !== "mesh") {
      set("records", "1i", 0);
      set("harmonics", "1i", 1);
      set("degree", "1i", this.degree);
    }
    if (mode === "gaussians") this.drawSplats(set, from, to);
    else this.drawSolid(mode, set, height);
    gl.disable(gl.SCISSOR_TEST);
    this.part = [width, height];
  }

  drawSplats(set, from, to) {
    const { gl } = this;
    set("order", "1i", 2);
    set("first", "1ui", from);
    set("last", "1ui", to);
    set("antialiased", "1i", this.antialiased ? 1 : 0);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.quads);
    const batches = Math.ceil((to - from) / BATCH);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, batches);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }

  drawSolid(mode, set, height) {
    const { gl } = this;
    gl.enable(gl.DEPTH_TEST);
    if (mode === "mesh") {
      gl.bindVertexArray(this.meshArray);
      gl.drawElements(gl.TRIANGLES, this.corners, gl.UNSIGNED_INT, 0);
    } else {
      set("dot_size", "1f", Math.max(1.5, height / 260));
      gl.bindVertexArray(this.empty);
      gl.drawArrays(gl.POINTS, 0, this.count);
    }
    gl.bindVertexArray(null);
    gl.disable(gl.DEPTH_TEST);
  }

  // Copies the image to the canvas, which takes the image's size; the page scales it.
  present() {
    const { gl } = this, { canvas } = gl, [width, height] = this.part;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.useProgram(this.shown.program);
    this.shown.set("image", "1i", 3);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
  }
}
