"""The scan on a CPU: lanes are adjacent channels, tokens run in chunks, states one by one.

A task is one batch element and up to ``BLOCKS`` lane groups. In a chunk of ``CHUNK`` tokens it
keeps what does not depend on the state n (step, input, output) in local arrays and walks the tokens
once per n, so that h_n lives in registers and N is free. Equations are those of README.md.
"""

import functools

import torch
import torch.nn.functional as F
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

CHUNK = 64  # tokens; a state is saved at the start of each chunk
BLOCKS = 4  # lane groups of a task; fixed, so that sums do not depend on the number of threads

_K = wp.constant(CHUNK)
_K1 = wp.constant(CHUNK + 1)
_P = wp.constant(BLOCKS)
_W = wp.constant(W)
_DZ, _DC, _DB, _DH = (wp.constant(v) for v in (NEED_DZ, NEED_DC, NEED_DB, NEED_DH))


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
        length: int,
        states: int,
        group_width: int,
        group_blocks: int,
        parts: int,
        use_softplus: int,
        use_z: int,
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
        part = task % parts
        group_row = task / parts
        groups = h_out.shape[1] / group_blocks
        b = group_row / groups
        group = group_row % groups
        rate = wp.zeros(shape=(_K,), dtype=lanes)
        du = wp.zeros(shape=(_K,), dtype=lanes)
        y = wp.zeros(shape=(_K,), dtype=lanes)
        before = flush_denormals()
        for chunk in range((length + _K - 1) / _K):
            t0 = chunk * _K
            count = wp.min(_K, length - t0)
            for block in range(part * _P, wp.min((part + 1) * _P, group_blocks)):
                k = group * group_blocks + block
                d = group * group_width + block * _W
                width = wp.min(_W, group_width - block * _W)
                for t in range(count):
                    step = load_delta(delta_in, b, t0 + t, d, width) + bias_in[k]
                    if use_softplus != 0:
                        step = softplus(step)
                    ut = load(u_in, b, t0 + t, d, width)
                    rate[t] = step * wp.static(scale)
                    du[t] = times(step, ut)
                    y[t] = times(skip_in[k], ut)
                for n in range(states):
                    row = group_row * states + n
                    h = h_out[b, k, n]
                    if starts_out.shape[1] > 0:
                        starts_out[b, chunk, k, n] = h
                    h_out[b, k, n] = advance(
                        wp.static(mode), h, a_in[k, n], rate, du, b_in[row], c_in[row], t0, count, y
                    )
                for t in range(count):
                    out = y[t]
                    if use_z != 0:
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
        length: int,
        states: int,
        group_width: int,
        group_blocks: int,
        parts: int,
        use_softplus: int,
        use_z: int,
        needs: int,
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
        db_sums: wp.array2d(dtype=lanes),
        dc_sums: wp.array2d(dtype=lanes),
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
        part = task % parts
        group_row = task / parts
        groups = dh_out.shape[1] / group_blocks
        b = group_row / groups
        group = group_row % groups
        raw = wp.zeros(shape=(_K,), dtype=lanes)
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
        chunks = (length + _K - 1) / _K
        for reverse in range(chunks):
            chunk = chunks - 1 - reverse
            t0 = chunk * _K
            count = wp.min(_K, length - t0)
            for i in range(db_sums.shape[1]):
                db_sums[task, i] = lanes()
            for i in range(dc_sums.shape[1]):
                dc_sums[task, i] = lanes()
            for block in range(part * _P, wp.min((part + 1) * _P, group_blocks)):
                k = group * group_blocks + block
                d = group * group_width + block * _W
                width = wp.min(_W, group_width - block * _W)
                for t in range(count):
                    x = load_delta(delta_in, b, t0 + t, d, width) + bias_in[k]
                    raw[t] = x
                    if use_softplus != 0:
                        x = softplus(x)
                    ut = load(u_in, b, t0 + t, d, width)
                    grad = load(dout_in, b, t0 + t, d, width)
                    if use_z != 0:
                        zt = load(z_in, b, t0 + t, d, width)
                        grad = times(grad, times(zt, sigmoid(zt)))
                    step[t] = x
                    rate[t] = x * wp.static(scale)
                    du[t] = times(x, ut)
                    dy[t] = grad
                    y[t] = times(skip_in[k], ut)
                    s[t] = lanes()
                    p[t] = lanes()
                for n in range(states):
                    row = group_row * states + n
                    a = a_in[k, n]
                    first = n * _K
                    recompute(
                        wp.static(mode), starts_in[b, chunk, k, n], a, rate, du,
                        b_in[row], c_in[row], t0, count, dy, needs, first, y, f, h, dc_sums[task],
                    )  # fmt: skip
                    if (needs & _DH) != 0:
                        dh_out[b, k, n] = retreat(
                            wp.static(mode), dh_out[b, k, n], a, rate, du,
                            b_in[row], c_in[row], t0, count, step, dy, f, h, needs, first, s, p,
                            db_sums[task], da,
                        )  # fmt: skip
                        da_out[b, k, n] = da_out[b, k, n] + da[0]
                dskip = lanes()
                dbias = lanes()
                for t in range(count):
                    ut = load(u_in, b, t0 + t, d, width)
                    dskip = fma(dy[t], ut, dskip)
                    if (needs & _DZ) != 0:
                        zt = load(z_in, b, t0 + t, d, width)
                        sig = sigmoid(zt)
                        slope = fma(times(zt, sig), lanes(1.0) - sig, sig)
                        grad = load(dout_in, b, t0 + t, d, width)
                        store(dz_out, b, t0 + t, d, width, times(times(grad, y[t]), slope))
                    ddelta = fma(ut, s[t], p[t])
                    if use_softplus != 0:
                        ddelta = times(ddelta, sigmoid(raw[t]))
                    dbias = dbias + ddelta
                    if du_out.shape[1] > 0:
                        v = fma(step[t], s[t], times(skip_in[k], dy[t]))
                        store(du_out, b, t0 + t, d, width, v)
                    if ddelta_out.shape[1] > 0:
                        store_delta(ddelta_out, b, t0 + t, d, width, ddelta)
                dskip_out[b, k] = dskip_out[b, k] + dskip
                dbias_out[b, k] = dbias_out[b, k] + dbias
            if (needs & _DB) != 0:
                for n in range(states):
                    sum_lanes(db_sums[task], n * _K, count, t0, db_out[task, n])
            if (needs & _DC) != 0:
                for n in range(states):
                    sum_lanes(dc_sums[task], n * _K, count, t0, dc_out[task, n])
        restore_denormals(before)

    return scan_backward


