"""The CUDA kernels: a thread per channel and chunk of tokens, its states in registers.

All chunks run at once: a first launch scans each chunk from zero, a second carries states over the
chunks, a third scans again from the right states; the gradient goes the same way backwards. A block
is ``BLOCK`` adjacent channels of one group, and sums dB and dC over them before they leave it.
Equations are those of README.md.
"""

import functools

import torch
import warp as wp

from .lanes import WARP_DTYPES
from .recurrence import MODES
from .scalars import ACCESSORS, sigmoid, softplus

BLOCK = 32  # one warp, whose sums are shuffles
CHUNK = 64  # tokens of a thread; a state is saved at the start of each chunk
SUB = 8  # tokens whose states the gradient holds at once

_BLOCK = wp.constant(BLOCK)
_K = wp.constant(CHUNK)
_S = wp.constant(SUB)
_SUBS = wp.constant(CHUNK // SUB)


@wp.func
def _phi(x: float, f: float) -> float:
    """(e^x - 1) / x, by its series for small x."""
    small = 1.0 + x / 10.0 * (1.0 + x / 11.0)
    for i in range(8):
        small = 1.0 + x / float(9 - i) * small
    return wp.where(wp.abs(x) < 1.0, small, (f - 1.0) / wp.where(x == 0.0, 1.0, x))


@wp.func
def _phi_slope(x: float, f: float, g: float) -> float:
    """Derivative of ``_phi``: the sum of k x^(k-1) / (k+1)!, by Horner's rule, for small x."""
    small = wp.float32(0.0)
    for i in range(10):
        k = float(10 - i)
        small = small * x / (k + 2.0) * (k + 1.0) / k + 1.0
    return wp.where(wp.abs(x) < 1.0, 0.5 * small, (f - g) / wp.where(x == 0.0, 1.0, x))


@wp.func
def _factors(mode: int, x: float) -> wp.vec2:
    """Equations 2 to 4: f and g."""
    g = wp.float32(1.0)
    f = wp.float32(0.0)
    if mode == 1:
        g = 1.0 / (1.0 - 0.5 * x)
        f = 1.0 + x * g
    else:
        f = wp.exp(x)
    if mode == 2:
        g = _phi(x, f)
    return wp.vec2(f, g)


@wp.func
def _slopes(mode: int, x: float, f: float, g: float) -> wp.vec2:
    """Derivatives of f and g by x."""
    df = f
    dg = wp.float32(0.0)
    if mode == 1:
        df = g * g
        dg = 0.5 * df
    if mode == 2:
        dg = _phi_slope(x, f, g)
    return wp.vec2(df, dg)


@wp.struct
class Sizes:
    """What all kernels know: the shapes, and how block indices map to them."""

    length: int
    group_width: int
    groups: int
    parts: int
    chunks: int
    use_softplus: int
    use_z: int
    need_db: int
    need_dc: int


@wp.struct
class Place:
    """Where a thread works."""

    b: int
    chunk: int
    group: int
    d: int  # its channel; threads past the group's last keep to that one and are not active
    active: int
    row: int  # of the sums over channels


@wp.func
def _place(sizes: Sizes, block: int, lane: int) -> Place:
    place = Place()
    part = block % sizes.parts
    rest = block / sizes.parts
    place.group = rest % sizes.groups
    rest = rest / sizes.groups
    place.chunk = rest % sizes.chunks
    place.b = rest / sizes.chunks
    within = part * _BLOCK + lane
    place.active = int(within < sizes.group_width)
    place.d = place.group * sizes.group_width + wp.min(within, sizes.group_width - 1)
    place.row = (place.b * sizes.groups + place.group) * sizes.parts + part
    return place


@functools.cache
def kernels(io: torch.dtype, delta_io: torch.dtype, discretization: str, states: int):
    """The four token kernels of one element type, discretisation and N, by name."""
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]
    (load, store), (load_delta, store_delta) = ACCESSORS[io], ACCESSORS[delta_io]
    mode = MODES[discretization]
    vec = wp.types.vector(states, wp.float32)

    @wp.func
    def read_step(
        sizes: Sizes, delta_in: wp.array3d(dtype=delta_scalar), bias: float, p: Place, t: int
    ) -> float:
        step = load_delta(delta_in, p.b, t, p.d, 1) + bias
        if sizes.use_softplus != 0:
            step = softplus(step)
        return step

    @wp.func
    def advance(h: vec, a: vec, step: float, u: float, b: vec) -> vec:
        # equation 1
        for n in range(wp.static(states)):
            fg = _factors(wp.static(mode), step * a[n])
            h[n] = fg[0] * h[n] + fg[1] * (step * u * b[n])
        return h

    @wp.kernel(enable_backward=False, module="unique")
    def summarise_forward(
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        a_in: wp.array(dtype=vec),
        b_in: wp.array3d(dtype=vec),
        bias_in: wp.array(dtype=wp.float32),
        # out
        decay_out: wp.array3d(dtype=vec),
        h_out: wp.array3d(dtype=vec),
    ):
        # a chunk from h = 0, and the product of its decays
        block, lane = wp.tid()
        p = _place(sizes, block, lane)
        if p.active != 0:
            a = a_in[p.d]
            decay = vec(1.0)
            h = vec()
            t0 = p.chunk * _K
            for t in range(t0, wp.min(t0 + _K, sizes.length)):
                step = read_step(sizes, delta_in, bias_in[p.d], p, t)
                u = load(u_in, p.b, t, p.d, 1)
                b = b_in[p.b, t, p.group]
                for n in range(wp.static(states)):
                    fg = _factors(wp.static(mode), step * a[n])
                    h[n] = fg[0] * h[n] + fg[1] * (step * u * b[n])
                    decay[n] = fg[0] * decay[n]
            decay_out[p.b, p.chunk, p.d] = decay
            h_out[p.b, p.chunk, p.d] = h

    @wp.kernel(enable_backward=False, module="unique")
    def scan_forward(
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array(dtype=vec),
        b_in: wp.array3d(dtype=vec),
        c_in: wp.array3d(dtype=vec),
        skip_in: wp.array(dtype=wp.float32),
        bias_in: wp.array(dtype=wp.float32),
        starts_in: wp.array3d(dtype=vec),
        # out
        y_out: wp.array3d(dtype=scalar),
    ):
        block, lane = wp.tid()
        p = _place(sizes, block, lane)
        if p.active != 0:
            a = a_in[p.d]
            h = starts_in[p.b, p.chunk, p.d]
            t0 = p.chunk * _K
            for t in range(t0, wp.min(t0 + _K, sizes.length)):
                step = read_step(sizes, delta_in, bias_in[p.d], p, t)
                u = load(u_in, p.b, t, p.d, 1)
                h = advance(h, a, step, u, b_in[p.b, t, p.group])
                y = wp.dot(h, c_in[p.b, t, p.group]) + skip_in[p.d] * u
                if sizes.use_z != 0:
                    z = load(z_in, p.b, t, p.d, 1)
                    y = y * z * sigmoid(z)
                store(y_out, p.b, t, p.d, 1, y)

    @wp.kernel(enable_backward=False, module="unique")
    def summarise_backward(
        # in
        sizes: Sizes,
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array(dtype=vec),
        c_in: wp.array3d(dtype=vec),
        bias_in: wp.array(dtype=wp.float32),
        dout_in: wp.array3d(dtype=scalar),
        # out
        decay_out: wp.array3d(dtype=vec),
        dh_out: wp.array3d(dtype=vec),
    ):
        # what a chunk's own outputs send to the state it starts from
        block, lane = wp.tid()
        p = _place(sizes, block, lane)
        if p.active != 0:
            a = a_in[p.d]
            decay = vec(1.0)
            dh = vec()
            t0 = p.chunk * _K
            for t in range(t0, wp.min(t0 + _K, sizes.length)):
                step = read_step(sizes, delta_in, bias_in[p.d], p, t)
                dy = load(dout_in, p.b, t, p.d, 1)
                if sizes.use_z != 0:
                    z = load(z_in, p.b, t, p.d, 1)
                    dy = dy * z * sigmoid(z)
                c = c_in[p.b, t, p.group]
                for n in range(wp.static(states)):
                    fg = _factors(wp.static(mode), step * a[n])
                    decay[n] = fg[0] * decay[n]
                    dh[n] = dh[n] + decay[n] * c[n] * dy
            decay_out[p.b, p.chunk, p.d] = decay
            dh_out[p.b, p.chunk, p.d] = dh

    @wp.kernel(enable_backward=False, module="unique")
    def scan_backward(
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array(dtype=vec),
        b_in: wp.array3d(dtype=vec),
        c_in: wp.array3d(dtype=vec),
        skip_in: wp.array(dtype=wp.float32),
        bias_in: wp.array(dtype=wp.float32),
        starts_in: wp.array3d(dtype=vec),
        ends_in: wp.array3d(dtype=vec),
        dout_in: wp.array3d(dtype=scalar),
        # out
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
        da_out: wp.array3d(dtype=vec),
        db_out: wp.array2d(dtype=vec),
        dc_out: wp.array2d(dtype=vec),
        dskip_out: wp.array3d(dtype=wp.float32),
        dbias_out: wp.array3d(dtype=wp.float32),
    ):
        block, lane = wp.tid()
        p = _place(sizes, block, lane)
        marks = wp.zeros(shape=(_SUBS,), dtype=vec)
        hs = wp.zeros(shape=(_S,), dtype=vec)
        a = a_in[p.d]
        bias = bias_in[p.d]
        skip = skip_in[p.d]
        t0 = p.chunk * _K
        end = wp.min(t0 + _K, sizes.length)
        h = starts_in[p.b, p.chunk, p.d]
        for t in range(t0, end):
            if (t - t0) % _S == 0:
                marks[(t - t0) / _S] = h
            step = read_step(sizes, delta_in, bias, p, t)
            h = advance(h, a, step, load(u_in, p.b, t, p.d, 1), b_in[p.b, t, p.group])
        dh = ends_in[p.b, p.chunk, p.d]
        da = vec()
        dskip = wp.float32(0.0)
        dbias = wp.float32(0.0)
        subs = (end - t0 + _S - 1) / _S
        for r in range(subs):
            sub = subs - 1 - r
            s0 = t0 + sub * _S
            count = wp.min(_S, end - s0)
            h = marks[sub]
            for i in range(count):
                step = read_step(sizes, delta_in, bias, p, s0 + i)
                u = load(u_in, p.b, s0 + i, p.d, 1)
                hs[i] = h
                h = advance(h, a, step, u, b_in[p.b, s0 + i, p.group])
            for j in range(count):
                t = s0 + count - 1 - j
                step = read_step(sizes, delta_in, bias, p, t)
                u = load(u_in, p.b, t, p.d, 1)
                c = c_in[p.b, t, p.group]
                b = b_in[p.b, t, p.group]
                dout = float(p.active) * load(dout_in, p.b, t, p.d, 1)
                dy = dout
                if sizes.use_z != 0:
                    z = load(z_in, p.b, t, p.d, 1)
                    s = sigmoid(z)
                    dy = dout * z * s
                    if dz_out.shape[1] > 0 and p.active != 0:
                        y = wp.dot(h, c) + skip * u
                        store(dz_out, p.b, t, p.d, 1, dout * y * (s + z * s * (1.0 - s)))
                if sizes.need_dc != 0:
                    dc = wp.tile_sum(wp.tile(dy * h, preserve_type=True))
                    if lane == 0:
                        dc_out[p.row, t] = dc[0]
                h = hs[count - 1 - j]
                db_own = vec()
                through = wp.float32(0.0)
                dstep = wp.float32(0.0)
                for n in range(wp.static(states)):
                    # equations 6 to 12
                    x = step * a[n]
                    fg = _factors(wp.static(mode), x)
                    slopes = _slopes(wp.static(mode), x, fg[0], fg[1])
                    g = dh[n] + dy * c[n]
                    db_own[n] = g * fg[1] * step * u
                    through = through + g * fg[1] * b[n]
                    q = g * (h[n] * slopes[0] + step * u * b[n] * slopes[1])
                    dh[n] = fg[0] * g
                    dstep = dstep + q * a[n]
                    da[n] = da[n] + q * step
                if sizes.need_db != 0:
                    db_own = db_own * float(p.active)
                    db = wp.tile_sum(wp.tile(db_own, preserve_type=True))
                    if lane == 0:
                        db_out[p.row, t] = db[0]
                ddelta = dstep + u * through
                if sizes.use_softplus != 0:
                    ddelta = ddelta * sigmoid(load_delta(delta_in, p.b, t, p.d, 1) + bias)
                dbias = dbias + ddelta
                dskip = dskip + dy * u
                if du_out.shape[1] > 0 and p.active != 0:
                    store(du_out, p.b, t, p.d, 1, step * through + skip * dy)
                if ddelta_out.shape[1] > 0 and p.active != 0:
                    store_delta(ddelta_out, p.b, t, p.d, 1, ddelta)
        if p.active != 0:
            da_out[p.b, p.chunk, p.d] = da
            dskip_out[p.b, p.chunk, p.d] = dskip
            dbias_out[p.b, p.chunk, p.d] = dbias

    return {
        "summarise_forward": summarise_forward,
        "scan_forward": scan_forward,
        "summarise_backward": summarise_backward,
        "scan_backward": scan_backward,
    }


@wp.kernel(enable_backward=False, module="unique")
def carry(
    # in
    reverse: int,
    decay_in: wp.array3d(dtype=wp.float32),
    # in and out
    local_out: wp.array3d(dtype=wp.float32),
    state_out: wp.array2d(dtype=wp.float32),
):
    """Turns what each chunk adds into the state entering it, and the first state into the last."""
    b, i = wp.tid()
    chunks = local_out.shape[1]
    h = state_out[b, i]
    for step in range(chunks):
        chunk = wp.where(reverse != 0, chunks - 1 - step, step)
        own = local_out[b, chunk, i]
        local_out[b, chunk, i] = h
        h = decay_in[b, chunk, i] * h + own
    state_out[b, i] = h
