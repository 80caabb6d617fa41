"""The CUDA compositor's gradient kernel: back to front over the pairs of a tile (README §5).

It leaves a row of sums for each pair.
"""

import functools
from typing import NamedTuple, no_type_check

import warp as wp

from ...runtime.views import struct, struct_of
from ..skip import UNUSED, ZERO_UPSTREAM
from ..tiles import CHUNK, Bins, Pixels, RasterParams, Saved
from . import leaves as L
from .records import Gaussians
from .warp import (
    HEIGHT,
    PITCH,
    RECORD,
    STOP,
    SUB_TILES,
    WARP,
    WIDTH,
    LanePixels,
    any_of,
    ballot,
    first_block,
    kernel_options,
    pixels_of_lane,
    shared_memory,
    staging,
    sync,
    sync_block,
)

wp.set_module_options({"enable_backward": False})


@struct
class Rows:
    """Outputs of a gradient's launch: rows of pairs, and marks of skipped tiles.

    A row has for each chunk of channels the six moments, the two sums of absolute values if they
    are asked for, and the colours: the first eight of these numbers, a sector of memory, in
    ``heads``, the others in ``tails``. A row of a pair that is not ``written`` is undefined.
    """

    heads: wp.array2d[wp.float32]
    tails: wp.array2d[wp.float32]
    written: wp.array[wp.int32]  # a bit for each pair's row
    skipped: wp.array[wp.int32]


HEAD = 8  # numbers of a chunk in ``heads``


def row_sizes(channels: int, absolute: bool) -> tuple[int, int]:
    """Floats per row of ``heads`` and of ``tails``."""
    chunks = [min(CHUNK, channels - first) for first in range(0, channels, CHUNK)]
    return HEAD * len(chunks), sum(Sums(c, False, absolute).tail() for c in chunks)


