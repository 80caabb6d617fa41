"""The CPU kernels: lanes are adjacent channels, tokens run in strips, states a few at a time.

A task is one batch element, a segment of its tokens, and lane groups of one channel group. In a
strip it holds what does not depend on the state n, and walks the tokens once per few n and lane
group: their h_n live in registers and N is free. Equations are those of README.md.
"""

import functools
from typing import no_type_check

import torch
import warp as wp

from ...runtime.lanes import WARP_DTYPES, W, flush_denormals, lanes, restore_denormals
from ...runtime.rows import settle
from ...runtime.views import struct
from . import recurrence, tokens
from .decays import KEPT, SCALES
from .layout import BLOCKS
from .recurrence import NEED_DB, NEED_DC
from .tokens import EXTRA, GRAD_TOKEN, LATE, TOKEN
from .tuning import Tuning

SPAN = 32  # lane groups of a task at most: rows are read in long parts that fit a core's cache

_P = wp.constant(BLOCKS)
_W = wp.constant(W)
_DC, _DB = wp.constant(NEED_DC), wp.constant(NEED_DB)


@struct
class Sizes:
    """What the kernels know: shapes, options, and which gradients are wanted."""

    length: int
    segment: int  # tokens of a segment, a multiple of the chunk
    segments: int
    batch: int
    states: int
    groups: int
    group_width: int
    group_blocks: int
    span: int
    use_softplus: int
    use_z: int
    needs: int
    stream: int  # whether results go past the caches


@struct
class Place:
    """Where a task works."""

    b: int
    state: int  # row of the state arrays, which are ordered by segment, then batch element
    group: int
    begin: int  # tokens
    end: int
    k: int  # lane groups
    blocks: int
    d: int  # channels
    width: int
    part: int  # row of the partial sums of dB and dC


@wp.func
@no_type_check
def _place(sizes: Sizes, task: int) -> Place:
    spans = (sizes.group_blocks + sizes.span - 1) / sizes.span
    first = task % spans * sizes.span
    rest = task / spans
    group = rest % sizes.groups
    rest = rest / sizes.groups
    p = Place()
    p.b = rest % sizes.batch
    p.state = rest
    p.group = group
    parts = (sizes.group_blocks + _P - 1) / _P
    p.part = (p.b * sizes.groups + group) * parts + first / _P
    p.begin = rest / sizes.batch * sizes.segment
    p.end = wp.min(p.begin + sizes.segment, sizes.length)
    p.blocks = wp.min(sizes.span, sizes.group_blocks - first)
    p.k = group * sizes.group_blocks + first
    p.d = group * sizes.group_width + first * _W
    p.width = wp.min(p.blocks * _W, sizes.group_width - first * _W)
    return p


