"""Native leaves of the CPU scan for what does not depend on the state n: step, input, gate.

A call does a strip of tokens of adjacent lane groups, a row at a time, as the cache lines of a row
lie together. Equations are those of README.md.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from .lanes import ACTIVATIONS, PRELUDE, WARP_DTYPES, lanes
from .layout import CHUNK
from .rows import ELEMENTS, rows

STRIP = 32  # tokens whose values the forward pass holds at once; the backward pass holds a chunk
_AHEAD = 4  # tokens between the fetch of a row and its use

# What is held of a token, for one lane group: rate is δ times a scale. The scratch array of a task
# has a token's values together, and lane groups one after the other.
TOKENS = """
struct Token { F rate, du, y; };
struct GradToken { F rate, du, dy, y, s, p; };
struct Kept { F f, h; };
auto aligned_ = [](auto* p) { return (decltype(p))(((size_t)p + 63) & ~(size_t)63); };
"""
TOKEN, GRAD_TOKEN, KEPT = 3, 6, 2  # lanes of each

_PRELUDE = PRELUDE + ACTIVATIONS + ELEMENTS + TOKENS

_STEP = """
        const int d = 16 * j;
        fetch_delta(t + AHEAD, d);
        fetch_u(t + AHEAD, d);
        F step = read_delta(t, d, width - d) + bias[j];
        if (use_softplus) step = softplus_(step);
        const F u = read_u(t, d, width - d);
        const F rate = step * scale;
        top[j] = wider_(top[j], rate);
"""
_OPEN = """
F top[MOST];
const F* const bias = (const F*)bias_in.data + k0;
const F* const skip = (const F*)skip_in.data + k0;
const F* const widest = (const F*)widest_in.data + k0;
for (int j = 0; j < blocks; ++j) top[j] = F{};
for (int t = 0; t < count; ++t)
    for (int j = 0; j < blocks; ++j) {
"""
_CLOSE = """
    }
for (int j = 0; j < blocks; ++j) tame_out.data[j] = tame_(top[j] * widest[j]);
"""
_PREPARE = (
    "Token* const tokens = aligned_((Token*)scratch.data);"
    + _OPEN.replace("MOST", "32")
    + _STEP
    + "tokens[j * STRIP + t] = {rate, step * u, skip[j] * u};"
    + _CLOSE
)

# out = y silu(z), or y
_FINISH = """
const Token* const tokens = aligned_((const Token*)scratch.data);
for (int t = 0; t < count; ++t)
    for (int j = 0; j < blocks; ++j) {
        const int d = 16 * j;
        F y = tokens[j * STRIP + t].y;
        if (use_z) {
            fetch_z(t + AHEAD, d);
            const F z = read_z(t, d, width - d);
            y *= z * sigmoid_(z);
        }
        write_out(t, d, width - d, y);
    }
"""

# As _PREPARE, and dy = dout silu(z).
_PREPARE_GRAD = (
    "GradToken* const tokens = aligned_((GradToken*)scratch.data);"
    + _OPEN.replace("MOST", "4")
    + _STEP
    + """
        fetch_dout(t + AHEAD, d);
        F dy = read_dout(t, d, width - d);
        if (use_z) {
            fetch_z(t + AHEAD, d);
            const F z = read_z(t, d, width - d);
            dy *= z * sigmoid_(z);
        }
        tokens[j * CHUNK + t] = {rate, step * u, dy, skip[j] * u, F{}, F{}};
    """
    + _CLOSE
)

# Equations 9 and 11, dz, and the sums for dD and ddelta_bias.
_FINISH_GRAD = """
const GradToken* const tokens = aligned_((const GradToken*)scratch.data);
const F* const bias = (const F*)bias_in.data + k0;
const F* const skip = (const F*)skip_in.data + k0;
F* const dskip = (F*)dskip_out.data + k0;
F* const dbias = (F*)dbias_out.data + k0;
const bool need_u = du_in.shape[1] > 0, need_delta = ddelta_in.shape[1] > 0;
const bool need_z = dz_in.shape[1] > 0;
for (int t = 0; t < count; ++t)
    for (int j = 0; j < blocks; ++j) {
        const int d = 16 * j;
        const GradToken& k = tokens[j * CHUNK + t];
        const F u = read_u(t, d, width - d);
        dskip[j] = fma_(k.dy, u, dskip[j]);
        F ddelta = fma_(u, k.s, k.p);
        if (use_softplus) ddelta *= sigmoid_(read_delta(t, d, width - d) + bias[j]);
        dbias[j] += ddelta;
        if (need_u) write_du(t, d, width - d, fma_(k.rate * (1.0f / scale), k.s, skip[j] * k.dy));
        if (need_delta) write_ddelta(t, d, width - d, ddelta);
        if (need_z) {
            const F z = read_z(t, d, width - d), sig = sigmoid_(z);
            const F slope = fma_(z * sig, 1.0f - sig, sig);
            write_dz(t, d, width - d, read_dout(t, d, width - d) * k.y * slope);
        }
    }
