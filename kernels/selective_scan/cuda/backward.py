"""The gradient kernel of the CUDA scan: a segment of the sequence backwards, chunk by chunk.

A chunk starts from the state that the forward saved. It is walked once to mark the state before
every few tokens, then in tiles, last first: values of a channel are turned into operands
in shared memory, the recurrence walks them a few tokens at a time, forwards again, holding decays
and states in registers, and backwards. Sums over states and over the block's channels go through
shared memory, so that dB and dC leave a block once per token and state.
"""

import functools
from typing import no_type_check

import warp as wp

from ...runtime.native import WARP_DTYPES
from ...runtime.scalars import sigmoid, softplus, softplus_slope
from ...runtime.views import struct
from ..problem import DISCRETIZATIONS, macros
from .blocks import (
    MARK,
    RUN,
    SUB,
    BlockShape,
    Position,
    Sizes,
    arena_io,
    halves,
    matrix_io,
    offsets,
    position_of,
    states_io,
    sync,
    widening,
)
from .groups import Groups, group_io, group_shared, row_io

MARK_TILE = 16  # tokens of a tile of the walk that marks
TILE = 8  # and of the walk back


@struct
class Tile:
    """The tokens of a tile of the walk back."""

    t0: int
    left: int  # tokens that are there
    mark: int  # of the chunk, that before the first token
    product: wp.int64  # where the block's products for dB and dC begin


