"""The gradient kernels of the CUDA scan: a segment of the sequence backwards, chunk by chunk.

A chunk starts from the state that the forward saved. It is walked once to mark the state before
every few tokens, then in these few tokens at a time, last first: forwards again, holding decays and
states in registers, and backwards. Sums over states and over the block's channels go through shared
memory, so that dB and dC leave a block once per token and state. ``summarise_backward`` gives
what a segment's own outputs send back through it, for all segments but the first at once.
"""

import functools
from typing import no_type_check

import warp as wp

from ...runtime.lanes import WARP_DTYPES
from ...runtime.scalars import LOG2E, sigmoid, softplus, softplus_slope
from .blocks import (
    MARK,
    BlockShape,
    Place,
    Sizes,
    arena_io,
    channel_io,
    halves,
    matrix_io,
    offsets,
    placing,
    states_io,
    sync,
    widening,
)
from .retreat import lane_stride, retreating, token_stride
from .tokens import SUB, advancing, decaying, marking

TILE = 16  # tokens


def _retreat_layout(f: BlockShape, flags: frozenset) -> tuple[dict, int]:
    partial = f.lanes * lane_stride(f)
    products = SUB * token_stride(f)
    parts = {"STEP": SUB * f.span, "DU": SUB * f.span, "B": SUB * f.padded}
    if "read" in flags:
        parts |= {"DY": SUB * f.span, "C": SUB * f.padded}
    parts |= {
        name: partial
        for name, flag in (("Y", "y"), ("S", "through"), ("P", "through"))
        if flag in flags
    }
    parts |= {name: products for name, flag in (("DB", "dB"), ("DC", "dC")) if flag in flags}
    return offsets(parts)


