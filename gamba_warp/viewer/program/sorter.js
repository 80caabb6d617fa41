// Heavy work off the main thread: unpacking, sorting by depth, finding the object below a
// point. It runs in a worker made from this function's text, or, without workers, in
// the page itself. So it uses no outer names.
function sorterProgram(post) {
  let words, means, count, mesh = null, depths, keys, states;
  const starts = new Uint32Array(65537);
  const halves = halfTable();

  function halfTable() {
    const table = new Float32Array(65536);
    for (let bits = 0; bits < 65536; bits++) {
      const exponent = (bits >> 10) & 31, fraction = bits & 1023;
      const size = exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24;
      table[bits] = bits & 32768 ? -size : size;
    }
    return table;
  }

  function bytesOf(base64) {
    if (base64 instanceof ArrayBuffer) return base64;
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64).buffer;
    const text = atob(base64), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return bytes.buffer;
  }

  // Vertex normals: sums of the adjacent faces' normals, weighted by area.
  function meshOf(base64, vertexCount, faceCount) {
    const bytes = bytesOf(base64);
    const vertices = new Float32Array(bytes, 0, 3 * vertexCount);
    const colours = new Uint8Array(bytes, 12 * vertexCount, 4 * vertexCount);
    const faces = new Uint32Array(bytes, 16 * vertexCount, 3 * faceCount);
    const normals = new Float32Array(3 * vertexCount);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const p = [0, 1, 2].map((k) => vertices[b + k] - vertices[a + k]);
      const q = [0, 1, 2].map((k) => vertices[c + k] - vertices[a + k]);
      for (let k = 0; k < 3; k++) {
        const [i, j] = [(k + 1) % 3, (k + 2) % 3];
        const n = p[i] * q[j] - p[j] * q[i];
        normals[a + k] += n;
        normals[b + k] += n;
        normals[c + k] += n;
      }
    }
    return { vertices, colours, faces, normals };
  }

  function load(message) {
    const records = bytesOf(message.gaussians);
    words = new Uint32Array(records);
    count = words.length >> 3;
    means = new Float32Array(3 * count);
    const floats = new Float32Array(records);
    for (let i = 0, j = 0; i < floats.length; i += 8) {
      means[j++] = floats[i];
      means[j++] = floats[i + 1];
      means[j++] = floats[i + 2];
    }
    depths = new Float32Array(count);
    keys = new Uint16Array(count);
    states = new Uint8Array(count); // of edit.js
    mesh = message.mesh ? meshOf(message.mesh, message.vertices, message.faces) : null;
    const harmonics = message.harmonics ? bytesOf(message.harmonics) : new ArrayBuffer(0);
    const sent = records.slice(0);
    post({ kind: "loaded", records: sent, harmonics, mesh }, [sent, harmonics]);
  }

  // A counting sort by 16 bits of depth, farthest first. The order depends on the
  // direction of view only, not on the camera's position.
  function sort({ forward: [x, y, z], wanted, buffer, id }) {
    const used = Math.min(wanted, count);
    const order = buffer ? new Uint32Array(buffer) : new Uint32Array(2048 * Math.ceil(count / 2048));
    let low = Infinity, high = -Infinity;
    for (let i = 0, j = 0; i < used; i++, j += 3) {
      const depth = x * means[j] + y * means[j + 1] + z * means[j + 2];
      depths[i] = depth;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
    const factor = 65535 / (high - low || 1);
    starts.fill(0);
    for (let i = 0; i < used; i++) {
      const key = (high - depths[i]) * factor | 0;
      keys[i] = key;
      starts[key + 1]++;
    }
    for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
    for (let i = 0; i < used; i++) order[starts[keys[i]]++] = i;
    post({ kind: "sorted", buffer: order.buffer, used, id }, [order.buffer]);
  }

  // Depth where a ray is half blocked; each Gaussian counts with its maximum along the ray.
  function pickGaussian(origin, ray) {
    const hits = [];
    for (let i = 0; i < count; i++) {
      const x = origin[0] - means[3 * i], y = origin[1] - means[3 * i + 1], z = origin[2] - means[3 * i + 2];
      const along = -(x * ray[0] + y * ray[1] + z * ray[2]);
      if (states[i] === 2) continue;
      const sizes = words[8 * i + 5], last = words[8 * i + 6];
      const s = [halves[sizes & 65535], halves[sizes >>> 16], halves[last & 65535]];
      const reach = 3.4 * Math.max(s[0], s[1], s[2]);
      if (along < 0.01 || x * x + y * y + z * z - along * along > reach * reach) continue;
      const o = [x, y, z], w = words.subarray(8 * i, 8 * i + 8);
      const p = [w[6] >>> 16, w[7] & 65535, w[7] >>> 16].map((bits) => ((bits << 16) >> 16) / 32767);
      const k = 2 / (1 + p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
      const q = p.map((value) => -k * value);  // minus: back into the Gaussian's own axes
      const a = turned(q, k - 1, o), b = turned(q, k - 1, ray);
      let aa = 0, ab = 0, bb = 0;
      for (let j = 0; j < 3; j++) {
        const size = Math.max(s[j], 1e-6);
        const u = a[j] / size, v = b[j] / size;
        aa += u * u;
        ab += u * v;
        bb += v * v;
      }
      const alpha = halves[w[3] & 65535] * Math.exp(-0.5 * (aa - ab * ab / bb));
      if (alpha > 1 / 255) hits.push([-ab / bb, alpha]);
    }
    hits.sort((one, other) => one[0] - other[0]);
    let through = 1;
    for (const [depth, alpha] of hits) {
      through *= 1 - alpha;
      if (through < 0.5) return depth;
    }
    return null;
  }

  function turned(v, w, x) {
    const c = cross(v, x).map((value, k) => value + w * x[k]), d = cross(v, c);
    return x.map((value, k) => value + 2 * d[k]);
  }

  function cross(a, b) {
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  }

  // The first point: of those within a few hundredths of the view about the ray.
  function pickCentre(origin, ray, width) {
    let best = null;
    for (let i = 0; i < 3 * count; i += 3) {
      const o = [means[i] - origin[0], means[i + 1] - origin[1], means[i + 2] - origin[2]];
      const along = o[0] * ray[0] + o[1] * ray[1] + o[2] * ray[2];
      const off = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - along * along;
      const limit = width * along;
      if (states[i / 3] !== 2 && along > 0.01 && off < limit * limit && (best === null || along < best)) best = along;
    }
    return best;
  }

  function pickMesh(origin, ray) {
    const { vertices, faces } = mesh;
    const corner = (f) => [0, 1, 2].map((k) => vertices[3 * faces[f] + k]);
    const minus = (a, b) => a.map((value, k) => value - b[k]);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let best = null;
    for (let f = 0; f < faces.length; f += 3) {
      const a = corner(f), p = minus(corner(f + 1), a), q = minus(corner(f + 2), a);
      const n = cross(ray, q), scale = dot(p, n), t = minus(origin, a);
      if (!scale) continue;
      const u = dot(t, n) / scale, m = cross(t, p), v = dot(ray, m) / scale;
      const depth = dot(q, m) / scale;
      if (u < 0 || v < 0 || u + v > 1 || depth < 0.01) continue;
      if (best === null || depth < best) best = depth;
    }
    return best;
  }

  function pick({ origin, ray, mode, width, id }) {
    const depth = mode === "mesh" ? pickMesh(origin, ray)
      : mode === "centres" ? pickCentre(origin, ray, width) : pickGaussian(origin, ray);
    post({ kind: "picked", depth, id });
  }

  function addMesh(message) {
    mesh = meshOf(message.mesh, message.vertices, message.faces);
    post({ kind: "meshed", mesh });
  }

  const edit = (message) => { ({ states } = message); };

  const tasks = { load, addMesh, sort, pick, edit };
  return (message) => tasks[message.kind](message);
}

// A worker with the program; or the same interface on the page's own thread.
function startSorter(receive) {
  const text = `const handle = (${sorterProgram})((m, moved) => postMessage(m, moved || []));
onmessage = (event) => handle(event.data);`;
  try {
    const address = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
    const worker = new Worker(address);
    worker.onmessage = (event) => receive(event.data);
    return (message, moved = []) => worker.postMessage(message, moved);
  } catch {
    const handle = sorterProgram((message) => setTimeout(receive, 0, message));
    return (message) => setTimeout(handle, 0, message);
  }
}
