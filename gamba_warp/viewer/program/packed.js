// Packed Gaussians of dropped files, with the meaning of formats/gaussians/compressed.py and spz.py.

const SPZ_COLOUR = 0.15, SPZ_MAGIC = 0x5053474e;
// Signs of the harmonics' coefficients when y and z change theirs: from OpenGL's axes to OpenCV's.
const HALF_TURN = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];

// A quaternion from the number of its largest part and the other three.
function smallestThree(largest, three) {
  const quat = three.slice();
  quat.splice(largest, 0, Math.sqrt(Math.max(0, 1 - three.reduce((sum, x) => sum + x * x, 0))));
  return quat;
}

function splitWord(word, bits) {
  let shift = 32;
  return bits.map((width) => {
    shift -= width;
    return ((word >>> shift) & ((1 << width) - 1)) / ((1 << width) - 1);
  });
}

function emptyGaussians(count, degree) {
  const [means, scales, quats, opacities, colors, harmonics] =
    [3, 3, 4, 1, 3, 3 * ((degree + 1) ** 2 - 1)].map((size) => new Float32Array(size * count));
  return { count, degree, means, scales, quats, opacities, colors, harmonics };
}

// `elements` are those of the header, by name, each a function (row, property) of numbers.
function readCompressed({ chunk, vertex, sh }, { antialiased }) {
  const rest = sh ? sh.names.length / 3 : 0, { count } = vertex;
  if (![0, 3, 8, 15].includes(rest) || (sh && sh.count !== count)) throw new Error(OTHER);
  if (chunk.count !== Math.ceil(count / 256)) throw new Error("Its chunks do not match its Gaussians.");
  const made = { ...emptyGaussians(count, Math.sqrt(rest + 1) - 1), antialiased };
  const bounded = chunk.names.includes("min_r"); // early writers kept colours without bounds
  for (let i = 0; i < count; i++) {
    const between = (names, steps) => names.map((name, k) => {
      const [low, high] = ["min_", "max_"].map((end) => chunk.get(i >> 8, end + name));
      return low * (1 - steps[k]) + high * steps[k];
    });
    const [position, rotation, scale, color] = ["position", "rotation", "scale", "color"].map(
      (name) => vertex.get(i, `packed_${name}`));
    const rgba = splitWord(color, [8, 8, 8, 8]), three = splitWord(rotation << 2, [10, 10, 10]);
    made.means.set(between(["x", "y", "z"], splitWord(position, [11, 10, 11])), 3 * i);
    const logs = between(["scale_x", "scale_y", "scale_z"], splitWord(scale, [11, 10, 11]));
    made.scales.set(logs.map(Math.exp), 3 * i);
    made.quats.set(smallestThree(rotation >>> 30, three.map((x) => (x - 0.5) * Math.SQRT2)), 4 * i);
    made.opacities[i] = rgba[3];
    made.colors.set(bounded ? between(["r", "g", "b"], rgba) : rgba.slice(0, 3), 3 * i);
    for (let k = 0; k < 3 * rest; k++) {
      const level = sh.get(i, `f_rest_${(k % 3) * rest + Math.floor(k / 3)}`);
      const step = level === 0 ? 0 : level === 255 ? 1 : (level + 0.5) / 256;
      made.harmonics[3 * rest * i + k] = 8 * (step - 0.5);
    }
  }
  return made;
}

async function readSpz(buffer) {
  if (new DataView(buffer.slice(0, 4)).getUint16(0) !== 0x1f8b) throw new Error(OTHER);
  const stream = new Blob([buffer]).stream().pipeThrough(new DecompressionStream("gzip"));
  const body = await new Response(stream).arrayBuffer().catch(() => {
    throw new Error("The file is damaged.");
  });
  const view = new DataView(body), [magic, version, count] = [0, 4, 8].map((at) => body.byteLength < 16 ? 0 : view.getUint32(at, true));
  if (magic !== SPZ_MAGIC || version < 2 || version > 3) throw new Error(OTHER);
  const [degree, bits, flags] = [12, 13, 14].map((at) => view.getUint8(at));
  const rest = (degree + 1) ** 2 - 1, sizes = [9, 1, 3, 3, version > 2 ? 4 : 3, 3 * rest];
  let start = 16;
  const starts = sizes.map((size) => (start += size * count) - size * count);
  if (degree > 3 || bits > 30 || start !== body.byteLength) throw new Error("The file is damaged.");
  const bytes = new Uint8Array(body), made = { ...emptyGaussians(count, degree), antialiased: !!(flags & 1) };
  for (let i = 0; i < count; i++) {
    const [p, a, c, s, q, h] = starts.map((at, kind) => at + i * sizes[kind]);
    for (let k = 0; k < 3; k++) {
      const at = p + 3 * k, fixed = (bytes[at] << 8 | bytes[at + 1] << 16 | bytes[at + 2] << 24) >> 8;
      made.means[3 * i + k] = (fixed / 2 ** bits) * (k ? -1 : 1);
      made.colors[3 * i + k] = ((bytes[c + k] / 255 - 0.5) / SPZ_COLOUR) * SH_C0 + 0.5;
      made.scales[3 * i + k] = Math.exp(bytes[s + k] / 16 - 10);
    }
    made.opacities[i] = bytes[a] / 255;
    const [x, y, z, w] = version > 2 ? spzTurn(view.getUint32(q, true)) : oldTurn(bytes.subarray(q, q + 3));
    made.quats.set([w, x, -y, -z], 4 * i);
    for (let k = 0; k < 3 * rest; k++)
      made.harmonics[3 * rest * i + k] = ((bytes[h + k] - 128) / 128) * HALF_TURN[Math.floor(k / 3)];
  }
  return made;
}

function spzTurn(word) {
  const three = [20, 10, 0].map((shift) => {
    const part = word >>> shift, size = ((part & 511) / 511) * Math.SQRT1_2;
    return part & 512 ? -size : size;
  });
  return smallestThree(word >>> 30, three);
}

function oldTurn(bytes) {
  return smallestThree(3, [...bytes].map((byte) => byte / 127.5 - 1));
}