@functools.cache
def forward_kernel(
    tuning: Tuning, io: torch.dtype, delta_io: torch.dtype, discretization: str, output: bool
):
    """Brings the states in ``h_out`` from before each segment to after it.

    States, gradients of states and products of decays are pairs: N values, then for each what it
    has rounded away (``decays.py``).

    With ``output`` it computes y; else it multiplies the decays into ``product_out``, and z, C and
    skip are not used.
    """
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]
    token = tokens.forward_leaves(io, delta_io)
    state = recurrence.forward_leaves(discretization, tuning)
    prepare, finish = token.prepare, token.finish
    advance, accumulate = state.advance, state.accumulate
    scale, chunk_size, strip_size = SCALES[discretization], tuning.chunk, tuning.strip
    room = TOKEN * strip_size + EXTRA

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def scan_forward(
        offset: int,
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array2d(dtype=lanes),
        widest_in: wp.array(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        c_in: wp.array4d(dtype=wp.float32),
        skip_in: wp.array(dtype=lanes),
        bias_in: wp.array(dtype=lanes),
        # out
        h_out: wp.array3d(dtype=lanes),
        product_out: wp.array3d(dtype=lanes),
        starts_out: wp.array4d(dtype=lanes),
        y_out: wp.array3d(dtype=scalar),
    ):
        p = _place(sizes, offset + wp.tid())
        token = wp.zeros(shape=(room,), dtype=lanes)
        write_soon = wp.static(int(output)) * (1 - sizes.stream)
        before = flush_denormals()
        for strip in range((p.end - p.begin + strip_size - 1) / strip_size):
            t0 = p.begin + strip * strip_size
            count = wp.min(strip_size, p.end - t0)
            for j in range(p.blocks):
                k = p.k + j
                d = p.d + j * _W
                width = p.width - j * _W
                h = h_out[p.state, k]
                if starts_out.shape[1] > 0 and t0 % chunk_size == 0:
                    for n in range(sizes.states):
                        starts_out[p.b, t0 / chunk_size, k, n] = h[n]
                tame = prepare(
                    u_in, delta_in, z_in, p.b, t0, count, d, width, j, p.blocks, strip_size, p.end,
                    widest_in[k], bias_in[k], skip_in[k], sizes.use_softplus, sizes.use_z,
                    write_soon, wp.static(scale), token, y_out,
                )  # fmt: skip
                if wp.static(output):
                    advance(
                        sizes.states, tame, p.b, p.group, t0, count, a_in[k], b_in, c_in, token, h
                    )
                    finish(p.b, t0, count, d, width, sizes.stream, token, y_out)
                else:
                    accumulate(
                        sizes.states, tame, p.b, p.group, t0, count, a_in[k], b_in, token, h,
                        product_out[p.state, k],
                    )  # fmt: skip
        restore_denormals(before)
        settle()

    return scan_forward


@functools.cache
def gradient_states_kernel(
    tuning: Tuning, io: torch.dtype, delta_io: torch.dtype, discretization: str
):
    """What a segment's outputs send back to the state before it, and the products of the decays."""
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]
    prepare = tokens.backward_leaves(io, delta_io).prepare
    gather = recurrence.backward_leaves(discretization, tuning).gather
    scale, chunk_size = SCALES[discretization], tuning.chunk
    room, late_room = GRAD_TOKEN * chunk_size + EXTRA, LATE * chunk_size + 1

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def scan_gradient_states(
        offset: int,
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array2d(dtype=lanes),
        widest_in: wp.array(dtype=lanes),
        c_in: wp.array4d(dtype=wp.float32),
        bias_in: wp.array(dtype=lanes),
        dout_in: wp.array3d(dtype=scalar),
        # out
        dh_out: wp.array3d(dtype=lanes),
        product_out: wp.array3d(dtype=lanes),
    ):
        p = _place(sizes, offset + wp.tid())
        token = wp.zeros(shape=(room,), dtype=lanes)
        late = wp.zeros(shape=(late_room,), dtype=lanes)
        before = flush_denormals()
        for chunk in range((p.end - p.begin + chunk_size - 1) / chunk_size):
            t0 = p.begin + chunk * chunk_size
            count = wp.min(chunk_size, p.end - t0)
            for j in range(p.blocks):
                k = p.k + j
                tame = prepare(
                    u_in, delta_in, z_in, dout_in, p.b, t0, count, p.d + j * _W,
                    p.width - j * _W, j, p.blocks, chunk_size, p.end, widest_in[k], bias_in[k],
                    bias_in[k], sizes.use_softplus, sizes.use_z, 0, wp.static(scale), token, late,
                    u_in, delta_in, z_in,
                )  # fmt: skip
                gather(
                    sizes.states, tame, p.b, p.group, t0, count, a_in[k], c_in, token,
                    dh_out[p.state, k], product_out[p.state, k],
                )  # fmt: skip
        restore_denormals(before)

    return scan_gradient_states