"""


def _leaf(text: str, **arrays: torch.dtype) -> str:
    text = text.replace("CHUNK", str(CHUNK)).replace("STRIP", str(STRIP))
    text = "".join(rows(name, dtype) for name, dtype in arrays.items()) + text
    return _PRELUDE + text.replace("AHEAD", str(_AHEAD))


@functools.cache
def forward_leaves(io: torch.dtype, delta_io: torch.dtype) -> SimpleNamespace:
    """``prepare`` and ``finish`` for u, z, out and delta of these dtypes.

    ``prepare`` fills rate, δu and D u, and says for each lane group whether all |rate A| are tame.
    """
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]

    @wp.func_native(_leaf(_PREPARE, u=io, delta=delta_io))
    def prepare(
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        b: int,
        t0: int,
        count: int,
        d0: int,
        width: int,
        k0: int,
        blocks: int,
        widest_in: wp.array(dtype=lanes),
        bias_in: wp.array(dtype=lanes),
        skip_in: wp.array(dtype=lanes),
        use_softplus: int,
        scale: float,
        scratch: wp.array(dtype=lanes),
        tame_out: wp.array(dtype=int),
    ): ...

    @wp.func_native(_leaf(_FINISH, z=io, out=io))
    def finish(
        z_in: wp.array3d(dtype=scalar),
        b: int,
        t0: int,
        count: int,
        d0: int,
        width: int,
        blocks: int,
        use_z: int,
        scratch: wp.array(dtype=lanes),
        out_in: wp.array3d(dtype=scalar),
    ): ...

    return SimpleNamespace(prepare=prepare, finish=finish)


@functools.cache
def backward_leaves(io: torch.dtype, delta_io: torch.dtype) -> SimpleNamespace:
    """``prepare`` and ``finish`` of the backward pass."""
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]

    @wp.func_native(_leaf(_PREPARE_GRAD, u=io, delta=delta_io, z=io, dout=io))
    def prepare(
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        dout_in: wp.array3d(dtype=scalar),
        b: int,
        t0: int,
        count: int,
        d0: int,
        width: int,
        k0: int,
        blocks: int,
        widest_in: wp.array(dtype=lanes),
        bias_in: wp.array(dtype=lanes),
        skip_in: wp.array(dtype=lanes),
        use_softplus: int,
        use_z: int,
        scale: float,
        scratch: wp.array(dtype=lanes),
        tame_out: wp.array(dtype=int),
    ): ...

    @wp.func_native(
        _leaf(
            _FINISH_GRAD,
            u=io,
            delta=delta_io,
            z=io,
            dout=io,
            du=io,
            ddelta=delta_io,
            dz=io,
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
        d0: int,
        width: int,
        k0: int,
        blocks: int,
        bias_in: wp.array(dtype=lanes),
        skip_in: wp.array(dtype=lanes),
        use_softplus: int,
        scale: float,
        scratch: wp.array(dtype=lanes),
        du_in: wp.array3d(dtype=scalar),
        ddelta_in: wp.array3d(dtype=delta_scalar),
        dz_in: wp.array3d(dtype=scalar),
        dskip_out: wp.array(dtype=lanes),
        dbias_out: wp.array(dtype=lanes),
    ): ...

    return SimpleNamespace(prepare=prepare, finish=finish)
