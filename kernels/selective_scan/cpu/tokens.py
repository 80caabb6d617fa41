"""Native leaves of the CPU scan for what does not depend on the state n: step, input, gate.

A call does a strip of tokens of sixteen channels. Equations are those of README.md.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from ...runtime.lanes import ACTIVATIONS, PRELUDE, WARP_DTYPES, lanes
from ...runtime.rows import ELEMENTS, put, rows

# What is kept of a token; its rate is δ times a scale. The values of a token lie together, because
# arrays of 4 KiB would evict one another from the cache. What the states do not need lies apart.
# Behind the tokens lie the largest |rate| of each lane, and what is to be fetched meanwhile.
TOKENS = """
struct Token { F rate, du, y, gate; };
struct GradToken { F rate, du, dy, y, s, p; };
struct Late { F u, slope, gate; };
struct Fetch {
    const char* at;
    int64_t step, jump;
    int line, lines;
    void next() {
        __builtin_prefetch(at);
        const bool last = ++line == lines;
        at += last ? jump : step;
        line = last ? 0 : line;
    }
};
struct Tail { F top; Fetch fetch[8]; int fetches; };
auto aligned_ = [](auto* p) { return (decltype(p))(((size_t)p + 63) & ~(size_t)63); };
"""
TOKEN, GRAD_TOKEN, LATE = 4, 6, 3  # lanes of each
EXTRA = 7  # lanes beside the tokens: the tail, and room for the alignment

# A row's lines lie together, but a lane group wants one line of each row. So the rows of the next
# strip are fetched in their order, each lane group fetching its share. That is done while the
# states are walked, as those loops leave the memory idle; so are the lines fetched that this lane
# group will write.
_FETCHES = """
Tail& tail = *(Tail*)&token[count];
tail.fetches = 0;
const bool more = t0 + next >= 0 && t0 + next < limit;
auto read_soon_ = [&](const char* rows, int64_t step, int bytes) {
    const int row = share * count / lines, line = share * count % lines;
    tail.fetch[tail.fetches++] = {
        rows + (more ? (next + row) * step : 0) + (line - share) * bytes, bytes,
        (more ? step : 0) - (lines - 1) * bytes, line, lines};
};
auto write_soon_ = [&](const char* rows, int64_t step) {
    tail.fetch[tail.fetches++] = {rows, step, step, 0, 1};
};
"""


def _soon(what: str, *names: str) -> str:
    """C++ text that calls ``read_soon_`` or ``write_soon_`` for rows."""
    step = "(const char*){0}_rows, {0}_step * sizeof(*{0}_rows)"
    line = ", 16 * sizeof(*{0}_rows)" if what == "read" else ""
    return "".join(f"{what}_soon_({(step + line).format(name)});" for name in names)


_PREPARE = (
    "Token* const token = aligned_((Token*)scratch.data);"
    + _FETCHES
    + f"{_soon('read', 'delta', 'u')} if (use_z) {{ {_soon('read', 'z')} }}"
    + f"if (use_y) {{ {_soon('write', 'y')} }}"
    + """
F top = F{};
const F bias = *(const F*)&bias_in, skip = *(const F*)&skip_in;
FILL
tail.top = top;
return tame_(top * *(const F*)&widest_in);
"""
)
_FILL = """
for (int t = 0; t < count; ++t) {
    F step = read_delta(t) + bias, gate = splat(1.0f);
    if (use_softplus) step = softplus_(step);
    if (use_z) {
        const F z = read_z(t);
        gate = z * sigmoid_(z);
    }
    const F u = read_u(t), rate = step * scale;
    top = wider_(top, rate);
    token[t] = {rate, step * u, skip * u, gate};
}
"""

# out = y silu(z), or y
_FINISH = (
    put("y")
    + """
const Token* const token = aligned_((const Token*)scratch.data);
for (int t = 0; t < count; ++t) put_y(t, token[t].y * token[t].gate);
"""
)

# As _PREPARE, and dy = dout silu(z); for later the slopes of the step and of the gate.
_PREPARE_GRAD = (
    """
GradToken* const token = aligned_((GradToken*)scratch.data);
Late* const late = aligned_((Late*)late_out.data);
"""
    + _FETCHES
    + f"{_soon('read', 'delta', 'u', 'dout')} if (use_z) {{ {_soon('read', 'z')} }}"
    + "".join(
        f"if (writes && {name}_out.shape[1] > 0) {{ {_soon('write', name)} }}"
        for name in ("du", "ddelta", "dz")
    )
    + """
F top = F{};
const F bias = *(const F*)&bias_in, skip = *(const F*)&skip_in;
FILL
tail.top = top;
return tame_(top * *(const F*)&widest_in);
"""
)
_FILL_GRAD = """
for (int t = 0; t < count; ++t) {
    F step = read_delta(t) + bias, slope = splat(1.0f), dy = read_dout(t), gate = F{};
    if (use_softplus && use_z) {  // both slopes with one division
        const F z = read_z(t), e = decay_(step), ez = decay_(z);
        const F ds = e + 1.0f, dz = ez + 1.0f, r = 1.0f / (ds * dz);
        const F sig = (z < 0.0f ? ez : splat(1.0f)) * (ds * r), silu = z * sig;
        gate = dy * fma_(silu, 1.0f - sig, sig);
        dy *= silu;
        slope = (step < 0.0f ? e : splat(1.0f)) * (dz * r);
        step = softplus_of_(step, e / (e + 2.0f));  // as in the forward, to the last bit
    } else {
        if (use_z) {
            const F z = read_z(t), sig = sigmoid_(z), silu = z * sig;
            gate = dy * fma_(silu, 1.0f - sig, sig);
            dy *= silu;
        }
        if (use_softplus) {
            slope = sigmoid_(step);
            step = softplus_(step);
        }
    }
    const F u = read_u(t), rate = step * scale;
    top = wider_(top, rate);
    token[t] = {rate, step * u, dy, skip * u, F{}, F{}};
    late[t] = {u, slope, gate};
}
"""

# Equations 9 and 11, dz, and the chunk's sums for dD and ddelta_bias. They are added by runs of
# eight tokens, because equal terms would round to the same side at every token.
_FINISH_GRAD = (
    "".join(map(put, ("du", "ddelta", "dz")))
    + """
