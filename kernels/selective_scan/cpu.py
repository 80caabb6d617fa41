"""The scan on a CPU: lanes are adjacent channels, tokens run in chunks, states one by one.

A task is one batch element and up to ``BLOCKS`` lane groups. In a chunk of ``CHUNK`` tokens it
keeps what does not depend on the state n (step, input, output) in local arrays and walks the tokens
once per n, so that h_n lives in registers and N is free. Equations are those of README.md.
"""

import functools

import torch
import warp as wp
from torch import Tensor

from ..interop import lane_contiguous, parallel_launch, view
from .lanes import (
    ACCESSORS,
    WARP_DTYPES,
    W,
    flush_denormals,
    fma,
    lanes,
    restore_denormals,
    sigmoid,
    softplus,
    times,
)
from .layout import BLOCKS, CHUNK, Layout
from .recurrence import (
    MODES,
    NEED_DB,
    NEED_DC,
    NEED_DH,
    NEED_DZ,
    advance,
    recompute,
    retreat,
    sum_lanes,
)

_K = wp.constant(CHUNK)
_K1 = wp.constant(CHUNK + 1)
_P = wp.constant(BLOCKS)
_W = wp.constant(W)
_DZ, _DC, _DB, _DH = (wp.constant(v) for v in (NEED_DZ, NEED_DC, NEED_DB, NEED_DH))


@wp.struct
class Sizes:
    """What both kernels know: shapes, options, and which gradients are wanted."""

    length: int
    states: int
    groups: int
    group_width: int
    group_blocks: int
    parts: int
    use_softplus: int
    use_z: int
    needs: int


def _sizes(layout: Layout, softplus: bool, z: Tensor | None, needs: int = 0) -> Sizes:
    sizes = Sizes()
    for name in ("length", "states", "groups", "group_width", "group_blocks", "parts"):
        setattr(sizes, name, getattr(layout, name))
    sizes.use_softplus, sizes.use_z, sizes.needs = int(softplus), int(z is not None), needs
    return sizes


@functools.cache
def _forward_kernel(io: torch.dtype, delta_io: torch.dtype, discretization: str):
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]
    (load, store), (load_delta, _) = ACCESSORS[io], ACCESSORS[delta_io]
    mode = MODES[discretization]
    scale = 1.0 if discretization == "bilinear" else 1.4426950408889634

    @wp.kernel(enable_backward=False, module="unique")
    def scan_forward(
        offset: int,
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array2d(dtype=lanes),
        b_in: wp.array2d(dtype=wp.float32),
        c_in: wp.array2d(dtype=wp.float32),
        skip_in: wp.array(dtype=lanes),
        bias_in: wp.array(dtype=lanes),
        # out
        h_out: wp.array3d(dtype=lanes),
        starts_out: wp.array4d(dtype=lanes),
        y_out: wp.array3d(dtype=scalar),
    ):
        task = offset + wp.tid()
        part = task % sizes.parts
        row0 = task / sizes.parts * sizes.states
        b = task / (sizes.parts * sizes.groups)
        group = task / sizes.parts % sizes.groups
        rate = wp.zeros(shape=(_K,), dtype=lanes)
        du = wp.zeros(shape=(_K,), dtype=lanes)
        y = wp.zeros(shape=(_K,), dtype=lanes)
        before = flush_denormals()
        for chunk in range((sizes.length + _K - 1) / _K):
            t0 = chunk * _K
            count = wp.min(_K, sizes.length - t0)
            for block in range(part * _P, wp.min((part + 1) * _P, sizes.group_blocks)):
                k = group * sizes.group_blocks + block
                d = group * sizes.group_width + block * _W
                width = wp.min(_W, sizes.group_width - block * _W)
                for t in range(count):
                    step = load_delta(delta_in, b, t0 + t, d, width) + bias_in[k]
                    if sizes.use_softplus != 0:
                        step = softplus(step)
                    ut = load(u_in, b, t0 + t, d, width)
                    rate[t] = step * wp.static(scale)
                    du[t] = times(step, ut)
                    y[t] = times(skip_in[k], ut)
                for n in range(sizes.states):
                    row = row0 + n
                    h = h_out[b, k, n]
                    if starts_out.shape[1] > 0:
                        starts_out[b, chunk, k, n] = h
                    h_out[b, k, n] = advance(
                        wp.static(mode), h, a_in[k, n], rate, du, b_in[row], c_in[row], t0, count, y
                    )
                for t in range(count):
                    out = y[t]
                    if sizes.use_z != 0:
                        zt = load(z_in, b, t0 + t, d, width)
                        out = times(out, times(zt, sigmoid(zt)))
                    store(y_out, b, t0 + t, d, width, out)
        restore_denormals(before)

    return scan_forward


