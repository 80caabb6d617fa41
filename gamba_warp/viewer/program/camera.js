// The camera: an orbit about a target, in the axes of cameras.py's orbit() (x right, y
// down, z forward; the input's camera has azimuth 0).

function axesOf(azimuth, elevation) {
  const [sa, ca] = [Math.sin(azimuth), Math.cos(azimuth)];
  const [se, ce] = [Math.sin(elevation), Math.cos(elevation)];
  return [[ca, 0, sa], [se * sa, ce, -se * ca], [-sa * ce, se, ca * ce]];
}

class OrbitCamera {
  constructor(home, fov) {
    this.home = home;
    this.half = Math.tan((fov * Math.PI) / 360);
    this.goal = null;
    this.tilt = 0; // of the object about the x axis, radians
    Object.assign(this, this.copyOf(home));
  }

  copyOf({ azimuth, elevation, distance, target }) {
    return { azimuth, elevation, distance, target: [...target] };
  }

  // Rows: the camera's right, down and forward, in the object's frame.
  rotation() {
    const c = Math.cos(this.tilt), s = Math.sin(this.tilt);
    return axesOf(this.azimuth, this.elevation).map(([x, y, z]) => [x, c * y - s * z, s * y + c * z]);
  }

  // The focal length in pixels; the field of view is that of the shorter side.
  focal(width, height) {
    return Math.min(width, height) / 2 / this.half;
  }

  position() {
    const forward = this.rotation()[2];
    return this.target.map((value, k) => value - this.distance * forward[k]);
  }

  // The unit ray through a point of the image, in pixels from its middle.
  ray(x, y, focal) {
    const [right, down, forward] = this.rotation(), norm = Math.hypot(x, y, focal);
    return [0, 1, 2].map((k) => (x * right[k] + y * down[k] + focal * forward[k]) / norm);
  }

  turn(dx, dy) {
    this.goal = null;
    this.azimuth -= dx;
    this.elevation = Math.max(-1.55, Math.min(1.55, this.elevation + dy));
  }

  // By pixels of an image of this focal length, so that the target follows the pointer.
  pan(dx, dy, focal) {
    this.goal = null;
    const [right, down] = this.rotation(), unit = this.distance / focal;
    this.target = this.target.map((value, k) => value - unit * (dx * right[k] + dy * down[k]));
  }

  zoom(factor) {
    this.goal = null;
    this.distance = Math.max(0.02, Math.min(40, this.distance * factor));
  }

  // Goes there within `time` milliseconds; angles take the shorter way round.
  go(where, now, time) {
    const from = this.copyOf(this), to = this.copyOf({ ...from, ...where });
    const turn = 2 * Math.PI;
    from.azimuth = to.azimuth + ((((from.azimuth - to.azimuth + Math.PI) % turn) + turn) % turn) - Math.PI;
    this.goal = { from, to, start: now, time };
  }

  // Advances the motion; returns true if anything moved.
  step(now) {
    if (!this.goal) return false;
    const { from, to, start, time } = this.goal;
    const t = time > 0 ? Math.max(0, Math.min(1, (now - start) / time)) : 1, s = t * t * (3 - 2 * t);
    for (const name of ["azimuth", "elevation"]) this[name] = from[name] + s * (to[name] - from[name]);
    this.distance = from.distance * (to.distance / from.distance) ** s;
    this.target = from.target.map((value, k) => value + s * (to.target[k] - value));
    if (t === 1) this.goal = null;
    return true;
  }
}
