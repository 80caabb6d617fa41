// Files that are dropped on the page: Gaussians as .ply, compressed .ply, .splat or .spz. They are read
// with the meaning of formats/ply.py and formats/gaussians, and packed as pack.py packs them.

const HOME = { azimuth: 0, elevation: 0, distance: 1.5, target: [0, 0, 0], fov: 49.1 }; // of gamba view
const SH_C0 = 0.28209479177387814, FAINTEST = 1 / 255, LARGEST = 6e4;
const SCALARS = {
  char: ["Int8", 1], uchar: ["Uint8", 1], short: ["Int16", 2], ushort: ["Uint16", 2], int: ["Int32", 4],
  uint: ["Uint32", 4], float: ["Float32", 4], double: ["Float64", 8], int8: ["Int8", 1], uint8: ["Uint8", 1],
  int16: ["Int16", 2], uint16: ["Uint16", 2], int32: ["Int32", 4], uint32: ["Uint32", 4],
  float32: ["Float32", 4], float64: ["Float64", 8],
};
const HERE = "Only Gaussians (.ply, .splat, .spz) and meshes (.glb, .obj, .stl) open here";
const OTHER = `${HERE}; for this file try: gamba view FILE`;
const KNOWN = /^([xyz]|n[xyz]|f_dc_[012]|f_rest_\d+|opacity|scale_[012]|rot_[0-3]|red|green|blue|alpha|packed_\w+)$/;

// Elements of a .ply by name, each with its count, the names of its properties and `get`, or an
// error with a reason for the user.
function plyElements(buffer) {
  const head = new TextDecoder("latin1").decode(buffer.slice(0, 65536));
  const end = /(^|\n)end_header\r?\n/.exec(head);
  const lines = end ? head.slice(0, end.index).split(/\r?\n/) : [];
  if (!lines.includes("format binary_little_endian 1.0") || lines.includes("comment frame opengl")) throw new Error(OTHER);
  const elements = {};
  let element;
  for (const line of lines) {
    const [word, type, name] = line.split(" ");
    if (word === "element") element = elements[type] = { count: Number(name), columns: {}, names: [], size: 0 };
    if (word !== "property") continue;
    if (!element || !(type in SCALARS) || name in element.columns) throw new Error(OTHER);
    element.columns[name] = { at: element.size, read: `get${SCALARS[type][0]}` };
    element.names.push(name);
    element.size += SCALARS[type][1];
  }
  let start = end.index + end[0].length;
  for (const each of Object.values(elements)) {
    const length = each.count * each.size;
    if (!Number.isInteger(each.count)) throw new Error(OTHER);
    if (start + length > buffer.byteLength) throw new Error("The file is cut short.");
    const view = new DataView(buffer, start);
    each.get = (row, name) => {
      if (!(name in each.columns)) throw new Error(OTHER);
      const { at, read } = each.columns[name];
      return view[read](row * each.size + at, true);
    };
    start += length;
  }
  const { vertex } = elements, known = elements.chunk ? ["chunk", "vertex", "sh"] : ["vertex"];
  if (!vertex || Object.keys(elements).some((name) => !known.includes(name))) throw new Error(OTHER);
  if (start < buffer.byteLength) throw new Error(`It has more than its ${vertex.count} Gaussians. ${OTHER}`);
  return [elements, { antialiased: lines.includes("comment SplatRenderMode: mip") }];
}

function readPly(buffer) {
  const [elements, about] = plyElements(buffer), { vertex } = elements, { count, names } = vertex;
  const unread = names.filter((name) => !KNOWN.test(name));
  if (unread.length) throw new Error(`The properties ${unread.slice(0, 5).join(", ")} are not read here; try: gamba view FILE`);
  if (elements.chunk) return readCompressed(elements, about);
  const read = (wanted, change = (x) => x) => {
    const values = new Float32Array(count * wanted.length);
    wanted.forEach((name, k) => {
      for (let i = 0; i < count; i++) values[i * wanted.length + k] = change(vertex.get(i, name));
    });
    return values;
  };
  const several = (name, number) => Array.from({ length: number }, (_, i) => `${name}_${i}`);
  const rest = names.filter((name) => name.startsWith("f_rest_")).length / 3;
  if (![0, 3, 8, 15].includes(rest)) throw new Error(OTHER);
  const byColor = several("f_rest", 3 * rest); // all of red, then of green, then of blue
  return {
    count, ...about, means: read(["x", "y", "z"]), scales: read(several("scale", 3), Math.exp), quats: read(several("rot", 4)),
    opacities: read(["opacity"], (x) => 1 / (1 + Math.exp(-x))), colors: read(several("f_dc", 3), (x) => x * SH_C0 + 0.5),
    harmonics: read(byColor.map((_, i) => byColor[(i % 3) * rest + Math.floor(i / 3)])), degree: Math.sqrt(rest + 1) - 1,
  };
}

function readSplat(buffer) {
  const count = buffer.byteLength / 32;
  if (!Number.isInteger(count)) throw new Error("The file is cut short, or no .splat.");
  const floats = new Float32Array(buffer), bytes = new Uint8Array(buffer);
  const take = (source, width, at, number, change = (x) => x) =>
    Float32Array.from({ length: number * count }, (_, i) => change(source[Math.floor(i / number) * width + at + (i % number)]));
  return {
    count, means: take(floats, 8, 0, 3), scales: take(floats, 8, 3, 3), colors: take(bytes, 32, 24, 3, (x) => x / 255),
    opacities: take(bytes, 32, 27, 1, (x) => x / 255), quats: take(bytes, 32, 28, 4, (x) => (x - 128) / 128),
    harmonics: new Float32Array(0), degree: 0,
  };
}