@functools.cache
def _backward_kernel(io: torch.dtype, delta_io: torch.dtype, discretization: str):
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]
    (load, store), (load_delta, store_delta) = ACCESSORS[io], ACCESSORS[delta_io]
    mode = MODES[discretization]
    scale = 1.0 if discretization == "bilinear" else 1.4426950408889634

    @wp.kernel(enable_backward=False, module="unique")
    def scan_backward(
        offset: int,
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array2d(dtype=lanes),
        b_in: wp.array2d(dtype=wp.float32),
        c_in: wp.array2d(dtype=wp.float32),
        skip_in: wp.array(dtype=lanes),
        bias_in: wp.array(dtype=lanes),
        starts_in: wp.array4d(dtype=lanes),
        dout_in: wp.array3d(dtype=scalar),
        # scratch
        db_sums_out: wp.array2d(dtype=lanes),
        dc_sums_out: wp.array2d(dtype=lanes),
        # out
        dh_out: wp.array3d(dtype=lanes),
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
        da_out: wp.array3d(dtype=lanes),
        db_out: wp.array3d(dtype=wp.float32),
        dc_out: wp.array3d(dtype=wp.float32),
        dskip_out: wp.array2d(dtype=lanes),
        dbias_out: wp.array2d(dtype=lanes),
    ):
        task = offset + wp.tid()
        part = task % sizes.parts
        row0 = task / sizes.parts * sizes.states
        b = task / (sizes.parts * sizes.groups)
        group = task / sizes.parts % sizes.groups
        step = wp.zeros(shape=(_K,), dtype=lanes)
        rate = wp.zeros(shape=(_K,), dtype=lanes)
        du = wp.zeros(shape=(_K,), dtype=lanes)
        dy = wp.zeros(shape=(_K,), dtype=lanes)
        y = wp.zeros(shape=(_K,), dtype=lanes)
        s = wp.zeros(shape=(_K,), dtype=lanes)
        p = wp.zeros(shape=(_K,), dtype=lanes)
        f = wp.zeros(shape=(_K,), dtype=lanes)
        h = wp.zeros(shape=(_K1,), dtype=lanes)
        da = wp.zeros(shape=(1,), dtype=lanes)
        before = flush_denormals()
        chunks = (sizes.length + _K - 1) / _K
        for reverse in range(chunks):
            chunk = chunks - 1 - reverse
            t0 = chunk * _K
            count = wp.min(_K, sizes.length - t0)
            for i in range(db_sums_out.shape[1]):
                db_sums_out[task, i] = lanes()
            for i in range(dc_sums_out.shape[1]):
                dc_sums_out[task, i] = lanes()
            for block in range(part * _P, wp.min((part + 1) * _P, sizes.group_blocks)):
                k = group * sizes.group_blocks + block
                d = group * sizes.group_width + block * _W
                width = wp.min(_W, sizes.group_width - block * _W)
                for t in range(count):
                    x = load_delta(delta_in, b, t0 + t, d, width) + bias_in[k]
                    if sizes.use_softplus != 0:
                        x = softplus(x)
                    ut = load(u_in, b, t0 + t, d, width)
                    grad = load(dout_in, b, t0 + t, d, width)
                    if sizes.use_z != 0:
                        zt = load(z_in, b, t0 + t, d, width)
                        grad = times(grad, times(zt, sigmoid(zt)))
                    step[t] = x
                    rate[t] = x * wp.static(scale)
                    du[t] = times(x, ut)
                    dy[t] = grad
                    y[t] = times(skip_in[k], ut)
                    s[t] = lanes()
                    p[t] = lanes()
                for n in range(sizes.states):
                    row = row0 + n
                    a = a_in[k, n]
                    first = n * _K
                    recompute(
                        wp.static(mode), starts_in[b, chunk, k, n], a, rate, du,
                        b_in[row], c_in[row], t0, count, dy, sizes.needs, first, y, f, h,
                        dc_sums_out[task],
                    )  # fmt: skip
                    if (sizes.needs & _DH) != 0:
                        dh_out[b, k, n] = retreat(
                            wp.static(mode), dh_out[b, k, n], a, rate, du,
                            b_in[row], c_in[row], t0, count, step, dy, f, h, sizes.needs, first,
                            s, p, db_sums_out[task], da,
                        )  # fmt: skip
                        da_out[b, k, n] = da_out[b, k, n] + da[0]
                dskip = lanes()
                dbias = lanes()
                for t in range(count):
                    ut = load(u_in, b, t0 + t, d, width)
                    dskip = fma(dy[t], ut, dskip)
                    if (sizes.needs & _DZ) != 0:
                        zt = load(z_in, b, t0 + t, d, width)
                        sig = sigmoid(zt)
                        slope = fma(times(zt, sig), lanes(1.0) - sig, sig)
                        grad = load(dout_in, b, t0 + t, d, width)
                        store(dz_out, b, t0 + t, d, width, times(times(grad, y[t]), slope))
                    ddelta = fma(ut, s[t], p[t])
                    if sizes.use_softplus != 0:
                        x = load_delta(delta_in, b, t0 + t, d, width) + bias_in[k]
                        ddelta = times(ddelta, sigmoid(x))
                    dbias = dbias + ddelta
                    if du_out.shape[1] > 0:
                        v = fma(step[t], s[t], times(skip_in[k], dy[t]))
                        store(du_out, b, t0 + t, d, width, v)
                    if ddelta_out.shape[1] > 0:
                        store_delta(ddelta_out, b, t0 + t, d, width, ddelta)
                dskip_out[b, k] = dskip_out[b, k] + dskip
                dbias_out[b, k] = dbias_out[b, k] + dbias
            if (sizes.needs & _DB) != 0:
                for n in range(sizes.states):
                    sum_lanes(db_sums_out[task], n * _K, count, t0, db_out[task, n])
            if (sizes.needs & _DC) != 0:
                for n in range(sizes.states):
                    sum_lanes(dc_sums_out[task], n * _K, count, t0, dc_out[task, n])
        restore_denormals(before)

    return scan_backward


