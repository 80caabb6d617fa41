"""Native leaves of the CPU scan for what does not depend on the state n: step, input, gate.

A call does a strip of tokens of sixteen channels. Equations are those of README.md.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from ...runtime.lanes import ACTIVATIONS, PRELUDE, WARP_DTYPES, lanes
from ...runtime.rows import ELEMENTS, rows

# What is kept of a token; its rate is δ times a scale. The values of a token lie together, because
# arrays of 4 KiB would evict one another from the cache.
TOKENS = """
struct Token { F rate, du, y; };
struct GradToken { F rate, du, dy, y, s, p; };
struct Kept { F m, h; };
auto aligned_ = [](auto* p) { return (decltype(p))(((size_t)p + 63) & ~(size_t)63); };
"""
TOKEN, GRAD_TOKEN, KEPT = 3, 6, 2  # lanes of each
EXTRA = 2  # lanes beside the tokens: the largest rate, and room for the alignment

_PRELUDE = PRELUDE + ACTIVATIONS + ELEMENTS + TOKENS

# A row's lines lie together, but a lane group wants one line of each row. So the rows of the next
# strip are fetched in their order, each lane group doing its share.
_OPEN = """
F top = F{};
const F bias = *(const F*)&bias_in, skip = *(const F*)&skip_in;
int row = share * count / lines, line = share * count % lines;
for (int t = 0; t < count; ++t) {
    const int ahead = t0 + next + row < limit ? next + row : 0, at = 16 * (line - share);
    fetch_u(ahead, at);
    fetch_delta(ahead, at);
    if (use_z) fetch_z(ahead, at);
    FETCH
    if (++line == lines) line = 0, ++row;
    F step = read_delta(t) + bias;
    if (use_softplus) step = softplus_(step);
    const F u = read_u(t);
    const F rate = step * scale;
    top = wider_(top, rate);
"""
# The largest |rate| of each lane is left behind the tokens, for the recurrence.
_CLOSE = """
}
*(F*)&token[count] = top;
return tame_(top * *(const F*)&widest_in);
"""
_PREPARE = (
    "Token* const token = aligned_((Token*)scratch.data);"
    + _OPEN.replace("FETCH", "")
    + "token[t] = {rate, step * u, skip * u};"
    + _CLOSE
)

# out = y silu(z), or y
_FINISH = """
const Token* const token = aligned_((const Token*)scratch.data);
if (use_z)
    for (int t = 0; t < count; ++t) {
        const F z = read_z(t);
        write_y(t, token[t].y * (z * sigmoid_(z)));
    }
else
    for (int t = 0; t < count; ++t) write_y(t, token[t].y);
"""

# As _PREPARE, and dy = dout silu(z).
_PREPARE_GRAD = (
    "GradToken* const token = aligned_((GradToken*)scratch.data);"
    + _OPEN.replace("FETCH", "fetch_dout(ahead, at);")
    + """
    F dy = read_dout(t);
    if (use_z) {
        const F z = read_z(t);
        dy *= z * sigmoid_(z);
    }
    token[t] = {rate, step * u, dy, skip * u, F{}, F{}};
    """
    + _CLOSE
)

# Equations 9 and 11, dz, and the sums for dD and ddelta_bias.
_FINISH_GRAD = """
const GradToken* const token = aligned_((const GradToken*)scratch.data);
const F bias = *(const F*)&bias_in, skip = *(const F*)&skip_in;
F dskip = F{}, dbias = F{};
const bool need_u = du_out.shape[1] > 0, need_delta = ddelta_out.shape[1] > 0;
const bool need_z = dz_out.shape[1] > 0;
for (int t = 0; t < count; ++t) {
    const GradToken& own = token[t];
    const F u = read_u(t);
    dskip = fma_(own.dy, u, dskip);
    F ddelta = fma_(u, own.s, own.p);
    if (use_softplus) ddelta *= sigmoid_(read_delta(t) + bias);
    dbias += ddelta;
    if (need_u) write_du(t, fma_(own.rate * (1.0f / scale), own.s, skip * own.dy));
    if (need_delta) write_ddelta(t, ddelta);
    if (need_z) {
        const F z = read_z(t), sig = sigmoid_(z);
        const F slope = fma_(z * sig, 1.0f - sig, sig);
        write_dz(t, read_dout(t) * own.y * slope);
    }
}
*(F*)&dskip_out.data[k] += dskip;
*(F*)&dbias_out.data[k] += dbias;
"""


def _leaf(text: str, **arrays: torch.dtype) -> str:
    return _PRELUDE + "".join(rows(array, dtype) for array, dtype in arrays.items()) + text


@functools.cache
def forward_leaves(io: torch.dtype, delta_io: torch.dtype) -> SimpleNamespace:
    """``prepare`` and ``finish`` for u, z and y of dtype ``io`` and delta of ``delta_io``.

    ``prepare`` fills rate, δu and D u, returns whether all |rate A| are tame, and fetches this lane
    group's ``share`` of the ``lines`` of the rows that begin ``next`` tokens on.
    """
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]

    @wp.func_native(_leaf(_PREPARE, u_in=io, delta_in=delta_io, z_in=io))
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
        scale: float,
        scratch: wp.array(dtype=lanes),
    ) -> int: ...

    @wp.func_native(_leaf(_FINISH, z_in=io, y_out=io))
    def finish(
        z_in: wp.array3d(dtype=scalar),
        b: int,
        t0: int,
        count: int,
        d: int,
        width: int,
        use_z: int,
        scratch: wp.array(dtype=lanes),
        y_out: wp.array3d(dtype=scalar),
    ): ...

    return SimpleNamespace(prepare=prepare, finish=finish)


@functools.cache
def backward_leaves(io: torch.dtype, delta_io: torch.dtype) -> SimpleNamespace:
    """``prepare`` and ``finish`` of the gradient, for dtypes as in ``forward_leaves``."""
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]

    @wp.func_native(_leaf(_PREPARE_GRAD, u_in=io, delta_in=delta_io, z_in=io, dout_in=io))
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
        scale: float,
        scratch: wp.array(dtype=lanes),
    ) -> int: ...

    @wp.func_native(
        _leaf(
            _FINISH_GRAD,
            u_in=io,
            delta_in=delta_io,
            z_in=io,
            dout_in=io,
            du_out=io,
            ddelta_out=delta_io,
            dz_out=io,
        )
    )
    def finish(
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        dout_in: wp.array3d(dtype=scalar),
        b: int,
        t0: int,
        count: int,
        d: int,
        width: int,
        k: int,
        bias_in: lanes,
        skip_in: lanes,
        use_softplus: int,
        scale: float,
        scratch: wp.array(dtype=lanes),
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
        dskip_out: wp.array(dtype=lanes),
        dbias_out: wp.array(dtype=lanes),
    ): ...

    return SimpleNamespace(prepare=prepare, finish=finish)
