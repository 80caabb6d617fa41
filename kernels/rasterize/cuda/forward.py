"""The CUDA compositor's forward kernels: front to back over the pairs of a tile (README §3).

``composite`` walks the lists of the tiles. ``composite_unlisted`` does nothing unless these had no
room for all pairs; then it walks all Gaussians of the view for each tile, in the same order.
"""

import functools
from typing import no_type_check

import warp as wp

from ..skip import BLOCK_TEST, STOPPED
from ..tiles import Picture
from .leaves import (
    anew,
    count_bits,
    exp2,
    exponent,
    load1,
    load2,
    load3,
    load_int,
    lowest_bit,
    sheared,
    store,
    store_int,
    store_stop,
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
    word,
)

_SIZE = WARP * RECORD
_BLOCK_TEST = wp.constant(BLOCK_TEST)
_STOPPED = wp.constant(STOPPED)


def _warps(channels: int) -> int:
    """How many of a multiprocessor there are registers for."""
    return 24 if channels < 4 else 20


@functools.cache
def _walking(channels: int, parts: int, listed: bool):
    """The function that walks the pairs numbered ``begin`` to ``end`` for a tile's part.

    Unless ``listed``, the tiles of a view share one list of all its Gaussians, in which ``offsets``
    says where the pairs of each would begin, if there were room. Bits of tiles are then joined, and
    numbers of walked pairs are stored with a minus, so that the gradient knows them.
    """
    memory = shared_memory(_SIZE)
    arena_type = memory.arena
    place, touched, stage = placing(parts), touching(parts), staging(channels, _SIZE)
    pixels = SUB_TILES // parts  # how many a lane has
    pixels_type = wp.types.vector(pixels, wp.float32)
    sums_type = wp.types.matrix((pixels, channels), wp.float32)

    @wp.func
    @no_type_check
    def start(picture: Picture, p: Place):
        # the transmittances of the lane's pixels, and bits of those that lie in the picture
        T = pixels_type()
        inside = wp.int32(0)
        for j in range(wp.static(pixels)):
            if p.px + j % 2 * WIDTH < picture.width and p.py + j // 2 * HEIGHT < picture.height:
                T[j] = 1.0
                inside |= 1 << j
        return T, inside

    @wp.func
    @no_type_check
    def leave(blocks: wp.array[wp.int32], k: wp.int32, part: wp.int32, mine: wp.int32):
        # stores the bits of a pair, or joins those of the parts, or of the tiles that share it
        if wp.static(parts == 1 and listed):
            store_int(blocks, k, mine)
        elif mine != 0:
            shift_used = part * wp.static(16 // parts)
            shift_stop = part * wp.static(pixels)
            shifted = (mine & wp.static((1 << STOP) - 1)) << shift_used
            shifted |= (mine & wp.static(~((1 << STOP) - 1))) << shift_stop
            wp.atomic_or(blocks, k, shifted)

    @wp.func
    @no_type_check
    def put(
        picture: Picture,
        gaussians: Gaussians,
        p: Place,
        T: pixels_type,
        sums: sums_type,
        transmittances: wp.array2d[wp.float32],
        renders: wp.array2d[wp.float32],
        alphas: wp.array2d[wp.float32],
    ):
        # stores the lane's pixels
        first = p.pixel * wp.int64(gaussians.channels) + wp.int64(gaussians.first)
        for j in range(wp.static(pixels)):
            store(transmittances, p.place, j * WARP, T[j])
            if T[j] != 0.0:
                step = j // 2 * HEIGHT * picture.width + j % 2 * WIDTH
                store(alphas, p.pixel, step, 1.0 - wp.abs(T[j]))
                step *= gaussians.channels
                for c in range(wp.static(channels)):
                    store(renders, first, step + c, sums[j, c])

    @wp.func
    @no_type_check
    def walk(
        picture: Picture,
        gaussians: Gaussians,
        arena: arena_type,
        index: wp.int32,
        lane: wp.int32,
        begin: wp.int32,
        end: wp.int32,
        pairs_in: wp.array[wp.int32],
        offsets_in: wp.array[wp.int32],
        transmittances_out: wp.array2d[wp.float32],
        stops_out: wp.array2d[wp.int32],
        blocks_out: wp.array[wp.int32],
        walked_out: wp.array[wp.int32],
        blocks_walked_out: wp.array[wp.int64],
        renders_out: wp.array2d[wp.float32],
        alphas_out: wp.array2d[wp.float32],
    ):
        p = place(picture, index, lane)
        half = lane // 4 % 2  # which of a sub-tile's two blocks of 4 x 4 pixels
        # T is positive where a pixel goes on, negative where it stopped, 0 outside of the picture
        T, inside = start(picture, p)
        sums = sums_type()
        live = memory.any_of(arena, lane, inside)

        walked = end - begin
        evaluated = wp.int32(0)
        for k0 in range(begin, end, WARP):
            if live == 0:
                break
            # each lane looks at one of the next 32 Gaussians
            k = k0 + lane
            mask = wp.int32(0)
            seen = k < end
            if wp.static(not listed):
                if seen:
                    seen = load_int(offsets_in, k) != load_int(offsets_in, k + 1)
            if seen:
                g = load_int(pairs_in, k)
                mask = live & touched(
                    p.corner,
                    load2(gaussians.means2d, g),
                    load3(gaussians.conics, g),
                    load1(gaussians.opacities, g),
                    picture.alpha_min,
                )
                if (picture.skip & _BLOCK_TEST) == 0:
                    mask = live
                stage(arena, picture, gaussians, lane, g, mask, 0)
            todo = memory.ballot(arena, lane, mask)
            memory.sync()
            mine = wp.int32(0)
            while todo != 0 and live != 0:
                i = lowest_bit(todo)
                todo &= todo - 1
                shape = memory.get4(arena, i * RECORD)
                level = memory.get4(arena, i * RECORD + 4)
                color = memory.get4(arena, i * RECORD + 8)
                mask = live & memory.get_int(arena, i * RECORD + 6)
                evaluated += count_bits(mask)
                used = word()
                stopped = word()
                for j in range(wp.static(pixels)):
                    if (mask & wp.static(1 << j)) != 0:
                        dy = p.y[j // 2] - shape[1]
                        u = sheared(shape[3], p.x[j % 2] - shape[0], dy)
                        alpha = exp2(exponent(shape[2], level[0], level[1], u, dy))
                        weight = T[j] * wp.min(alpha, picture.alpha_max)
                        after = T[j] - weight
                        if alpha >= picture.alpha_min and T[j] > 0.0:
                            if after > picture.t_min:
                                used[0] += wp.static(1 << first_block(j))
                                T[j] = after
                                for c in range(wp.static(channels)):
                                    sums[j, c] += weight * color[c]
                            else:
                                stopped[0] += wp.static(1 << (STOP + j))
                bits = memory.any_of(arena, lane, (used[0] << half) | stopped[0])
                if lane == i:
                    mine = bits
                if (bits >> STOP) != 0:
                    for j in range(wp.static(pixels)):
                        if (bits & wp.static(1 << (STOP + j))) != 0:
                            if (stopped[0] & wp.static(1 << (STOP + j))) != 0:
                                T[j] = -T[j]
                                store_stop(stops_out, p.place, j * WARP, k0 + i)
                            going = wp.int32(0)
                            if T[j] > 0.0:
                                going = 1
                            over = memory.ballot(arena, lane, going) == 0
                            if over and (picture.skip & _STOPPED) != 0:
                                live &= wp.static(~(1 << j))
                    if live == 0:
                        walked = k0 + i - begin + 1
            if k < end:
                leave(blocks_out, k, p.part, mine)
            memory.sync()

        if lane == 0:
            if wp.static(listed):
                wp.atomic_max(walked_out, p.tile, walked)
            else:
                wp.atomic_min(walked_out, p.tile, -walked)
        if lane == 0 and gaussians.first == 0:
            wp.atomic_add(blocks_walked_out, p.tile, wp.int64(evaluated))
        p = place(picture, anew(index), lane)
        put(picture, gaussians, p, T, sums, transmittances_out, renders_out, alphas_out)

    return walk


@functools.cache
def forward_kernel(channels: int, parts: int):
    """The kernel for so many channels, at most 4, and parts of a tile: 1, 2 or 4."""
    walk = _walking(channels, parts, True)

    @wp.kernel(**kernel_options(_warps(channels)))
    @no_type_check
    def composite(
        picture: Picture,
        gaussians: Gaussians,
        pairs_in: wp.array[wp.int32],
        starts_in: wp.array[wp.int32],
        transmittances_out: wp.array2d[wp.float32],
        stops_out: wp.array2d[wp.int32],
        blocks_out: wp.array[wp.int32],
        walked_out: wp.array[wp.int32],
        blocks_walked_out: wp.array[wp.int64],
        renders_out: wp.array2d[wp.float32],
        alphas_out: wp.array2d[wp.float32],
    ):
        index, lane = wp.tid()
        arena = wp.tile_empty(shape=(wp.static(WARP + _SIZE),), dtype=float, storage="shared")
        tile = index // wp.static(parts)
        walk(
            picture,
            gaussians,
            arena,
            index,
            lane,
            starts_in[tile],
            starts_in[tile + 1],
            pairs_in,
            starts_in,
            transmittances_out,
            stops_out,
            blocks_out,
            walked_out,
            blocks_walked_out,
            renders_out,
            alphas_out,
        )

    return composite


@functools.cache
def unlisted_kernel(channels: int, parts: int):
    """The kernel that makes the pictures where ``count_in`` pairs have no room in ``blocks_out``.

    Each tile walks ``order_in``, all Gaussians of its view; see ``Bins`` for the lists.
    """
    walk = _walking(channels, parts, False)

    @wp.kernel(**kernel_options(_warps(channels)))
    @no_type_check
    def composite_unlisted(
        picture: Picture,
        gaussians: Gaussians,
        order_in: wp.array[wp.int32],
        offsets_in: wp.array[wp.int32],
        count_in: wp.array[wp.int64],
        transmittances_out: wp.array2d[wp.float32],
        stops_out: wp.array2d[wp.int32],
        blocks_out: wp.array[wp.int32],
        walked_out: wp.array[wp.int32],
        blocks_walked_out: wp.array[wp.int64],
        renders_out: wp.array2d[wp.float32],
        alphas_out: wp.array2d[wp.float32],
    ):
        index, lane = wp.tid()
        arena = wp.tile_empty(shape=(wp.static(WARP + _SIZE),), dtype=float, storage="shared")
        if count_in[0] > wp.int64(blocks_out.shape[0]):
            image = index // wp.static(parts) // (picture.tiles_x * picture.tiles_y)
            walk(
                picture,
                gaussians,
                arena,
                index,
                lane,
                image * picture.num,
                (image + 1) * picture.num,
                order_in,
                offsets_in,
                transmittances_out,
                stops_out,
                blocks_out,
                walked_out,
                blocks_walked_out,
                renders_out,
                alphas_out,
            )

    return composite_unlisted