class Sums(NamedTuple):
    """The sums that a kernel writes for each pair.

    Attributes:
        channels: of colours, at most 4; 0: only the moments, of any number of channels.
        geometry: moments of h (README eq. 11).
        absolute: rows have the two sums of absolute values (eq. 14) after the six moments.
        passes: the gradient passes the clamp of alpha (README §7).
    """

    channels: int
    geometry: bool
    absolute: bool
    passes: bool = False

    def moments(self) -> int:
        """Number of moments of a pair."""
        return (8 if self.absolute else 6) if self.geometry else 0

    def shared(self) -> int:
        """Floats of a warp's shared memory: records, their numbers, sums to be completed."""
        values = self.moments() + self.channels
        return WARP * RECORD + WARP + WARP // values * values * PITCH

    def color(self) -> int:
        """Column of the first colour in a row."""
        return 8 if self.absolute else 6

    def tail(self) -> int:
        """Number of columns behind the head."""
        return max(0, self.color() + self.channels - HEAD)

    def vectors(self) -> list[int]:
        """Numbers of the vectors of four columns that are written."""
        colors = range(self.color(), self.color() + self.channels)
        return sorted({column // 4 for column in (*range(self.moments()), *colors)})


@functools.cache
def _storing(asked: Sums):
    """The function that stores a vector of a chunk of a row."""
    pitch = Sums(CHUNK, False, asked.absolute).tail()

    @wp.func
    @no_type_check
    def store(rows: Rows, row: wp.int32, first: wp.int32, vector: wp.int32, sums: wp.vec4):
        if vector < wp.static(HEAD // 4):
            at = wp.int64(row) * wp.int64(rows.heads.shape[1])
            at += wp.int64(first) * wp.int64(HEAD // CHUNK) + wp.int64(vector) * wp.int64(4)
            L.store4(rows.heads, at, sums)
        else:
            at = wp.int64(row) * wp.int64(rows.tails.shape[1])
            for c in range(wp.static(asked.tail())):
                L.store(rows.tails, at, first / CHUNK * pitch + c, sums[c])

    return store


@functools.cache
def _completing(asked: Sums, parts: int):
    """Return how many pairs' sums are completed at once, and functions to store and complete them.

    Completed sums take the place of their pair's record.
    """
    moments = asked.moments()
    values = moments + asked.channels  # how many sums a pair has
    slots = WARP // values  # pairs whose sums are completed at once, with a lane for each sum
    numbers_at = WARP * RECORD
    sums_at = numbers_at + WARP
    memory = shared_memory(parts * asked.shared())
    arena_type = memory.arena
    values_type = wp.types.vector(values, wp.float32)

    @wp.func
    def leave(
        arena: arena_type,
        base: wp.int32,
        lane: wp.int32,
        slot: wp.int32,
        i: wp.int32,
        sums: values_type,
    ):
        # stores a lane's sums of a pair, to be completed together with other pairs' sums
        at = base + wp.static(sums_at) + slot * wp.static(values * PITCH) + lane
        for v in range(wp.static(values)):
            memory.put(arena, at + wp.static(v * PITCH), sums[v])
        memory.put_int(arena, base + wp.static(numbers_at) + slot, i)

    @wp.func
    def complete(arena: arena_type, base: wp.int32, lane: wp.int32, count: wp.int32):
        # each lane adds up one value of one of the stored pairs, over the 32 lanes
        if lane < count * wp.static(values):
            at = base + wp.static(sums_at) + lane * PITCH
            total = memory.get4(arena, at)
            for i in range(1, wp.static(WARP // 4)):
                total += memory.get4(arena, at + 4 * i)
            value = (total[0] + total[1]) + (total[2] + total[3])
            i = memory.get_int(arena, base + wp.static(numbers_at) + lane / wp.static(values))
            column = lane % wp.static(values)
            if column >= wp.static(moments):
                column += wp.static(asked.color() - moments)
            memory.put(arena, base + i * RECORD + column, value)

    return slots, leave, complete


@functools.cache
def _traversal(asked: Sums, parts: int):
    """The function that traverses a part of a tile."""
    (channels, geometry, absolute, passes), moments = asked, asked.moments()
    size = asked.shared()
    memory = shared_memory(parts * size)
    arena_type = memory.arena
    slots, leave, complete = _completing(asked, parts)
    together = sync if parts == 1 else sync_block
    vectors = asked.vectors()
    store = _storing(asked)
    every = channels == 0  # channels are read one by one, from the tensors
    absolute = absolute and geometry
    stage = staging(parts * size)
    pixels = SUB_TILES // parts  # how many a lane has
    part_blocks = (1 << 16 // parts) - 1
    part_stops = (1 << pixels) - 1
    pixels_type = wp.types.vector(pixels, wp.float32)
    values_type = wp.types.vector(moments + channels, wp.float32)
    upstream_type = wp.types.matrix((pixels, max(channels, 1)), wp.float32)

    @wp.func
    def of_part(bits: wp.int32, part: wp.int32, wanted: wp.int32) -> wp.int32:
        # the bits of a pair that belong to a part of the tile; for blocks only the wanted ones
        stops = bits >> (part * wp.static(pixels)) & wp.static(part_stops << STOP)
        return bits >> (part * wp.static(16 // parts)) & wanted | stops

    @wp.func
    @no_type_check
    def traverse(
        params: RasterParams,
        gaussians: Gaussians,
        lists: struct_of(Bins),
        transmittances: wp.array2d[wp.float32],  # in one struct, these four would spill registers
        stops: wp.array2d[wp.int32],
        blocks: wp.array[wp.int32],
        traversed_in: wp.array[wp.int32],
        v_pixels_in: Pixels,
        rows_out: Rows,
        arena: arena_type,
        p: LanePixels,
    ):
        base = p.part * wp.static(size)
        begin = lists.starts[p.tile]
        traversed = traversed_in[p.tile]
        # T is as forward left it, negative until the traversal reaches where the pixel stopped;
        # R is R of README eq. 10, plus the gradient of T_end, which is the same for all pairs
        T = pixels_type()
        R = pixels_type()
        upstream = upstream_type()
        first = p.pixel * wp.int64(gaussians.channels) + wp.int64(gaussians.first)
        # no Gaussian reached a pixel whose T is 1, unless fainter ones than float32 resolves count
        untouched = wp.where(params.alpha_min > 1e-6, 1.0, 0.0)
        some = wp.int32(0)  # bits of the blocks whose upstream gradient is not 0
        for j in range(wp.static(pixels)):
            if traversed > 0:
                T[j] = L.load(transmittances, p.walk_row, j * WARP)
            if T[j] != 0.0 and T[j] != untouched:
                step = j // 2 * HEIGHT * params.width + j % 2 * WIDTH
                largest = wp.float32(0.0)
                if gaussians.first == 0:
                    R[j] = L.load(v_pixels_in.transmittances, p.pixel, step)
                    largest += wp.abs(R[j])
                step *= gaussians.channels
                for c in range(wp.static(channels)):
                    upstream[j, c] = L.load(v_pixels_in.renders, first, step + c)
                    largest += wp.abs(upstream[j, c])
                if wp.static(every):
                    for c in range(gaussians.channels):
                        largest += wp.abs(L.load(v_pixels_in.renders, first, step + c))
                # NaN does not count as zero
                if not (largest <= 0.0):
                    some |= wp.static(3 << first_block(j))
        if (params.skip & ZERO_UPSTREAM) == 0:
            some = wp.static(part_blocks)
        wanted = any_of(some)
        of_all = wanted  # the whole tile's bits; each part has its own
        if wp.static(parts > 1):
            memory.put_int(arena, base, wanted << (p.part * wp.static(16 // parts)))
            together()
            of_all = 0
            for part in range(wp.static(parts)):
                of_all |= memory.get_int(arena, wp.static(part * size))
            together()
        if of_all == 0:
            traversed = 0
        if p.lane == 0:
            wp.atomic_max(rows_out.skipped, p.tile, wp.where(traversed > 0, 2, 1))

        end = begin + traversed
        while end > begin:
            k = end - WARP + p.lane
            bits = wp.int32(0)
            if k >= begin:
                bits = L.load_int(blocks, k)
                if (params.skip & UNUSED) == 0:
                    bits |= of_all
                bits = of_part(bits, p.part, wanted)
                if bits != 0:
                    g = L.load_int(lists.pairs, k)
                    at = wp.int64(g) * wp.int64(gaussians.records.shape[1])
                    shape = L.load4(gaussians.records, at)
                    level = L.load4(gaussians.records, at + wp.int64(4))
                    color = wp.vec4()
                    if wp.static(every):
                        color[0] = wp.cast(g, wp.float32)
                    else:
                        color = L.load4(gaussians.records, at + wp.int64(8 + gaussians.first))
                    stage(arena, base + p.lane * RECORD, shape, level, color, bits)
                elif wp.static(parts > 1):  # no sums, but some of another part's
                    for vector in range(3):
                        memory.put4(arena, base + p.lane * RECORD + 4 * vector, wp.vec4())
            waiting = wp.int32(0)
            todo = ballot(bits)
            sync()
            while todo != 0:
                i = L.highest_bit(todo)
                todo ^= 1 << i
                record = base + i * RECORD
                shape = memory.get4(arena, record)
                level = memory.get4(arena, record + 4)
                color = memory.get4(arena, record + 8)
                bits = wp.cast(level[2], wp.int32)
                sums = values_type()
                for j in range(wp.static(pixels)):
                    if (bits & wp.static(3 << first_block(j))) != 0:
                        dy = p.y[j // 2] - shape[1]
                        u = L.sheared(shape[3], p.x[j % 2] - shape[0], dy)
                        alpha = L.exp2(L.exponent(shape[2], level[0], level[1], u, dy))
                        clamped = wp.min(alpha, params.alpha_max)
                        if alpha >= params.alpha_min and T[j] > 0.0:
                            T[j] = T[j] * L.reciprocal(1.0 - clamped)
                            weight = T[j] * clamped
                            for c in range(wp.static(channels)):
                                sums[wp.static(moments) + c] += weight * upstream[j, c]
                            if wp.static(geometry):
                                diff = -R[j]
                                for c in range(wp.static(channels)):
                                    diff += color[c] * upstream[j, c]
                                if wp.static(every):
                                    step = j // 2 * HEIGHT * params.width + j % 2 * WIDTH
                                    step *= gaussians.channels
                                    g = wp.cast(color[0], wp.int32)
                                    source = wp.int64(g) * wp.int64(gaussians.records.shape[1])
                                    for c in range(gaussians.channels):
                                        v = L.load(v_pixels_in.renders, first, step + c)
                                        diff += L.load(gaussians.records, source, 8 + c) * v
                                R[j] = R[j] + clamped * diff
                                if wp.static(passes) or alpha < params.alpha_max:
                                    h = weight * diff
                                    if wp.static(passes):
                                        h = T[j] * alpha * diff
                                    hu = h * u
                                    hy = h * dy
                                    sums[0] += h
                                    sums[1] += hu
                                    sums[2] += hy
                                    sums[3] += hu * u
                                    sums[4] += hu * dy
                                    sums[5] += hy * dy
                                    if wp.static(absolute):
                                        sums[6] += wp.abs(hu)
                                        sums[7] += wp.abs(shape[2] * shape[3] * hu + level[0] * hy)
                leave(arena, base, p.lane, waiting, i, sums)
                waiting += 1
                if waiting == wp.static(slots):
                    sync()
                    complete(arena, base, p.lane, waiting)
                    sync()
                    waiting = 0
                if (bits >> STOP) != 0:
                    # pixels that stopped here contribute from the next pair on
                    k = end - WARP + i
                    at = wp.int64(L.opaque(p.index)) * wp.int64(wp.static(pixels * WARP))
                    at += wp.int64(p.lane)
                    for j in range(wp.static(pixels)):
                        if (bits & wp.static(1 << (STOP + j))) != 0:
                            if T[j] < 0.0:
                                if L.load_word(stops, at, j * WARP) == k:
                                    T[j] = -T[j]
            sync()
            complete(arena, base, p.lane, waiting)
            together()
            # each lane adds up a pair's sums over the parts, each part has some of the columns
            k = end - WARP + p.lane
            used = wp.int32(0)
            if k >= begin:
                used = of_all & L.load_int(blocks, k)
            if used != 0:
                row = L.load_int(lists.rows, k)
                record = p.lane * RECORD
                channel = L.opaque(gaussians.first)  # no registers hold what follows from it
                for n in range(wp.static(len(vectors))):
                    if p.part == wp.static(n % parts):
                        total = memory.get4(arena, record + wp.static(4 * vectors[n]))
                        for part in range(1, wp.static(parts)):
                            more = wp.static(part * size + 4 * vectors[n])
                            total += memory.get4(arena, record + more)
                        store(rows_out, row, channel, wp.static(vectors[n]), total)
                if p.part == 0:
                    wp.atomic_or(rows_out.written, row >> 5, 1 << (row & 31))
            if wp.static(parts > 1):
                together()
            end -= WARP

    return traverse


@functools.cache
def backward_kernel(asked: Sums, parts: int):
    """The kernel for these sums: a block for each tile, a warp for each of its 1, 2 or 4 parts."""
    size, lane_pixels = parts * asked.shared(), pixels_of_lane(parts)
    warps = (24 if parts == 4 else 20) if asked.channels < 4 else 16  # as registers allow
    options = kernel_options(warps, parts)
    traverse = _traversal(asked, parts)

    @wp.kernel(enable_backward=False, **options)
    @no_type_check
    def composite_vjp(
        params: RasterParams,
        gaussians_in: Gaussians,
        lists_in: struct_of(Bins),
        saved_in: struct_of(Saved),
        v_pixels_in: Pixels,
        rows_out: Rows,
    ):
        index, lane = wp.tid()
        arena = wp.tile_empty(shape=(wp.static(size),), dtype=float, storage="shared")
        p = lane_pixels(params, index, lane)
        traverse(
            params,
            gaussians_in,
            lists_in,
            saved_in.transmittances,
            saved_in.stops,
            saved_in.blocks,
            saved_in.traversed,
            v_pixels_in,
            rows_out,
            arena,
            p,
        )

    return composite_vjp
