"""The forward kernels of the CUDA scan: a segment of the sequence from its first state.

A tile of tokens at a time is loaded, turned into δ and δu in shared memory, walked by the
recurrence, and gated and stored, with one barrier a tile: there are two buffers, and the loads of
the next tile are on their way meanwhile. ``summarise_forward`` is the same from h = 0 without
outputs, for all segments but the last at once.
"""

import functools
from typing import no_type_check

import warp as wp

from ...runtime.native import WARP_DTYPES
from ...runtime.scalars import sigmoid
from ..problem import DISCRETIZATIONS
from .blocks import (
    MARK,
    BlockShape,
    Position,
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


def tile_tokens(f: BlockShape) -> int:
    """Tokens of a tile: fewer where B and C of very many states would fill shared memory."""
    return 16 if f.padded <= 128 else 8


@functools.cache
def forward_kernel(
    dtypes: tuple,
    mode: str,
    f: BlockShape,
    read: bool,
    summary: bool,
    use_softplus: bool,
    use_z: bool,
):
    """The kernel of one static shape.

    Args:
        dtypes: of u, delta, and of B and C.
        mode: the discretization.
        read: with outputs; without, C and the output are left out.
        summary: from h = 0, giving the last state and the decay of the segment.
    """
    io, delta_io, matrix = dtypes
    scalar, delta_scalar, matrix_scalar = (WARP_DTYPES[x] for x in dtypes)
    tokens = tile_tokens(f)
    position = position_of(f)
    vec, read_states, write_states = states_io(f)
    count, raw, fetch, store = channel_io(f, io, tokens)
    _, _, fetch_delta, _ = channel_io(f, delta_io, tokens)
    widen, step_of = widening(io), stepping(delta_io, use_softplus)
    parts = {"STEP": tokens * f.span, "IN": tokens * f.span, "W": tokens * f.padded}
    if read:
        parts |= {"C": tokens * f.padded, "Y": f.lanes * (tokens * f.span + f.pad)}
    offset, size = offsets(parts)
    arena_type, put, get = arena_io(2 * size)
    _, fetch_matrix, put_matrix = matrix_io(f, matrix, tokens, 2 * size)
    advance, decay = recurrence(f, mode, tokens, tuple(offset.items()), 2 * size, read, False)
    rule = DISCRETIZATIONS[mode]
    multiply, scale = summary and not rule.exponential, rule.scale

    @wp.func
    def finish(
        p: Position, arena: arena_type, base: int, t0: int, u: raw, z: raw,
        skip: float, y_out: wp.array3d(dtype=scalar),
    ):  # fmt: skip
        # equation 5
        left = wp.where(p.active != 0, p.end - t0 - p.row, 0)
        for i in range(wp.static(count)):
            t = p.row + wp.static(i * f.rows)
            if wp.static(i * f.rows) < left:
                y = skip * widen(u[i])
                for q in range(wp.static(f.lanes)):
                    part = wp.static(offset["Y"]) + q * wp.static(tokens * f.span + f.pad)
                    y += get(arena, base + part + t * wp.static(f.span) + p.c)
                if wp.static(use_z):
                    gate = widen(z[i])
                    y *= gate * sigmoid(gate)
                store(y_out, p.b, p.d, t0 + t, y)

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=f.block, grid_stride=False)
    @no_type_check
    def scan_forward(
        # in
        sizes: Sizes,
        packed_in: wp.array2d(dtype=int),
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array3d(dtype=float),
        b_in: wp.array4d(dtype=matrix_scalar),
        c_in: wp.array4d(dtype=matrix_scalar),
        skip_in: wp.array(dtype=float),
        bias_in: wp.array(dtype=float),
        first_in: wp.array3d(dtype=float),
        # out
        last_out: wp.array3d(dtype=float),
        decay_out: wp.array3d(dtype=float),
        saved_out: wp.array3d(dtype=float),
        y_out: wp.array3d(dtype=scalar),
    ):
        index, lane = wp.tid()
        p = position(sizes, packed_in, index, lane)
        arena = wp.tile_empty(shape=(wp.static(2 * size),), dtype=float, storage="shared")
        a = read_states(a_in, 0, p) * wp.static(scale)
        h = vec()
        if wp.static(not summary):
            h = read_states(first_in, p.segment_row, p)
        product = vec(1.0)
        bias = bias_in[p.d]
        skip = skip_in[p.d]
        total = wp.float32(0.0)
        u = fetch(u_in, p, p.begin, p.end)
        delta = fetch_delta(delta_in, p, p.begin, p.end)
        b = fetch_matrix(b_in, p, p.begin, p.end)
        c = fetch_matrix(c_in, p, p.begin, p.end)
        u_before = raw()
        z_before = raw()
        tiles = (p.end - p.begin + wp.static(tokens - 1)) / wp.static(tokens)
        if wp.static(summary):  # the last segment's is not needed
            tiles = wp.where(p.segment == p.last, 0, tiles)
        for tile in range(tiles):
            t0 = p.begin + tile * wp.static(tokens)
            base = (tile % 2) * wp.static(size)
            left = wp.where(p.active != 0, p.end - t0 - p.row, 0)
            for i in range(wp.static(count)):
                t = p.row + wp.static(i * f.rows)
                step = step_of(delta[i], bias, wp.static(i * f.rows) < left)
                e = base + t * wp.static(f.span) + p.c
                put(arena, e + wp.static(offset["STEP"]), step)
                put(arena, e + wp.static(offset["IN"]), step * widen(u[i]))
                total += step
            put_matrix(arena, base + wp.static(offset["W"]), p, b)
            if wp.static(read):
                put_matrix(arena, base + wp.static(offset["C"]), p, c)
            sync()
            if wp.static(read):
                if tile > 0:
                    t = t0 - wp.static(tokens)
                    finish(p, arena, wp.static(size) - base, t, u_before, z_before, skip, y_out)
                u_before = u
                if wp.static(use_z):
                    z_before = fetch(z_in, p, t0, p.end)
                c = fetch_matrix(c_in, p, t0 + wp.static(tokens), p.end)
            u = fetch(u_in, p, t0 + wp.static(tokens), p.end)
            delta = fetch_delta(delta_in, p, t0 + wp.static(tokens), p.end)
            b = fetch_matrix(b_in, p, t0 + wp.static(tokens), p.end)
            if wp.static(not summary):
                if sizes.save != 0 and (t0 - p.begin) % MARK == 0:
                    write_states(saved_out, p.mark + (t0 - p.begin) / MARK, p, h)
            if wp.static(multiply):
                product = decay(arena, base, p, a, product)
            h = advance(arena, base, p, a, h)
        if wp.static(read):
            sync()
            t0 = p.begin + (tiles - 1) * wp.static(tokens)
            base = ((tiles - 1) % 2) * wp.static(size)
            if tiles > 0:  # a packed sequence may have no token
                finish(p, arena, base, t0, u_before, z_before, skip, y_out)
        if wp.static(summary):
            write_states(last_out, p.segment_row, p, h)
            if wp.static(multiply):
                write_states(decay_out, p.segment_row, p, product)
            elif p.active != 0:
                decay_out[p.segment_row, p.row, p.d] = total
        elif p.segment == p.last:
            write_states(last_out, p.sequence, p, h)

    return scan_forward