@functools.cache
def backward_kernel(
    dtypes: tuple, mode: str, f: BlockShape, use_softplus: bool, use_z: bool, flags: frozenset
):
    """The kernel of one static shape.

    Args:
        dtypes: of u, delta, and of B and C.
        mode: the discretization.
        flags: of ``read`` (there are outputs) and of what is wanted: ``du``, ``ddelta``, ``dz``,
            ``dB``, ``dC``, ``y`` (for dz), ``through`` (anything that needs dh).
    """
    io, delta_io, matrix = dtypes
    scalar, delta_scalar, matrix_scalar = (WARP_DTYPES[x] for x in dtypes)
    place = placing(f)
    vec, read_states, write_states = states_io(f)
    pair, join, first_half, second_half = halves(f)
    tile_count, _, fetch_tile, _ = channel_io(f, io, TILE)
    _, _, fetch_tile_delta, _ = channel_io(f, delta_io, TILE)
    count, raw, fetch, store = channel_io(f, io, SUB)
    _, _, fetch_delta, store_delta = channel_io(f, delta_io, SUB)
    own = wp.types.vector(count, wp.float32)
    widen, widen_delta = widening(io), widening(delta_io)
    at, size = _retreat_layout(f, flags)
    tile_at, tile_size = offsets({"STEP": TILE * f.span, "DU": TILE * f.span, "B": TILE * f.padded})
    size = max(size, 2 * tile_size)
    arena_type, put, get = arena_io(size)
    _, fetch_tile_matrix, put_tile_matrix = matrix_io(f, matrix, TILE, size)
    _, fetch_matrix, put_matrix = matrix_io(f, matrix, SUB, size)
    mark = marking(f, mode, TILE, tuple(tile_at.items()), size)
    retreat = retreating(f, mode, tuple(at.items()), size, flags)
    scale = 1.0 if mode == "bilinear" else LOG2E
    marks_size = MARK // SUB * f.walks * f.held + 4
    read = "read" in flags

    @wp.func
    def set_marks(
        p: Place, arena: arena_type, marks_out: wp.array(dtype=float), t0: int, end: int,
        bias: float, a: vec, h: vec,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        b_in: wp.array4d(dtype=matrix_scalar),
    ):  # fmt: skip
        subs = (end - t0 + wp.static(SUB - 1)) / wp.static(SUB)
        u = fetch_tile(u_in, p, t0, end)
        delta = fetch_tile_delta(delta_in, p, t0, end)
        b = fetch_tile_matrix(b_in, p, t0, end)
        for tile in range((end - t0 + wp.static(TILE - 1)) / wp.static(TILE)):
            base = (tile % 2) * wp.static(tile_size)
            first = t0 + tile * wp.static(TILE)
            left = wp.where(p.active != 0, end - first - p.row, 0)
            for i in range(wp.static(tile_count)):
                step = widen_delta(delta[i]) + bias
                if wp.static(use_softplus):
                    step = softplus(step)
                step = wp.where(wp.static(i * f.rows) < left, step, 0.0)
                e = base + (p.row + wp.static(i * f.rows)) * wp.static(f.span) + p.c
                put(arena, e + wp.static(tile_at["STEP"]), step)
                put(arena, e + wp.static(tile_at["DU"]), step * widen(u[i]))
            put_tile_matrix(arena, base + wp.static(tile_at["B"]), p, b)
            sync()
            first += wp.static(TILE)
            u = fetch_tile(u_in, p, first, end)
            delta = fetch_tile_delta(delta_in, p, first, end)
            b = fetch_tile_matrix(b_in, p, first, end)
            h = mark(arena, base, marks_out, tile, subs, p.slot, p.q, a, h)
        sync()

    @wp.func
    def partial(arena: arena_type, p: Place, name: int, t: int) -> float:
        total = get(arena, name + t * wp.static(f.span) + p.c)
        for q in range(1, wp.static(f.lanes)):
            total += get(arena, name + q * wp.static(lane_stride(f)) + t * wp.static(f.span) + p.c)
        return total

    @wp.func
    def finish(
        p: Place, arena: arena_type, t0: int, left: int, u: own, steps: own, slopes: own,
        dys: own, gates: own, skip: float,
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
    ) -> wp.vec2:  # fmt: skip
        # equations 9 and 11; the terms of dD and ddelta_bias
        dskip = wp.float32(0.0)
        dbias = wp.float32(0.0)
        for i in range(wp.static(count)):
            t = p.row + wp.static(i * f.rows)
            if wp.static(i * f.rows) < left:
                dskip += dys[i] * u[i]
                if wp.static("y" in flags):
                    y = partial(arena, p, wp.static(at.get("Y", 0)), t) + skip * u[i]
                    store(dz_out, p.b, p.d, t0 + t, gates[i] * y)
                if wp.static("through" in flags):
                    s = partial(arena, p, wp.static(at.get("S", 0)), t)
                    d = partial(arena, p, wp.static(at.get("P", 0)), t)
                    d = (d * wp.static(1.0 / scale) + u[i] * s) * slopes[i]
                    dbias += d
                    if wp.static("du" in flags):
                        store(du_out, p.b, p.d, t0 + t, steps[i] * s + skip * dys[i])
                    if wp.static("ddelta" in flags):
                        store_delta(ddelta_out, p.b, p.d, t0 + t, d)
        return wp.vec2(dskip, dbias)

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=f.block, grid_stride=False)
    @no_type_check
    def scan_backward(
        # in
        sizes: Sizes,
        u_in: wp.array3d(dtype=scalar),
        delta_in: wp.array3d(dtype=delta_scalar),
        z_in: wp.array3d(dtype=scalar),
        a_in: wp.array3d(dtype=float),
        b_in: wp.array4d(dtype=matrix_scalar),
        c_in: wp.array4d(dtype=matrix_scalar),
        skip_in: wp.array(dtype=float),
        bias_in: wp.array(dtype=float),
        dout_in: wp.array3d(dtype=scalar),
        starts_in: wp.array3d(dtype=float),
        last_in: wp.array3d(dtype=float),
        # out
        first_out: wp.array3d(dtype=float),
        du_out: wp.array3d(dtype=scalar),
        ddelta_out: wp.array3d(dtype=delta_scalar),
        dz_out: wp.array3d(dtype=scalar),
        da_out: wp.array3d(dtype=float),
        db_out: wp.array3d(dtype=float),
        dc_out: wp.array3d(dtype=float),
        dskip_out: wp.array3d(dtype=float),
        dbias_out: wp.array3d(dtype=float),
    ):
        index, lane = wp.tid()
        p = place(sizes, index, lane)
        arena = wp.tile_empty(shape=(wp.static(size),), dtype=float, storage="shared")
        marks = wp.zeros(shape=(wp.static(marks_size),), dtype=float)
        a = read_states(a_in, 0, p) * wp.static(scale)
        state = join(read_states(last_in, p.at, p), vec())
        bias = bias_in[p.d]
        skip = skip_in[p.d]
        sums = wp.vec2()
        row = (p.b * sizes.groups + p.group) * sizes.parts + p.part
        chunks = (p.end - p.begin + wp.static(MARK - 1)) / wp.static(MARK)
        starts = p.b * ((sizes.length + wp.static(MARK - 1)) / wp.static(MARK))
        for back in range(chunks):
            chunk = p.begin + (chunks - 1 - back) * wp.static(MARK)
            end = wp.min(chunk + wp.static(MARK), p.end)
            h = read_states(starts_in, starts + chunk / wp.static(MARK), p)
            set_marks(p, arena, marks, chunk, end, bias, a, h, u_in, delta_in, b_in)
            subs = (end - chunk + wp.static(SUB - 1)) / wp.static(SUB)
            t0 = chunk + (subs - 1) * wp.static(SUB)
            u_raw = fetch(u_in, p, t0, end)
            delta_raw = fetch_delta(delta_in, p, t0, end)
            z_raw = raw()
            dout_raw = raw()
            b_raw = fetch_matrix(b_in, p, t0, end)
            c_raw = b_raw
            if wp.static(read):
                dout_raw = fetch(dout_in, p, t0, end)
                c_raw = fetch_matrix(c_in, p, t0, end)
                if wp.static(use_z):
                    z_raw = fetch(z_in, p, t0, end)
            for again in range(subs):
                t0 = chunk + (subs - 1 - again) * wp.static(SUB)
                left = wp.where(p.active != 0, end - t0 - p.row, 0)
                u = own()
                steps = own()
                slopes = own()
                dys = own()
                gates = own()
                for i in range(wp.static(count)):
                    x = widen_delta(delta_raw[i]) + bias
                    inside = wp.static(i * f.rows) < left
                    slopes[i] = 1.0
                    step = x
                    if wp.static(use_softplus):
                        step = softplus(x)
                        slopes[i] = softplus_slope(x)
                    steps[i] = wp.where(inside, step, 0.0)
                    u[i] = widen(u_raw[i])
                    e = (p.row + wp.static(i * f.rows)) * wp.static(f.span) + p.c
                    put(arena, e + wp.static(at["STEP"]), steps[i])
                    put(arena, e + wp.static(at["DU"]), steps[i] * u[i])
                    if wp.static(read):
                        dy = wp.where(inside, widen(dout_raw[i]), 0.0)
                        if wp.static(use_z):
                            gate = widen(z_raw[i])
                            s = sigmoid(gate)
                            gates[i] = dy * s * (1.0 + gate * (1.0 - s))
                            dy = dy * gate * s
                        dys[i] = dy
                        put(arena, e + wp.static(at.get("DY", 0)), dy)
                put_matrix(arena, wp.static(at["B"]), p, b_raw)
                if wp.static(read):
                    put_matrix(arena, wp.static(at.get("C", 0)), p, c_raw)
                sync()
                ahead = t0 - wp.static(SUB)
                u_raw = fetch(u_in, p, ahead, end)
                delta_raw = fetch_delta(delta_in, p, ahead, end)
                b_raw = fetch_matrix(b_in, p, ahead, end)
                if wp.static(read):
                    dout_raw = fetch(dout_in, p, ahead, end)
                    c_raw = fetch_matrix(c_in, p, ahead, end)
                    if wp.static(use_z):
                        z_raw = fetch(z_in, p, ahead, end)
                state = retreat(
                    arena, 0, marks, subs - 1 - again, p.slot, p.q, lane, p.states,
                    t0, end - t0, row, sizes.length, a, state, db_out, dc_out,
                )  # fmt: skip
                sums += finish(
                    p, arena, t0, left, u, steps, slopes, dys, gates, skip,
                    du_out, ddelta_out, dz_out,
                )  # fmt: skip
            sync()
        if p.segment == 0:
            write_states(first_out, p.b, p, first_half(state))
        write_states(da_out, p.at, p, second_half(state))
        if p.active != 0:
            dskip_out[p.at, p.row, p.d] = sums[0]
            dbias_out[p.at, p.row, p.d] = sums[1]

    return scan_backward


