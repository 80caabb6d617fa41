"""First kernel of a gradient in segments: a segment's gradient from its outputs alone.

It is computed for all segments but the first at once; ``carry`` then gives each segment the
gradient of the state after it, and ``backward.py`` walks them all.
"""

import functools
from typing import no_type_check

import warp as wp

from ...runtime.native import WARP_DTYPES
from ...runtime.scalars import sigmoid
from ..problem import DISCRETIZATIONS
from .blocks import (
    BlockShape,
    Sizes,
    arena_io,
    channel_io,
    matrix_io,
    offsets,
    position_of,
    recurrence,
    states_io,
    stepping,
    sync,
    widening,
)

TILE = 16  # tokens


@functools.cache
def summary_kernel(
    dtypes: tuple, mode: str, f: BlockShape, use_softplus: bool, use_z: bool, read: bool
):
    """Kernel of each segment's gradient by its first state, and of its decay.

    Args: as ``backward_kernel``.
    """
    io, delta_io, matrix = dtypes
    scalar, delta_scalar, matrix_scalar = (WARP_DTYPES[x] for x in dtypes)
    position = position_of(f)
    vec, read_states, write_states = states_io(f)
    count, raw, fetch, _ = channel_io(f, io, TILE)
    _, _, fetch_delta, _ = channel_io(f, delta_io, TILE)
    widen, step_of = widening(io), stepping(delta_io, use_softplus)
    offset, size = offsets({"STEP": TILE * f.span, "IN": TILE * f.span, "W": TILE * f.padded})
    arena_type, put, _ = arena_io(2 * size)
    _, fetch_matrix, put_matrix = matrix_io(f, matrix, TILE, 2 * size)
    reverse, decay = recurrence(f, mode, TILE, tuple(offset.items()), 2 * size, False, True)
    rule = DISCRETIZATIONS[mode]
    multiply, scale = not rule.exponential, rule.scale

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=f.block, grid_stride=False)
    @no_type_check
    def summarise_backward(
        # in
        sizes: Sizes,
        packed_in: wp.array2d(dtype=int),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array3d(dtype=float),
        c_in: wp.array4d(dtype=matrix_scalar),
        bias_in: wp.array(dtype=float),
        dout_in: wp.array3d(dtype=scalar),
        # out
        first_out: wp.array3d(dtype=float),
        decay_out: wp.array3d(dtype=float),
    ):
        index, lane = wp.tid()
        p = position(sizes, packed_in, index, lane)
        arena = wp.tile_empty(shape=(wp.static(2 * size),), dtype=float, storage="shared")
        a = read_states(a_in, 0, p) * wp.static(scale)
        dh = vec()
        product = vec(1.0)
        bias = bias_in[p.d]
        total = wp.float32(0.0)
        tiles = (p.end - p.begin + wp.static(TILE - 1)) / wp.static(TILE)
        tiles = wp.where(p.segment == 0, 0, tiles)  # the first segment's is not needed
        t0 = p.begin + (tiles - 1) * wp.static(TILE)
        end = wp.where(tiles > 0, p.end, 0)
        z = raw()
        delta = fetch_delta(delta_in, p, t0, end)
        dout = fetch(dout_in, p, t0, end)
        c = fetch_matrix(c_in, p, t0, end)
        if wp.static(use_z):
            z = fetch(z_in, p, t0, end)
        for again in range(tiles):
            base = (again % 2) * wp.static(size)
            left = wp.where(p.active != 0, end - t0 - p.row, 0)
            for i in range(wp.static(count)):
                step = step_of(delta[i], bias, wp.static(i * f.rows) < left)
                dy = wp.where(wp.static(i * f.rows) < left, widen(dout[i]), 0.0)
                if wp.static(not read):
                    dy = 0.0
                if wp.static(use_z):
                    dy *= widen(z[i]) * sigmoid(widen(z[i]))
                e = base + (p.row + wp.static(i * f.rows)) * wp.static(f.span) + p.c
                put(arena, e + wp.static(offset["STEP"]), step)
                put(arena, e + wp.static(offset["IN"]), dy)
                total += step
            put_matrix(arena, base + wp.static(offset["W"]), p, c)
            sync()
            t0 -= wp.static(TILE)
            delta = fetch_delta(delta_in, p, t0, end)
            dout = fetch(dout_in, p, t0, end)
            c = fetch_matrix(c_in, p, t0, end)
            if wp.static(use_z):
                z = fetch(z_in, p, t0, end)
            if wp.static(multiply):
                product = decay(arena, base, p, a, product)
            dh = reverse(arena, base, p, a, dh)
        write_states(first_out, p.segment_row, p, dh)
        if wp.static(multiply):
            write_states(decay_out, p.segment_row, p, product)
        elif p.active != 0:
            decay_out[p.segment_row, p.row, p.d] = total

    return summarise_backward
