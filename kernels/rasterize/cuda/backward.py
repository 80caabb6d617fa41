"""The CUDA compositor's gradient kernels: back to front over the pairs of a tile (README §5).

``composite_vjp`` leaves a row of sums for each pair. ``composite_vjp_unlisted`` does nothing unless
the lists had no room for all pairs; then a warp walks all tiles of its view, one after the other,
and adds their sums in rows of Gaussians: in the order in which ``reduce.py`` adds up rows of pairs.
"""

import functools
from typing import no_type_check

import warp as wp

from ..skip import UNUSED, ZERO_UPSTREAM
from ..tiles import Picture
from .complete import completing, shared_size
from .leaves import (
    exp2,
    exponent,
    load,
    load1,
    load2,
    load3,
    load_int,
    load_stop,
    lowest_bit,
    reciprocal,
    sheared,
)
from .warp import (
    HEIGHT,
    RECORD,
    STOP,
    SUB_TILES,
    WARP,
    WIDTH,
    Gaussians,
    Place,
    first_block,
    kernel_options,
    placing,
    shared_memory,
    staging,
    touching,
)

_BLOCKS = (1 << STOP) - 1
_ZERO_UPSTREAM = wp.constant(ZERO_UPSTREAM)
_UNUSED = wp.constant(UNUSED)


def _warps(channels: int) -> int:
    """How many of a multiprocessor there are registers for."""
    return 20 if channels < 4 else 16


