// Meshes of dropped files, shown with the Gaussians on the page: .glb, .obj and .stl, y up as gamba
// export writes them. Textures are reduced to their colours at the corners, as in pack.py.

const unread = (what) => new Error(`It has ${what}, which this page does not read; try: gamba view GAUSSIANS --mesh FILE`);
const NUMBERS = { 5121: ["Uint8", 1, 255], 5123: ["Uint16", 2, 65535], 5125: ["Uint32", 4, 1], 5126: ["Float32", 4, 1] };
const WIDTHS = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };
const GREY = [153, 153, 153]; // of a mesh without colours
const READ = ["POSITION", "NORMAL", "COLOR_0", "TEXCOORD_0"]; // attributes; normals are computed
const UNDRAWN = ["normalTexture", "occlusionTexture", "metallicRoughnessTexture"];
const displayed = (x) => 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
const linear = (byte) => (byte <= 10.31475 ? byte / 255 / 12.92 : ((byte / 255 + 0.055) / 1.055) ** 2.4);

function readStl(buffer) {
  const count = (buffer.byteLength - 84) / 50, view = new DataView(buffer);
  if (!Number.isInteger(count) || count < 1 || view.getUint32(80, true) !== count) throw unread("another form than binary .stl");
  const corners = Array.from({ length: 3 * count }, (_, i) =>
    [0, 1, 2].map((k) => view.getFloat32(96 + 50 * Math.floor(i / 3) + 12 * (i % 3) + 4 * k, true)));
  return { corners, colours: corners.map(() => GREY) };
}

function readObj(buffer) {
  const vertices = [], corners = [], colours = [];
  for (const line of new TextDecoder().decode(buffer).split("\n")) {
    const [word, ...values] = line.trim().split(/\s+/);
    if (word === "usemtl") throw unread("materials in other files");
    if (!["", "#", "v", "vn", "vt", "f", "g", "o", "s", "mtllib"].includes(word) && word[0] !== "#") throw unread(`lines ${word.slice(0, 20)}`);
    if (word === "v") {
      if (![3, 6].includes(values.length)) throw unread("vertices of other than 3 or 6 numbers");
      if (values.slice(3).some((x) => !(x >= 0 && x <= 1))) throw unread("colours outside of 0 to 1");
      vertices.push(values.map(Number));
    }
    if (word !== "f") continue;
    const found = values.map((text) => parseInt(text)).map((i) => (i ? vertices.at(i - (i > 0)) : undefined));
    for (let k = 2; k < found.length; k++)
      for (const vertex of [found[0], found[k - 1], found[k]]) {
        if (!vertex) throw new Error("A face names a vertex that is missing.");
        corners.push(vertex.slice(0, 3));
        colours.push(vertex.length > 5 ? vertex.slice(3, 6).map((x) => 255 * x) : GREY);
      }
  }
  return { corners, colours };
}