@functools.cache
def backward_kernel(
    dtypes: tuple, mode: str, f: BlockShape, use_softplus: bool, use_z: bool, flags: frozenset
):
    """The kernel of one static shape.

    Args:
        dtypes: of u, delta, and of B and C.
        mode: the discretization.
        flags: of ``read`` (there are outputs) and of needed gradients: ``du``, ``ddelta``, ``dz``,
            ``dB``, ``dC``, ``y`` (for dz), ``through`` (anything that needs dh).
    """
    io, delta_io, matrix = dtypes
    scalar, delta_scalar, matrix_scalar = (WARP_DTYPES[x] for x in dtypes)
    read, through = "read" in flags, "through" in flags
    position = position_of(f)
    vec, read_states, write_states = states_io(f)
    pair, join, first_half, second_half = halves(f)
    g = Groups(f, TILE)
    m = Groups(f, MARK_TILE, g.adjacent)
    _, origin, fetch_mark, _ = group_io(m, io)
    _, origin_delta, fetch_mark_delta, _ = group_io(m, delta_io)
    raw, _, fetch, store = group_io(g, io)
    _, _, _, store_delta = group_io(g, delta_io)
    widen, widen_delta = widening(io), widening(delta_io)

    sums, products = f.lanes * g.lane_stride, g.tokens * (f.slots + 1) * f.width
    parts = {"STEP": g.size, "DU": g.size, "B": g.tokens * f.padded}
    parts |= {"DY": g.size, "C": g.tokens * f.padded} if read else {}
    parts |= {"Y": sums} if "y" in flags else {}
    parts |= {"S": sums, "P": sums} if through else {}
    parts |= {name: products for name, flag in (("DB", "dB"), ("DC", "dC")) if flag in flags}
    offset, size = offsets(parts)
    mark_offset, mark_size = offsets({"STEP": m.size, "DU": m.size, "B": MARK_TILE * f.padded})
    size = max(size, 2 * mark_size)
    offset = dict.fromkeys(("DY", "C", "Y", "S", "P", "DB", "DC"), 0) | offset
    arena_type, _, _ = arena_io(size)
    marked, put_mark, _, _ = group_shared(m, size)
    elements, put, get, sum_lanes = group_shared(g, size)
    _, _, put_mark_matrix = matrix_io(f, matrix, MARK_TILE, size)
    _, _, put_matrix = matrix_io(f, matrix, TILE, size)
    origin_matrix, fetch_matrix = row_io(f, matrix, TILE)
    _, fetch_mark_matrix = row_io(f, matrix, MARK_TILE)
    scale = DISCRETIZATIONS[mode].scale
    # besides its marks a thread keeps δ and the slope of softplus for its own tokens of the chunk
    at_steps = MARK // SUB * f.walks * f.held
    at_slopes = at_steps + MARK // f.rows
    own_size = at_slopes + MARK // f.rows + 4
    # without outputs 168 registers suffice; the compiler's own choice is more, or fewer with spills
    resident = 1 if read or f.walks > 1 else max(1, 3 * 128 // f.block)
    bounds = (f.block, resident) if resident > 1 else f.block

    # sums for dB and dC that a thread takes at a time
    wanted = ("dB" in flags) + ("dC" in flags)
    every = wanted * g.tokens * f.width
    taken = max([v for v in (1, 2, 4) if f.width % v == 0 and every // v >= f.block] or [1])
    constants = {"MARK": MARK, "SUB": SUB, "TAKEN": taken, "READ": read, "THROUGH": through}
    constants |= {"NEED_DB": "dB" in flags, "NEED_DC": "dC" in flags, "NEED_Y": "y" in flags}
    constants |= macros(mode)
    back = constants | {f"AT_{name}": start for name, start in offset.items()}
    marking = constants | {f"AT_{name}": start for name, start in mark_offset.items()}

    # Where a thread's own memory begins, aligned for vectors; one number for the reason of ORIGIN.
    @wp.func_native(
        "unsigned long long r;"
        'asm("add.s64 %0, %1, 0;" : "=l"(r) : "l"(((size_t)own.data + 15) & ~(size_t)15));'
        "return r;"
    )
    def place(own: wp.array(dtype=float)) -> wp.uint64: ...

    @wp.func_native(m.text("io.inl", KEEP=True))
    def keep(own: wp.uint64, at: int, x: marked): ...

    @wp.func_native(g.text("io.inl", KEPT=True))
    def kept(own: wp.uint64, at: int) -> elements: ...

    @wp.func_native(m.text("mark.inl", **marking))
    def mark(
        arena: arena_type,
        base: int,
        marks_at: wp.uint64,
        tile: int,
        walked: int,
        p: Position,
        a: vec,
        h: vec,
    ) -> vec: ...

    @wp.func_native(g.text("reverse.inl", **back))
    def reverse(
        arena: arena_type,
        marks_at: wp.uint64,
        tile: Tile,
        p: Position,
        a: vec,
        both: pair,
        db_out: wp.array3d(dtype=float),
        dc_out: wp.array3d(dtype=float),
    ) -> pair: ...

    # The sums for dB and dC where ``reverse`` does not make them state block by block: separate, so
    # that the next tile's loads, which would cost ``reverse`` registers, can run meanwhile.
    @wp.func_native(g.text("total.h", **back) + ("total_(0);" if wanted and f.walks == 1 else ""))
    def total(
        arena: arena_type,
        tile: Tile,
        p: Position,
        db_out: wp.array3d(dtype=float),
        dc_out: wp.array3d(dtype=float),
    ): ...

    @wp.func
    @no_type_check
    def prepare(
        p: Position, arena: arena_type, left: int,
        u_raw: raw, steps: elements, dout_raw: raw, z_raw: raw,
    ):  # fmt: skip
        # values of a channel: operands of the walk; the gradients after it are returned
        inputs = elements()
        u = elements()
        for i in range(wp.static(g.count)):
            steps[i] = wp.where(wp.static(g.token(i)) < left, steps[i], 0.0)
            u[i] = widen(u_raw[i])
            inputs[i] = steps[i] * u[i]
        put(arena, wp.static(offset["STEP"]), p, steps)
        put(arena, wp.static(offset["DU"]), p, inputs)
        gates = elements()
        if wp.static(read):
            dys = elements()
            for i in range(wp.static(g.count)):
                dys[i] = wp.where(wp.static(g.token(i)) < left, widen(dout_raw[i]), 0.0)
                if wp.static(use_z):
                    z = widen(z_raw[i])
                    s = sigmoid(z)
                    gates[i] = dys[i] * s
                    dys[i] = gates[i] * z
                    gates[i] += dys[i] * (1.0 - s)
            put(arena, wp.static(offset["DY"]), p, dys)
        return u, gates

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=bounds, grid_stride=False)
    @no_type_check
    def scan_backward(
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
        p = position(sizes, packed_in, index, lane)
        arena = wp.tile_empty(shape=(wp.static(size),), dtype=float, storage="shared")
        own = place(wp.zeros(shape=(wp.static(own_size),), dtype=float))
        a = read_states(a_in, 0, p) * wp.static(scale)
        state = join(read_states(last_in, p.segment_row, p), vec())
        bias = bias_in[p.d]
        skip = skip_in[p.d]
        sums = wp.vec2()
        row = (p.b * sizes.groups + p.group) * sizes.parts + p.part
        product = wp.int64(row) * wp.int64(sizes.length) * wp.int64(sizes.states)
        chunks = (p.end - p.begin + wp.static(MARK - 1)) / wp.static(MARK)
        u_at = origin(u_in, p.b, p.d)
        delta_at = origin_delta(delta_in, p.b, p.d)
        z_at = origin(z_in, p.b, p.d)
        dout_at = origin(dout_in, p.b, p.d)
        du_at = origin(du_out, p.b, p.d)
        ddelta_at = origin_delta(ddelta_out, p.b, p.d)
        dz_at = origin(dz_out, p.b, p.d)
        b_at = origin_matrix(b_in, p.b, p.group)
        c_at = origin_matrix(c_in, p.b, p.group)
        for back in range(chunks):
            chunk = p.begin + (chunks - 1 - back) * wp.static(MARK)
            end = wp.min(chunk + wp.static(MARK), p.end)
            h = read_states(starts_in, p.mark + (chunk - p.begin) / wp.static(MARK), p)
            # the walk that marks
            t = chunk + p.row * wp.static(m.adjacent)
            u_mark = fetch_mark(u_in, u_at, t, end - 1)
            delta_mark = fetch_mark_delta(delta_in, delta_at, t, end - 1)
            b_mark = fetch_mark_matrix(b_in, b_at, p, chunk, end - 1)
            # only whole groups of tokens that a mark follows: none is masked
            walked = (end - chunk - 1) / wp.static(SUB)
            for again in range((end - chunk + wp.static(MARK_TILE - 1)) / wp.static(MARK_TILE)):
                base = (again % 2) * wp.static(mark_size)
                own_steps = marked()
                inputs = marked()
                own_slopes = marked()
                for i in range(wp.static(m.count)):
                    x = widen_delta(delta_mark[i]) + bias
                    own_steps[i] = x
                    if wp.static(use_softplus):
                        own_steps[i] = softplus(x)
                        own_slopes[i] = softplus_slope(x)
                    inputs[i] = own_steps[i] * widen(u_mark[i])
                put_mark(arena, base + wp.static(mark_offset["STEP"]), p, own_steps)
                put_mark(arena, base + wp.static(mark_offset["DU"]), p, inputs)
                first = again * wp.static(m.count)
                keep(own, wp.static(at_steps) + first, own_steps)
                if wp.static(use_softplus):
                    keep(own, wp.static(at_slopes) + first, own_slopes)
                put_mark_matrix(arena, base + wp.static(mark_offset["B"]), p, b_mark)
                sync()
                t += wp.static(MARK_TILE)
                u_mark = fetch_mark(u_in, u_at, t, end - 1)
                delta_mark = fetch_mark_delta(delta_in, delta_at, t, end - 1)
                b_mark = fetch_mark_matrix(
                    b_in, b_at, p, t - p.row * wp.static(m.adjacent), end - 1
                )
                h = mark(arena, base, own, again, walked, p, a, h)
            sync()
            # the walk back
            tile = Tile()
            tile.product = product
            tiles = (end - chunk + wp.static(TILE - 1)) / wp.static(TILE)
            t0 = chunk + (tiles - 1) * wp.static(TILE)
            t = t0 + p.row * wp.static(g.adjacent)
            u_raw = fetch(u_in, u_at, t, end - 1)
            first = (tiles - 1) * wp.static(g.count)
            steps = kept(own, wp.static(at_steps) + first)
            z_raw = raw()
            dout_raw = raw()
            b_raw = fetch_matrix(b_in, b_at, p, t0, end - 1)
            c_raw = b_raw
            if wp.static(read):
                dout_raw = fetch(dout_in, dout_at, t, end - 1)
                c_raw = fetch_matrix(c_in, c_at, p, t0, end - 1)
                if wp.static(use_z):
                    z_raw = fetch(z_in, z_at, t, end - 1)
            for again in range(tiles):
                t0 = chunk + (tiles - 1 - again) * wp.static(TILE)
                t = t0 + p.row * wp.static(g.adjacent)
                left = wp.where(p.active != 0, end - t, 0)
                u, gates = prepare(p, arena, left, u_raw, steps, dout_raw, z_raw)
                if wp.static(read):
                    put_matrix(arena, wp.static(offset["C"]), p, c_raw)
                put_matrix(arena, wp.static(offset["B"]), p, b_raw)
                sync()
                tile.t0 = t0
                tile.left = end - t0
                tile.mark = (t0 - chunk) / wp.static(SUB)
                state = reverse(arena, own, tile, p, a, state, db_out, dc_out)
                # their loads are in flight while the sums are completed
                before = wp.max(t0 - wp.static(TILE), chunk)
                ahead = before + p.row * wp.static(g.adjacent)
                u_raw = fetch(u_in, u_at, ahead, end - 1)
                slopes = kept(own, wp.static(at_slopes) + first)
                first = wp.max(first - wp.static(g.count), 0)
                steps = kept(own, wp.static(at_steps) + first)
                b_raw = fetch_matrix(b_in, b_at, p, before, end - 1)
                if wp.static(read):
                    dout_raw = fetch(dout_in, dout_at, ahead, end - 1)
                    c_raw = fetch_matrix(c_in, c_at, p, before, end - 1)
                    if wp.static(use_z):
                        z_raw = fetch(z_in, z_at, ahead, end - 1)
                total(arena, tile, p, db_out, dc_out)
                # equations 9 and 11; the terms of dD and ddelta_bias
                dskip = wp.float32(0.0)
                dbias = wp.float32(0.0)
                dys = elements()
                if wp.static(read):
                    dys = get(arena, wp.static(offset["DY"]), p)
                if wp.static("y" in flags):
                    y = sum_lanes(arena, wp.static(offset["Y"]), p)
                    for i in range(wp.static(g.count)):
                        inside = wp.static(g.token(i)) < left
                        dz = gates[i] * (y[i] + skip * u[i])
                        store(dz_out, dz_at, t + wp.static(g.token(i)), inside, dz)
                if wp.static(through):
                    s = sum_lanes(arena, wp.static(offset["S"]), p)
                    d = sum_lanes(arena, wp.static(offset["P"]), p)
                    step = get(arena, wp.static(offset["STEP"]), p)
                    for i in range(wp.static(g.count)):
                        inside = wp.static(g.token(i)) < left
                        ddelta = d[i] * wp.static(1.0 / scale) + u[i] * s[i]
                        if wp.static(use_softplus):
                            ddelta = ddelta * slopes[i]
                        dbias += wp.where(inside, ddelta, 0.0)
                        own_t = t + wp.static(g.token(i))
                        if wp.static("du" in flags):
                            du = step[i] * s[i] + skip * dys[i]
                            store(du_out, du_at, own_t, inside, du)
                        if wp.static("ddelta" in flags):
                            store_delta(ddelta_out, ddelta_at, own_t, inside, ddelta)
                for i in range(wp.static(g.count)):
                    dskip += dys[i] * u[i]
                sums += wp.vec2(dskip, dbias)
            sync()
            # the chunk's sums are added to its run's, which begin at 0 in memory
            run = p.run + back / RUN
            write_states(da_out, run, p, second_half(state) + read_states(da_out, run, p))
            state = join(first_half(state), vec())
            if p.active != 0:
                sums += wp.vec2(dskip_out[run, p.row, p.d], dbias_out[run, p.row, p.d])
                dskip_out[run, p.row, p.d] = sums[0]
                dbias_out[run, p.row, p.d] = sums[1]
            sums = wp.vec2()
        if p.segment == 0:
            write_states(first_out, p.sequence, p, first_half(state))

    return scan_backward