def forward(u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save):
    """Runs the scan on the CPU.

    Arguments as ``selective_scan`` with B, C ``[B, L, G, N]``; ``save`` keeps the states that
    ``backward`` starts from.

    Returns:
        ``out [B, L, D]``, the last state ``[B, D, N]`` and the saved states (a private layout).
    """
    layout = Layout(u, A, B)
    lead = (layout.batch,)
    if initial_state is None:
        h = torch.zeros(layout.batch, layout.blocks, layout.states, W)
    else:
        h = layout.pack(initial_state, lead)
    saved = layout.chunks if save else 0
    starts = torch.empty(layout.batch, saved, layout.blocks, layout.states, W)
    out = torch.empty(u.shape, dtype=u.dtype)
    parallel_launch(
        _forward_kernel(u.dtype, delta.dtype, discretization),
        layout.tasks,
        [
            _sizes(layout, softplus, z),
            lane_contiguous(u), lane_contiguous(delta), lane_contiguous(u if z is None else z),
            view(layout.pack(A), lanes), layout.rows(B), layout.rows(C),
            view(layout.pack(D), lanes), view(layout.pack(delta_bias), lanes),
        ],
        [view(h, lanes), view(starts, lanes), out],
    )  # fmt: skip
    return out, layout.unpack(h, lead), starts


def backward(
    dout, dlast, u, delta, A, B, C, D, z, delta_bias, starts, softplus, discretization, needs
):
    """Gradients of ``forward`` from those of its output (dense) and last state.

    Args:
        needs: nine booleans for u, delta, A, B, C, D, z, delta_bias, initial_state.

    Returns:
        Nine tensors, None where not needed.
    """
    layout = Layout(u, A, B)
    lead = (layout.batch,)
    need_u, need_delta, need_A, need_B, need_C, _, need_z, need_bias, need_h = needs
    through = need_u or need_delta or need_A or need_B or need_bias or need_h
    flags = NEED_DZ * need_z + NEED_DC * need_C + NEED_DB * need_B + NEED_DH * through

    def like(x: Tensor, needed: bool) -> Tensor:
        return torch.empty(x.shape if needed else (x.shape[0], 0, x.shape[2]), dtype=x.dtype)

    def partial(needed: bool) -> tuple[Tensor, Tensor]:
        rows = layout.states if needed else 0
        sums = torch.empty(layout.tasks, rows * CHUNK, W)
        return sums, torch.empty(layout.tasks, rows, layout.length)

    dh = torch.zeros(layout.batch, layout.blocks, layout.states, W)
    if dlast is not None:
        dh = layout.pack(dlast, lead)
    da = torch.zeros_like(dh)
    dskip, dbias = torch.zeros(2, layout.batch, layout.blocks, W)
    du, ddelta, dz = like(u, need_u), like(delta, need_delta), like(u, need_z)
    db_sums, db = partial(need_B)
    dc_sums, dc = partial(need_C)
    parallel_launch(
        _backward_kernel(u.dtype, delta.dtype, discretization),
        layout.tasks,
        [
            _sizes(layout, softplus, z, flags),
            lane_contiguous(u), lane_contiguous(delta), lane_contiguous(u if z is None else z),
            view(layout.pack(A), lanes), layout.rows(B), layout.rows(C),
            view(layout.pack(D), lanes), view(layout.pack(delta_bias), lanes),
            view(starts, lanes), lane_contiguous(dout),
        ],
        [
            view(db_sums, lanes), view(dc_sums, lanes), view(dh, lanes), du, ddelta, dz,
            view(da, lanes), db, dc, view(dskip, lanes), view(dbias, lanes),
        ],
    )  # fmt: skip
    values = (
        lambda: du,
        lambda: ddelta,
        lambda: layout.unpack(da.sum(0)),
        lambda: layout.total(db, B.dtype),
        lambda: layout.total(dc, C.dtype),
        lambda: layout.unpack(dskip.sum(0)).to(D.dtype),
        lambda: dz,
        lambda: layout.unpack(dbias.sum(0)).to(delta_bias.dtype),
        lambda: layout.unpack(dh, lead),
    )
    return [value() if needed else None for value, needed in zip(values, needs)]


def saved_shape(u: Tensor, A: Tensor, B: Tensor, save: bool) -> tuple[int, ...]:
    """The shape of the saved states that ``forward`` returns."""
    layout = Layout(u, A, B)
    return (layout.batch, layout.chunks if save else 0, layout.blocks, layout.states, W)