@functools.cache
def _walking(channels: int, geometry: bool, parts: int, listed: bool):
    """The function that walks a part of a tile, whose pairs are numbered from ``begin`` on.

    Unless ``listed``, the tiles of a view share one list, as in ``forward.py``, and the bits of
    its pairs; what a tile's own test rules out is taken away from these.
    """
    moments = 6 if geometry else 0
    values = moments + channels
    size = shared_size(channels, geometry)
    memory = shared_memory(size)
    arena_type = memory.arena
    slots, leave, complete = completing(channels, geometry, listed)
    place, touched, stage = placing(parts), touching(parts), staging(channels, size)
    pixels = SUB_TILES // parts  # how many a lane has
    part_blocks = (1 << 16 // parts) - 1
    part_stops = (1 << pixels) - 1
    pixels_type = wp.types.vector(pixels, wp.float32)
    values_type = wp.types.vector(values, wp.float32)
    upstream_type = wp.types.matrix((pixels, channels), wp.float32)

    @wp.func
    def of_part(bits: wp.int32, part: wp.int32, wanted: wp.int32) -> wp.int32:
        # the bits of a pair that belong to a part of the tile; for blocks only the wanted ones
        stops = bits >> (STOP + part * wp.static(pixels)) & wp.static(part_stops)
        blocks = bits >> (part * wp.static(16 // parts)) & wp.static(part_blocks)
        return blocks & wanted | stops << STOP

    @wp.func
    def row_of(rows: wp.array[wp.int32], k: wp.int32) -> wp.int32:
        row = k
        if wp.static(listed):
            row = load_int(rows, k)
        return row

    @wp.func
    def of_tile(
        picture: Picture,
        gaussians: Gaussians,
        corner: wp.vec2,
        pairs: wp.array[wp.int32],
        offsets: wp.array[wp.int32],
        k: wp.int32,
        bits: wp.int32,
    ):
        # of a pair's bits, which are those of all tiles together, what this tile's test leaves
        left = wp.int32(0)
        if load_int(offsets, k) != load_int(offsets, k + 1):
            g = load_int(pairs, k)
            mask = touched(
                corner,
                load2(gaussians.means2d, g),
                load3(gaussians.conics, g),
                load1(gaussians.opacities, g),
                picture.alpha_min,
            )
            for j in range(wp.static(pixels)):
                if (mask & wp.static(1 << j)) != 0:
                    left |= bits & wp.static(3 << first_block(j) | 1 << (STOP + j))
        return left

    @wp.func
    @no_type_check
    def start(
        picture: Picture,
        gaussians: Gaussians,
        p: Place,
        walked: wp.int32,
        transmittances: wp.array2d[wp.float32],
        v_renders: wp.array2d[wp.float32],
        v_alphas: wp.array2d[wp.float32],
    ):
        # the lane's pixels before the walk, and bits of the blocks whose upstream gradient is not 0
        T = pixels_type()
        R = pixels_type()
        upstream = upstream_type()
        first = p.pixel * wp.int64(gaussians.channels) + wp.int64(gaussians.first)
        some = wp.int32(0)
        for j in range(wp.static(pixels)):
            if walked > 0:
                T[j] = load(transmittances, p.place, j * WARP)
            if T[j] != 0.0:
                step = j // 2 * HEIGHT * picture.width + j % 2 * WIDTH
                largest = wp.float32(0.0)
                if gaussians.first == 0:
                    R[j] = -load(v_alphas, p.pixel, step)
                    largest += wp.abs(R[j])
                step *= gaussians.channels
                for c in range(wp.static(channels)):
                    upstream[j, c] = load(v_renders, first, step + c)
                    largest += wp.abs(upstream[j, c])
                # NaN is not taken for zero
                if not (largest <= 0.0):
                    some |= wp.static(3 << first_block(j))
        return T, R, upstream, some

    @wp.func
    @no_type_check
    def walk(
        picture: Picture,
        gaussians: Gaussians,
        arena: arena_type,
        index: wp.int32,
        lane: wp.int32,
        begin: wp.int32,
        pairs_in: wp.array[wp.int32],
        rows_in: wp.array[wp.int32],
        transmittances_in: wp.array2d[wp.float32],
        stops_in: wp.array2d[wp.int32],
        blocks_in: wp.array[wp.int32],
        walked_in: wp.array[wp.int32],
        v_renders_in: wp.array2d[wp.float32],
        v_alphas_in: wp.array2d[wp.float32],
        v_pairs_out: wp.array2d[wp.float32],
        skipped_out: wp.array[wp.int32],
    ):
        p = place(picture, index, lane)
        walked = walked_in[p.tile] * wp.static(1 if listed else -1)
        # T is as forward left it, negative until the walk comes to where the pixel stopped; R is
        # that of README eq. 10, less the gradient of alpha, which is the same for all pairs
        T, R, upstream, some = start(
            picture, gaussians, p, walked, transmittances_in, v_renders_in, v_alphas_in
        )
        if (picture.skip & _ZERO_UPSTREAM) == 0:
            some = wp.static(part_blocks)
        wanted = memory.any_of(arena, lane, some)
        if wanted == 0:
            walked = 0
        if walked > 0 and lane == 0:
            skipped_out[p.tile] = 0

        waiting = wp.int32(0)
        for done in range(0, walked, WARP):
            k = begin + walked - 1 - done - lane
            bits = wp.int32(0)
            if k >= begin:
                bits = of_part(load_int(blocks_in, k), p.part, wanted)
                if (picture.skip & _UNUSED) == 0:
                    bits |= wanted
                if wp.static(not listed):
                    bits = of_tile(picture, gaussians, p.corner, pairs_in, rows_in, k, bits)
                if bits != 0:
                    row = row_of(rows_in, k) * wp.static(parts) + p.part
                    stage(arena, picture, gaussians, lane, load_int(pairs_in, k), bits, row)
            todo = memory.ballot(arena, lane, bits)
            memory.sync()
            while todo != 0:
                i = lowest_bit(todo)
                todo &= todo - 1
                shape = memory.get4(arena, i * RECORD)
                level = memory.get4(arena, i * RECORD + 4)
                color = memory.get4(arena, i * RECORD + 8)
                bits = memory.get_int(arena, i * RECORD + 6)
                sums = values_type()
                for j in range(wp.static(pixels)):
                    if (bits & wp.static(3 << first_block(j))) != 0:
                        dy = p.y[j // 2] - shape[1]
                        u = sheared(shape[3], p.x[j % 2] - shape[0], dy)
                        alpha = exp2(exponent(shape[2], level[0], level[1], u, dy))
                        clamped = wp.min(alpha, picture.alpha_max)
                        if alpha >= picture.alpha_min and T[j] > 0.0:
                            T[j] = T[j] * reciprocal(1.0 - clamped)
                            weight = T[j] * clamped
                            for c in range(wp.static(channels)):
                                sums[wp.static(moments) + c] += weight * upstream[j, c]
                            if wp.static(geometry):
                                diff = -R[j]
                                for c in range(wp.static(channels)):
                                    diff += color[c] * upstream[j, c]
                                R[j] = R[j] + clamped * diff
                                if alpha < picture.alpha_max:
                                    h = weight * diff
                                    hu = h * u
                                    hy = h * dy
                                    sums[0] += h
                                    sums[1] += hu
                                    sums[2] += hy
                                    sums[3] += hu * u
                                    sums[4] += hu * dy
                                    sums[5] += hy * dy
                if (bits & wp.static(_BLOCKS)) != 0:
                    leave(arena, lane, waiting, memory.get_int(arena, i * RECORD + 7), sums)
                    waiting += 1
                    if waiting == wp.static(slots):
                        memory.sync()
                        complete(arena, gaussians, lane, waiting, v_pairs_out)
                        memory.sync()
                        waiting = 0
                if (bits >> STOP) != 0:
                    # what stopped here takes part from the next pair on
                    k = begin + walked - 1 - done - i
                    for j in range(wp.static(pixels)):
                        if (bits & wp.static(1 << (STOP + j))) != 0:
                            if T[j] < 0.0:
                                if load_stop(stops_in, p.place, j * WARP) == k:
                                    T[j] = -T[j]
            memory.sync()
        memory.sync()
        complete(arena, gaussians, lane, waiting, v_pairs_out)

    return walk


@functools.cache
def backward_kernel(channels: int, geometry: bool, parts: int):
    """The kernel for so many channels, at most 4, and parts of a tile: 1, 2 or 4.

    Without ``geometry`` it is for colours alone. Each part has a row of its own for a pair.
    """
    size, walk = shared_size(channels, geometry), _walking(channels, geometry, parts, True)

    @wp.kernel(**kernel_options(_warps(channels)))
    @no_type_check
    def composite_vjp(
        picture: Picture,
        gaussians: Gaussians,
        pairs_in: wp.array[wp.int32],
        rows_in: wp.array[wp.int32],
        starts_in: wp.array[wp.int32],
        transmittances_in: wp.array2d[wp.float32],
        stops_in: wp.array2d[wp.int32],
        blocks_in: wp.array[wp.int32],
        walked_in: wp.array[wp.int32],
        v_renders_in: wp.array2d[wp.float32],
        v_alphas_in: wp.array2d[wp.float32],
        v_pairs_out: wp.array2d[wp.float32],
        skipped_out: wp.array[wp.int32],
    ):
        index, lane = wp.tid()
        arena = wp.tile_empty(shape=(wp.static(WARP + size),), dtype=float, storage="shared")
        walk(
            picture,
            gaussians,
            arena,
            index,
            lane,
            starts_in[index // wp.static(parts)],
            pairs_in,
            rows_in,
            transmittances_in,
            stops_in,
            blocks_in,
            walked_in,
            v_renders_in,
            v_alphas_in,
            v_pairs_out,
            skipped_out,
        )

    return composite_vjp


@functools.cache
def unlisted_kernel(channels: int, geometry: bool, parts: int):
    """The kernel that makes the sums where ``count_in`` pairs have no room in ``blocks_in``.

    A warp has a part of each tile of a view. A row is of a Gaussian's number in ``order_in``.
    """
    size, walk = shared_size(channels, geometry), _walking(channels, geometry, parts, False)

    @wp.kernel(**kernel_options(_warps(channels)))
    @no_type_check
    def composite_vjp_unlisted(
        picture: Picture,
        gaussians: Gaussians,
        order_in: wp.array[wp.int32],
        offsets_in: wp.array[wp.int32],
        count_in: wp.array[wp.int64],
        transmittances_in: wp.array2d[wp.float32],
        stops_in: wp.array2d[wp.int32],
        blocks_in: wp.array[wp.int32],
        walked_in: wp.array[wp.int32],
        v_renders_in: wp.array2d[wp.float32],
        v_alphas_in: wp.array2d[wp.float32],
        v_pairs_out: wp.array2d[wp.float32],
        skipped_out: wp.array[wp.int32],
    ):
        worker, lane = wp.tid()
        arena = wp.tile_empty(shape=(wp.static(WARP + size),), dtype=float, storage="shared")
        image = worker // wp.static(parts)
        tiles = picture.tiles_x * picture.tiles_y
        if count_in[0] <= wp.int64(blocks_in.shape[0]):
            tiles = 0
        for tile in range(tiles):
            tile += image * picture.tiles_x * picture.tiles_y
            walk(
                picture,
                gaussians,
                arena,
                tile * wp.static(parts) + worker % wp.static(parts),
                lane,
                image * picture.num,
                order_in,
                offsets_in,
                transmittances_in,
                stops_in,
                blocks_in,
                walked_in,
                v_renders_in,
                v_alphas_in,
                v_pairs_out,
                skipped_out,
            )

    return composite_vjp_unlisted
