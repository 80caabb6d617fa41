"""The CUDA compositor's forward kernel: front to back over the pairs of a tile (README §3)."""

import functools
from typing import no_type_check

import warp as wp

from ...runtime.views import struct_of
from ..skip import BLOCK_TEST, STOPPED
from ..tiles import Bins, Pixels, RasterParams, Saved
from . import leaves as L
from .records import Gaussians
from .warp import (
    HEIGHT,
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
    touching,
    word,
)

_BITS = WARP * RECORD  # where the bits of the pairs that are evaluated begin
_MASKS = _BITS + WARP  # and each lane's mask of the sub-tiles that its Gaussian touches
_SIZE = _MASKS + WARP


@functools.cache
def _traversal(channels: int, parts: int):
    """The function that traverses the pairs of a tile's part."""
    memory = shared_memory(_SIZE)
    arena_type = memory.arena
    lane_pixels, touched, stage = pixels_of_lane(parts), touching(parts), staging(_SIZE)
    pixels = SUB_TILES // parts  # pixels per lane
    pixels_type = wp.types.vector(pixels, wp.float32)
    sums_type = wp.types.matrix((pixels, channels), wp.float32)

    @wp.func
    @no_type_check
    def leave(blocks: wp.array[wp.int32], k: wp.int32, part: wp.int32, mine: wp.int32):
        # stores the bits of a pair, or combines them over the parts that share it
        if wp.static(parts == 1):
            L.store_int(blocks, k, mine)
        else:
            shift_used = part * wp.static(16 // parts)
            shift_stop = part * wp.static(pixels)
            shifted = (mine & wp.static((1 << STOP) - 1)) << shift_used
            shifted |= (mine & wp.static(~((1 << STOP) - 1))) << shift_stop
            wp.atomic_or(blocks, k, shifted)

    @wp.func
    @no_type_check
    def traverse(
        params: RasterParams,
        gaussians: Gaussians,
        lists: struct_of(Bins),
        saved_out: struct_of(Saved),
        pixels_out: Pixels,
        arena: arena_type,
        p: LanePixels,
    ):
        k0 = lists.starts[p.tile]
        end = lists.starts[p.tile + 1]
        half = p.lane // 4 % 2  # which of a sub-tile's two blocks of 4 x 4 pixels
        # T is positive where a pixel continues, negative where it stopped, 0 outside of the image
        T = pixels_type()
        inside = wp.int32(0)
        for j in range(wp.static(pixels)):
            if p.px + j % 2 * WIDTH < params.width and p.py + j // 2 * HEIGHT < params.height:
                T[j] = 1.0
                inside |= 1 << j
        sums = sums_type()
        live = any_of(inside)

        if live == 0:
            end = k0
        evaluated = wp.int32(0)
        while k0 < end:
            # each lane tests one of the next 32 Gaussians; past the end, the last one
            k = wp.min(k0 + p.lane, end - 1)
            seen = k == k0 + p.lane
            g = L.load_int(lists.pairs, k)
            at = wp.int64(g) * wp.int64(gaussians.records.shape[1])
            shape = L.load4(gaussians.records, at)
            level = L.load4(gaussians.records, at + wp.int64(4))
            lane_mask = live
            if (params.skip & BLOCK_TEST) != 0:
                lane_mask &= touched(p, shape, level)
            if not seen:
                lane_mask = 0
            memory.put_int(arena, wp.static(_MASKS) + p.lane, lane_mask)
            # compacts the Gaussians that touch something
            todo = ballot(lane_mask)
            slot = L.count_bits(todo & ((1 << p.lane) - 1))
            if lane_mask != 0:
                color = L.load4(gaussians.records, at + wp.int64(8 + gaussians.first))
                stage(arena, slot * RECORD, shape, level, color, lane_mask)
            else:
                slot = -1
            count = L.count_bits(todo)
            sync()
            for i in range(count):
                shape = memory.get4(arena, i * RECORD)
                level = memory.get4(arena, i * RECORD + 4)
                color = memory.get4(arena, i * RECORD + 8)
                mask = live & wp.cast(level[2], wp.int32)
                used = word()
                stopped = word()
                for j in range(wp.static(pixels)):
                    if (mask & wp.static(1 << j)) != 0:
                        dy = p.y[j // 2] - shape[1]
                        u = L.sheared(shape[3], p.x[j % 2] - shape[0], dy)
                        alpha = L.exp2(L.exponent(shape[2], level[0], level[1], u, dy))
                        weight = T[j] * wp.min(alpha, params.alpha_max)
                        after = T[j] - weight
                        if alpha >= params.alpha_min and T[j] > 0.0:
                            if after > params.t_min:
                                used[0] += wp.static(1 << first_block(j))
                                T[j] = after
                                for c in range(wp.static(channels)):
                                    sums[j, c] += weight * color[c]
                            else:
                                stopped[0] += wp.static(1 << (STOP + j))
                bits = any_of((used[0] << half) | stopped[0])
                memory.put_int(arena, wp.static(_BITS) + i, bits)
                if (bits >> STOP) != 0:
                    k = k0 + L.highest_bit(ballot(wp.where(slot == i, 1, 0)))
                    for j in range(wp.static(pixels)):
                        if (bits & wp.static(1 << (STOP + j))) != 0:
                            if (stopped[0] & wp.static(1 << (STOP + j))) != 0:
                                T[j] = -T[j]
                                L.store_word(saved_out.stops, p.walk_row, j * WARP, k)
                            going = wp.int32(0)
                            if T[j] > 0.0:
                                going = 1
                            over = ballot(going) == 0
                            if over and (params.skip & STOPPED) != 0:
                                live &= wp.static(~(1 << j))
                    if slot > i:
                        lane_mask = live & memory.get_int(arena, wp.static(_MASKS) + p.lane)
                        memory.put_int(arena, wp.static(_MASKS) + p.lane, lane_mask)
                    if live == 0:
                        end = k + 1
                        count = i + 1
                        break
            sync()
            lane_mask = memory.get_int(arena, wp.static(_MASKS) + p.lane)
            evaluated += L.count_bits(lane_mask)
            mine = wp.int32(0)
            if slot >= 0 and slot < count:
                mine = memory.get_int(arena, wp.static(_BITS) + slot)
            if mine != 0:
                leave(saved_out.blocks, k0 + p.lane, p.part, mine)
            k0 += WARP

        # recomputed, so that no registers hold the lane's pixels during the traversal
        p = lane_pixels(params, L.opaque(p.index), p.lane)
        if p.lane == 0:
            wp.atomic_max(saved_out.traversed, p.tile, end - lists.starts[p.tile])
        if evaluated != 0 and gaussians.first == 0:
            wp.atomic_add(saved_out.blocks_traversed, p.tile, wp.int64(evaluated))
        first = p.pixel * wp.int64(gaussians.channels) + wp.int64(gaussians.first)
        for j in range(wp.static(pixels)):
            L.store(saved_out.transmittances, p.walk_row, j * WARP, T[j])
            if T[j] != 0.0:
                step = j // 2 * HEIGHT * params.width + j % 2 * WIDTH
                L.store(pixels_out.transmittances, p.pixel, step, wp.abs(T[j]))
                step *= gaussians.channels
                for c in range(wp.static(channels)):
                    L.store(pixels_out.renders, first, step + c, sums[j, c])

    return traverse


@functools.cache
def forward_kernel(channels: int, parts: int):
    """The kernel for so many channels, at most 4, and parts of a tile: 1, 2 or 4."""
    options = kernel_options(24 if channels < 4 else 20)  # as many warps as the registers allow
    lane_pixels, traverse = pixels_of_lane(parts), _traversal(channels, parts)

    @wp.kernel(enable_backward=False, **options)
    @no_type_check
    def composite(
        params: RasterParams,
        gaussians_in: Gaussians,
        lists_in: struct_of(Bins),
        saved_out: struct_of(Saved),
        pixels_out: Pixels,
    ):
        index, lane = wp.tid()
        arena = wp.tile_empty(shape=(wp.static(_SIZE),), dtype=float, storage="shared")
        p = lane_pixels(params, index, lane)
        traverse(params, gaussians_in, lists_in, saved_out, pixels_out, arena, p)

    return composite