@functools.cache
def summary_kernel(
    dtypes: tuple, mode: str, f: BlockShape, use_softplus: bool, use_z: bool, read: bool
):
    """What each segment's own outputs send to the state it starts from, and its decay.

    Args: as ``backward_kernel``.
    """
    io, delta_io, matrix = dtypes
    scalar, delta_scalar, matrix_scalar = (WARP_DTYPES[x] for x in dtypes)
    place = placing(f)
    vec, read_states, write_states = states_io(f)
    count, raw, fetch, _ = channel_io(f, io, TILE)
    _, _, fetch_delta, _ = channel_io(f, delta_io, TILE)
    widen, widen_delta = widening(io), widening(delta_io)
    at, size = offsets({"STEP": TILE * f.span, "IN": TILE * f.span, "W": TILE * f.padded})
    arena_type, put, _ = arena_io(2 * size)
    _, fetch_matrix, put_matrix = matrix_io(f, matrix, TILE, 2 * size)
    retreat = advancing(f, mode, TILE, tuple(at.items()), 2 * size, False, True)
    decay = decaying(f, mode, TILE, tuple(at.items()), 2 * size)
    multiply = mode == "bilinear"
    scale = 1.0 if multiply else LOG2E

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=f.block, grid_stride=False)
    @no_type_check
    def summarise_backward(
        # in
        sizes: Sizes,
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
        p = place(sizes, index, lane)
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
                step = widen_delta(delta[i]) + bias
                if wp.static(use_softplus):
                    step = softplus(step)
                step = wp.where(wp.static(i * f.rows) < left, step, 0.0)
                dy = wp.where(wp.static(i * f.rows) < left, widen(dout[i]), 0.0)
                if wp.static(not read):
                    dy = 0.0
                if wp.static(use_z):
                    dy *= widen(z[i]) * sigmoid(widen(z[i]))
                e = base + (p.row + wp.static(i * f.rows)) * wp.static(f.span) + p.c
                put(arena, e + wp.static(at["STEP"]), step)
                put(arena, e + wp.static(at["IN"]), dy)
                total += step
            put_matrix(arena, base + wp.static(at["W"]), p, c)
            sync()
            t0 -= wp.static(TILE)
            delta = fetch_delta(delta_in, p, t0, end)
            dout = fetch(dout_in, p, t0, end)
            c = fetch_matrix(c_in, p, t0, end)
            if wp.static(use_z):
                z = fetch(z_in, p, t0, end)
            if wp.static(multiply):
                product = decay(arena, base, p.slot, p.q, a, product)
            dh = retreat(arena, base, p.slot, p.q, a, dh)
        write_states(first_out, p.at, p, dh)
        if wp.static(multiply):
            write_states(decay_out, p.at, p, product)
        elif p.active != 0:
            decay_out[p.at, p.row, p.d] = total

    return summarise_backward