async function readGlb(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < 28 || view.getUint32(0, true) !== 0x46546c67) throw unread("another form than .glb");
  const length = view.getUint32(12, true), start = 28 + length;
  const tree = JSON.parse(new TextDecoder().decode(buffer.slice(20, 20 + length)));
  if (tree.extensionsUsed?.length) throw unread(`extensions (${tree.extensionsUsed.join(", ")})`);
  if (tree.animations || tree.skins) throw unread("animations or skins");
  const still = ({ matrix = [], translation, rotation, scale }) =>
    !translation && !rotation && !scale && matrix.every((x, k) => x === (k % 5 ? 0 : 1));
  const shown = tree.nodes.filter(({ mesh }) => mesh !== undefined);
  if (!tree.nodes.every(still) || new Set(shown.map(({ mesh }) => mesh)).size !== tree.meshes.length) throw unread("moved or unused parts");
  const rows = (index) => {
    const { componentType, type, count, bufferView, byteOffset = 0, sparse } = tree.accessors[index];
    const [kind, bytes, most] = NUMBERS[componentType], part = tree.bufferViews[bufferView], width = WIDTHS[type];
    if (sparse || part.buffer) throw unread("sparse or separate data");
    const at = start + (part.byteOffset || 0) + byteOffset, step = part.byteStride || bytes * width, scale = type === "SCALAR" ? 1 : most;
    return Array.from({ length: count }, (_, i) =>
      Array.from({ length: width }, (_, k) => view[`get${kind}`](at + i * step + k * bytes, true) / scale));
  };
  const corners = [], colours = [];
  for (const { primitives } of tree.meshes)
    for (const { attributes, indices, material, targets, mode = 4 } of primitives) {
      if (mode !== 4 || targets) throw unread("points, lines, strips or morph targets");
      const other = Object.keys(attributes).find((name) => !READ.includes(name));
      if (other) throw unread(`the attribute ${other}`);
      if (tree.accessors[attributes.POSITION].componentType !== 5126) throw unread("positions of integers");
      const [points, paint, uvs] = ["POSITION", "COLOR_0", "TEXCOORD_0"].map((name) => name in attributes ? rows(attributes[name]) : null);
      const look = tree.materials?.[material] || {};
      const { pbrMetallicRoughness = {}, emissiveFactor = [], emissiveTexture, alphaMode = "OPAQUE" } = look;
      const undrawn = UNDRAWN.find((name) => name in look || name in pbrMetallicRoughness);
      if (undrawn) throw unread(`a ${undrawn}`);
      if (alphaMode !== "OPAQUE") throw unread("transparent materials");
      const { baseColorFactor = [1, 1, 1], baseColorTexture } = pbrMetallicRoughness;
      if (emissiveTexture || emissiveFactor.some(Boolean) || baseColorTexture?.texCoord) throw unread("light of its own or a second texture");
      const texture = baseColorTexture && uvs ? await pixelsOf(tree, buffer, start, baseColorTexture.index) : null;
      for (const [i] of indices === undefined ? points.map((_, i) => [i]) : rows(indices)) {
        const seen = texture ? texture(...uvs[i]).map(linear) : [1, 1, 1];
        corners.push(points[i]);
        colours.push(!paint && material === undefined ? GREY : [0, 1, 2].map((k) => displayed(seen[k] * baseColorFactor[k] * (paint ? paint[i][k] : 1))));
      }
    }
  return { corners, colours };
}

// The colours of a texture, a function (u, v) of three bytes.
async function pixelsOf(tree, buffer, start, index) {
  const { bufferView, mimeType } = tree.images[tree.textures[index].source] || {}, part = tree.bufferViews[bufferView];
  if (!part) throw unread("images in other files");
  const at = start + (part.byteOffset || 0), content = new Blob([buffer.slice(at, at + part.byteLength)], { type: mimeType });
  const image = await createImageBitmap(content), { width, height } = image;
  const context = new OffscreenCanvas(width, height).getContext("2d");
  context.drawImage(image, 0, 0);
  const { data } = context.getImageData(0, 0, width, height);
  const place = (x, size) => Math.min(size - 1, Math.floor((x - Math.floor(x)) * size));
  return (u, v) => [...data.subarray(4 * (place(v, height) * width + place(u, width))).subarray(0, 3)];
}

// The mesh of a file in the frame of the shown object, packed as pack_mesh of pack.py does.
async function packedMesh(name, buffer, frame) {
  const kind = /\.(glb|obj|stl)$/i.exec(name)[1].toLowerCase();
  const reader = { glb: readGlb, obj: readObj, stl: readStl }[kind];
  const { corners, colours } = await Promise.resolve(buffer).then(reader).catch((error) => {
    throw error.constructor === Error ? error : new Error("The file is damaged."); // an error of the parser
  });
  if (!corners.length || corners.length % 3) throw new Error("It has no triangles.");
  if (!corners.flat().every(Number.isFinite)) throw new Error("A vertex is not finite.");
  const found = new Map(); // equal corners are one vertex, with one normal, except in an .stl
  const faces = corners.map((corner, i) => {
    const colour = colours[i].map((x) => Math.round(Math.max(0, Math.min(255, x)))), key = kind === "stl" ? i : [corner, colour].join();
    if (!found.has(key)) found.set(key, { place: found.size, corner, colour });
    return found.get(key).place;
  });
  const count = found.size, bytes = new ArrayBuffer(16 * count + 4 * faces.length);
  const floats = new Float32Array(bytes, 0, 3 * count), rgba = new Uint8Array(bytes, 12 * count, 4 * count);
  for (const { place, corner, colour } of found.values()) {
    floats.set(corner.map((x, k) => (x * (k ? -1 : 1) - frame.center[k]) / frame.size), 3 * place);
    rgba.set([...colour, 255], 4 * place);
  }
  new Uint32Array(bytes, 16 * count).set(faces);
  return { mesh: bytes, vertices: count, faces: faces.length / 3 };
}