// Numbers of the Gaussians that are seen, those with the largest area first.
function visibleOf({ count, means, scales, opacities, colors, quats, harmonics }) {
  const finite = (values, i, number) => values.subarray(i * number, (i + 1) * number).every(Number.isFinite);
  const area = new Float64Array(count), found = [];
  let bad = 0;
  for (let i = 0; i < count; i++) {
    const [a, b, c] = scales.subarray(3 * i, 3 * i + 3);
    const valid = [[means, 3], [scales, 3], [colors, 3], [quats, 4], [opacities, 1], [harmonics, harmonics.length / count]]
      .every(([values, number]) => finite(values, i, number));
    if (!valid || Math.min(a, b, c) < 0 || !quats.subarray(4 * i, 4 * i + 4).some((x) => x)) bad++;
    else if (opacities[i] >= FAINTEST) found.push(i);
    area[i] = (opacities[i] * a * b * c) / Math.min(a, b, c) || 0;
  }
  if (bad) throw new Error(`${bad} of ${count} Gaussians are invalid; gamba view --drop-bad leaves them out.`);
  if (!found.length) throw new Error("No Gaussian has an opacity of 1/255 or more.");
  return found.sort((i, j) => area[j] - area[i]);
}

// The object's centre and longest side, as own_frame of pack.py.
function frameOf({ means, scales, opacities }, seen) {
  const least = Math.min(0.05, seen.reduce((most, i) => Math.max(most, opacities[i]), 0));
  const solid = seen.filter((i) => opacities[i] >= least);
  const ends = [0, 1, 2].map((k) => {
    const sorted = Float32Array.from(solid, (i) => means[3 * i + k]).sort();
    return [0.005, 0.995].map((fraction) => {
      const place = fraction * (sorted.length - 1), low = Math.floor(place), high = Math.min(low + 1, sorted.length - 1);
      return sorted[low] + (place - low) * (sorted[high] - sorted[low]);
    });
  });
  const sizes = Float32Array.from({ length: 3 * seen.length }, (_, i) => scales[3 * seen[Math.floor(i / 3)] + (i % 3)]).sort();
  const size = Math.max(...ends.map(([low, high]) => high - low), 4 * sizes[(sizes.length - 1) >> 1]);
  if (!(size > 0 && size < Infinity)) throw new Error("All Gaussians are at one point.");
  return { center: ends.map(([low, high]) => (low + high) / 2), size };
}

// The object and its records, in the arguments of Viewer.open.
async function packedFile(name, buffer) {
  if (!globalThis.Float16Array) throw new Error("This browser is too old to open files; use gamba view.");
  const kind = /\.(ply|splat|spz)$/i.exec(name)?.[1].toLowerCase();
  if (!kind) throw new Error(`${HERE}.`);
  const file = await { ply: readPly, splat: readSplat, spz: readSpz }[kind](buffer);
  const seen = visibleOf(file), frame = frameOf(file, seen), { degree, antialiased = false } = file;
  const records = new ArrayBuffer(32 * seen.length), clip = (x) => Math.max(-LARGEST, Math.min(LARGEST, x));
  const floats = new Float32Array(records), halves = new Float16Array(records), shorts = new Int16Array(records);
  const numbers = file.harmonics.length / file.count, width = Math.ceil(numbers / 8) * 8;
  const harmonics = new Float16Array(width * seen.length);
  seen.forEach((i, row) => {
    const q = file.quats.subarray(4 * i, 4 * i + 4), norm = Math.hypot(...q) * (q[0] < 0 ? -1 : 1);
    for (let k = 0; k < 3; k++) {
      const color = file.colors[3 * i + k];
      floats[8 * row + k] = (file.means[3 * i + k] - frame.center[k]) / frame.size;
      halves[16 * row + 7 + k] = clip(color);
      halves[16 * row + 10 + k] = clip(file.scales[3 * i + k] / frame.size);
      shorts[16 * row + 13 + k] = Math.round((32767 * q[k + 1]) / norm / (1 + q[0] / norm));
    }
    halves[16 * row + 6] = file.opacities[i];
    for (let k = 0; k < numbers; k++) harmonics[width * row + k] = clip(file.harmonics[numbers * i + k]);
  });
  const about = { title: name, note: "", total: file.count, count: seen.length, degree, antialiased, vertices: 0, faces: 0, home: HOME, input: null, frame };
  return [about, { gaussians: records, harmonics: harmonics.buffer, mesh: "" }];
}

// Opens files that are dropped, or chosen after `choose`, which is returned.
function takeFiles(viewer) {
  const root = document.documentElement, input = document.createElement("input");
  const read = async (file) => {
    if (!file) return;
    try {
      const content = await file.arrayBuffer(), { frame } = viewer.about;
      if (/\.(glb|obj|stl)$/i.test(file.name)) viewer.addMesh(await packedMesh(file.name, content, frame));
      else viewer.open(...await packedFile(file.name, content));
    } catch (error) {
      say(error.message, `Cannot open ${file.name}`);
      setTimeout(say, 6000, "");
    }
  };
  input.type = "file";
  input.accept = ".ply,.splat,.spz,.glb,.obj,.stl";
  input.onchange = () => read(input.files[0]).then(() => { input.value = ""; });
  for (const kind of ["dragover", "dragleave", "drop"])
    window.addEventListener(kind, (event) => {
      event.preventDefault();
      root.classList.toggle("drop", kind === "dragover");
      if (kind === "drop") read(event.dataTransfer.files[0]);
    });
  return () => input.click();
}