class _Layout:
    """How channels map to lanes: D = groups × group_width, each group in blocks of W, padded."""

    def __init__(self, u: Tensor, A: Tensor, B: Tensor):
        self.batch, self.length, self.channels = u.shape
        self.states, self.groups = A.shape[1], B.shape[2]
        self.group_width = self.channels // self.groups
        self.group_blocks = -(-self.group_width // W)
        self.parts = -(-self.group_blocks // BLOCKS)
        self.blocks = self.groups * self.group_blocks
        self.tasks = self.batch * self.groups * self.parts
        self.chunks = -(-self.length // CHUNK)

    def pack(self, x: Tensor | None, lead: tuple[int, ...] = ()) -> Tensor:
        """``[.., D, *]`` to float32 ``[.., blocks, *, W]``, a copy; None becomes zeros."""
        if x is None:
            return torch.zeros(*lead, self.blocks, W)
        n = len(lead)
        tail = tuple(x.shape[n + 1 :])
        x = x.float().reshape(*lead, self.groups, self.group_width, *tail)
        x = x.movedim(n + 1, -1)
        x = F.pad(x, (0, self.group_blocks * W - self.group_width))
        x = x.reshape(*lead, self.groups, *tail, self.group_blocks, W).movedim(-2, n + 1)
        return x.reshape(*lead, self.blocks, *tail, W).contiguous().clone()

    def unpack(self, x: Tensor, lead: tuple[int, ...] = ()) -> Tensor:
        """The inverse of ``pack``, dense."""
        n = len(lead)
        tail = tuple(x.shape[n + 1 : -1])
        x = x.reshape(*lead, self.groups, self.group_blocks, *tail, W).movedim(n + 1, -2)
        x = x.reshape(*lead, self.groups, *tail, self.group_blocks * W)
        x = x[..., : self.group_width].movedim(-1, n + 1)
        return x.reshape(*lead, self.channels, *tail).contiguous()

    def rows(self, x: Tensor) -> Tensor:
        """``[B, L, G, N]`` to float32 ``[B·G·N, L]``: the tokens of one state are adjacent."""
        rows = self.batch * self.groups * self.states
        return x.permute(0, 2, 3, 1).float().reshape(rows, self.length).contiguous()

    def sizes(self) -> list[int]:
        return [self.length, self.states, self.group_width, self.group_blocks, self.parts]

    def total(self, parts: Tensor, dtype: torch.dtype) -> Tensor:
        """Sums ``[tasks, N, L]`` over the parts of a group: ``[B, L, G, N]``."""
        x = parts.view(self.batch, self.groups, self.parts, self.states, self.length).sum(2)
        return x.permute(0, 3, 1, 2).to(dtype, memory_format=torch.contiguous_format)


def forward(u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save):
    """Runs the scan on the CPU.

    Arguments as ``selective_scan`` with B, C ``[B, L, G, N]``; ``save`` keeps the states that
    ``backward`` starts from.

    Returns:
        ``out [B, L, D]``, the last state ``[B, D, N]`` and the saved states (a private layout).
    """
    layout = _Layout(u, A, B)
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
            *layout.sizes(), int(softplus), int(z is not None),
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
    layout = _Layout(u, A, B)
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
            *layout.sizes(), int(softplus), int(z is not None), flags,
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
    layout = _Layout(u, A, B)
    return (layout.batch, layout.chunks if save else 0, layout.blocks, layout.states, W)