@functools.cache
def backward_kernel(tuning: Tuning, io: torch.dtype, delta_io: torch.dtype, discretization: str):
    """Computes all gradients from those of the states after each segment, in ``dh_out``."""
    scalar, delta_scalar = WARP_DTYPES[io], WARP_DTYPES[delta_io]
    token = tokens.backward_leaves(io, delta_io)
    state = recurrence.backward_leaves(discretization, tuning)
    prepare, finish = token.prepare, token.finish
    retreat, sum_lanes, scale = state.retreat, state.sum_lanes, SCALES[discretization]
    chunk_size = tuning.chunk
    room, late_room = GRAD_TOKEN * chunk_size + EXTRA, LATE * chunk_size + 1
    kept_room = len(KEPT[discretization]) * tuning.walked_back * chunk_size + 1

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def scan_backward(
        offset: int,
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array2d(dtype=lanes),
        widest_in: wp.array(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        c_in: wp.array4d(dtype=wp.float32),
        skip_in: wp.array(dtype=lanes),
        bias_in: wp.array(dtype=lanes),
        starts_in: wp.array4d(dtype=lanes),
        dout_in: wp.array3d(dtype=scalar),
        # scratch
        db_lanes_out: wp.array2d(dtype=lanes),
        dc_lanes_out: wp.array2d(dtype=lanes),
        # out
        dh_out: wp.array3d(dtype=lanes),
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
        da_out: wp.array3d(dtype=lanes),
        db_out: wp.array2d(dtype=wp.float32),
        dc_out: wp.array2d(dtype=wp.float32),
        dskip_out: wp.array3d(dtype=lanes),
        dbias_out: wp.array3d(dtype=lanes),
    ):
        task = offset + wp.tid()
        p = _place(sizes, task)
        token = wp.zeros(shape=(room,), dtype=lanes)
        kept = wp.zeros(shape=(kept_room,), dtype=lanes)
        late = wp.zeros(shape=(late_room,), dtype=lanes)
        before = flush_denormals()
        chunks = (p.end - p.begin + chunk_size - 1) / chunk_size
        for reverse in range(chunks):
            t0 = p.begin + (chunks - 1 - reverse) * chunk_size
            count = wp.min(chunk_size, p.end - t0)
            for j in range(p.blocks):
                k = p.k + j
                d = p.d + j * _W
                width = p.width - j * _W
                tame = prepare(
                    u_in, delta_in, z_in, dout_in, p.b, t0, count, d, width, j, p.blocks,
                    -chunk_size, p.end, widest_in[k], bias_in[k], skip_in[k], sizes.use_softplus,
                    sizes.use_z, 1 - sizes.stream, wp.static(scale), token, late, du_out,
                    ddelta_out, dz_out,
                )  # fmt: skip
                retreat(
                    sizes.states, tame, p.b, p.group, t0, count, int(j % _P == 0),
                    sizes.needs, a_in[k], b_in, c_in, starts_in[p.b, t0 / chunk_size, k], token,
                    kept, db_lanes_out[task], dc_lanes_out[task], dh_out[p.state, k],
                    da_out[p.state, k],
                )  # fmt: skip
                finish(
                    p.b, t0, count, d, width, k, sizes.stream, skip_in[k], wp.static(scale), token,
                    late, du_out, ddelta_out, dz_out, dskip_out[p.b, t0 / chunk_size],
                    dbias_out[p.b, t0 / chunk_size],
                )  # fmt: skip
                if j % _P == _P - 1 or j == p.blocks - 1:
                    part = p.part + j / _P
                    if (sizes.needs & _DB) != 0:
                        sum_lanes(
                            sizes.states, sizes.length, t0, count, db_lanes_out[task],
                            db_out[part],
                        )  # fmt: skip
                    if (sizes.needs & _DC) != 0:
                        sum_lanes(
                            sizes.states, sizes.length, t0, count, dc_lanes_out[task],
                            dc_out[part],
                        )  # fmt: skip
        restore_denormals(before)
        settle()

    return scan_backward