const GradToken* const token = aligned_((const GradToken*)scratch.data);
const Late* const late = aligned_((const Late*)late_in.data);
const F skip = *(const F*)&skip_in;
F dskip = F{}, dbias = F{}, skips = F{}, biases = F{};
const bool need_u = du_out.shape[1] > 0, need_delta = ddelta_out.shape[1] > 0;
const bool need_z = dz_out.shape[1] > 0;
for (int t = 0; t < count; ++t) {
    const GradToken& own = token[t];
    const F u = late[t].u;
    skips = fma_(own.dy, u, skips);
    const F ddelta = fma_(u, own.s, own.p) * late[t].slope;
    biases += ddelta;
    if ((t & 7) == 7 || t == count - 1) {
        dskip += skips, dbias += biases;
        skips = biases = F{};
    }
    if (need_u) put_du(t, fma_(own.rate * (1.0f / scale), own.s, skip * own.dy));
    if (need_delta) put_ddelta(t, ddelta);
    if (need_z) put_dz(t, own.y * late[t].gate);
}
*(F*)&dskip_out.data[k] = dskip;
*(F*)&dbias_out.data[k] = dbias;
"""
)


def _leaf(text: str, fill: str = "", **arrays: torch.dtype) -> str:
    """The C++ text of a leaf; ``fill`` is compiled a second time for what is usual."""
    head = PRELUDE + ACTIVATIONS + ELEMENTS + TOKENS
    reading = "".join(rows(array, dtype) for array, dtype in arrays.items())
    inner = "".join(rows(x, dtype) for x, dtype in arrays.items() if x.endswith("_in"))
    usual = "const int width = 16; const bool use_softplus = true, use_z = true;"
    both = (
        f"if (width >= 16 && use_softplus && use_z) {{ {usual} {inner} {fill} }}else {{ {fill} }}"
    )
    return head + reading + text.replace("FILL", both)


@functools.cache
def forward_leaves(io: torch.dtype, delta_io: torch.dtype) -> SimpleNamespace:
    """``prepare`` and ``finish`` for u, z and y of dtype ``io`` and delta of ``delta_io``.

    ``prepare`` fills the tokens and their tail, and returns whether all |rate A| are tame. Its tail
    asks for this lane group's ``share`` of the ``lines`` of the rows that begin ``next`` tokens on.
    """
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]

    @wp.func_native(_leaf(_PREPARE, _FILL, u_in=io, delta_in=delta_io, z_in=io, y_out=io))
    def prepare(
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        b: int,
        t0: int,
        count: int,
        d: int,
        width: int,
        share: int,
        lines: int,
        next: int,
        limit: int,
        widest_in: lanes,
        bias_in: lanes,
        skip_in: lanes,
        use_softplus: int,
        use_z: int,
        use_y: int,
        scale: float,
        scratch: wp.array(dtype=lanes),
        y_out: wp.array3d(dtype=scalar),
    ) -> int: ...

    @wp.func_native(_leaf(_FINISH, y_out=io))
    def finish(
        b: int,
        t0: int,
        count: int,
        d: int,
        width: int,
        stream: int,
        scratch: wp.array(dtype=lanes),
        y_out: wp.array3d(dtype=scalar),
    ): ...

    return SimpleNamespace(prepare=prepare, finish=finish)


@functools.cache
def backward_leaves(io: torch.dtype, delta_io: torch.dtype) -> SimpleNamespace:
    """``prepare`` and ``finish`` of the gradient, for dtypes as in ``forward_leaves``."""
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]

    inputs = {"u_in": io, "delta_in": delta_io, "z_in": io, "dout_in": io}
    outputs = {"du_out": io, "ddelta_out": delta_io, "dz_out": io}

    @wp.func_native(_leaf(_PREPARE_GRAD, _FILL_GRAD, **inputs, **outputs))
    def prepare(
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        dout_in: wp.array3d(dtype=scalar),
        b: int,
        t0: int,
        count: int,
        d: int,
        width: int,
        share: int,
        lines: int,
        next: int,
        limit: int,
        widest_in: lanes,
        bias_in: lanes,
        skip_in: lanes,
        use_softplus: int,
        use_z: int,
        writes: int,
        scale: float,
        scratch: wp.array(dtype=lanes),
        late_out: wp.array(dtype=lanes),
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
    ) -> int: ...

    @wp.func_native(_leaf(_FINISH_GRAD, "", **outputs))
    def finish(
        b: int,
        t0: int,
        count: int,
        d: int,
        width: int,
        k: int,
        stream: int,
        skip_in: lanes,
        scale: float,
        scratch: wp.array(dtype=lanes),
        late_in: wp.array(dtype=lanes),
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
        dskip_out: wp.array(dtype=lanes),
        dbias_out: wp.array(dtype=lanes),
    ): ...

    return SimpleNamespace(prepare=prepare, finish=finish)
