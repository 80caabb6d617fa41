"""The CUDA compositor's forward kernel: one warp per tile, front to back (README §3)."""

import functools

import warp as wp

from ..constants import T_MIN
from .composite_cuda_warp import (
    PIXELS,
    RECORD,
    WARP,
    exp2,
    exponent,
    first_block,
    lowest_bit,
    make_place,
    shared_memory,
    sheared,
    staging,
    sub_tile,
    touched,
    vec8,
)
from .frame import Frame

_SIZE = WARP * RECORD
_T_MIN = wp.constant(T_MIN)
_STOP = 16  # bit 16 + j of a pair: a pixel of sub-tile j stopped at it


@functools.cache
def forward_kernel(channels: int):
    """The kernel for so many channels, at most 4; ``first`` is the first of them."""
    arena_type, sync, any_of, ballot, _, _, get_int, _, get4 = shared_memory(_SIZE)
    stage = staging(channels, _SIZE)
    sums_type = wp.types.matrix((PIXELS, channels), wp.float32)

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=WARP, grid_stride=False)
    def composite(
        frame: Frame,
        first: wp.int32,
        means2d_in: wp.array[wp.vec2],
        conics_in: wp.array[wp.vec3],
        view_opacities_in: wp.array[wp.float32],
        colors_in: wp.array2d[wp.float32],
        pairs_in: wp.array[wp.int32],
        starts_in: wp.array[wp.int32],
        transmittances_out: wp.array2d[wp.float32],
        stops_out: wp.array2d[wp.int32],
        blocks_out: wp.array[wp.int32],
        walked_out: wp.array[wp.int32],
        renders_out: wp.array4d[wp.float32],
        alphas_out: wp.array4d[wp.float32],
    ):
        tile, lane = wp.tid()
        arena = wp.tile_empty(shape=(wp.static(WARP + _SIZE),), dtype=float, storage="shared")
        p = make_place(frame, tile, lane)
        x = float(p.px) + 0.5
        y = float(p.py) + 0.5
        half = lane // 4 % 2  # of a sub-tile: blocks of 4 x 4 pixels
        T = vec8()  # positive: the pixel goes on; negative: it stopped; 0: outside the picture
        sums = sums_type()
        inside = wp.int32(0)
        for j in range(PIXELS):
            if (
                p.px + wp.static(sub_tile(j)[0]) < frame.width
                and p.py + wp.static(sub_tile(j)[1]) < frame.height
            ):
                T[j] = 1.0
                inside |= 1 << j
        live = any_of(arena, lane, inside)

        begin = starts_in[tile]
        end = starts_in[tile + 1]
        walked = end - begin
        for k0 in range(begin, end, WARP):
            if live == 0:
                break
            # each lane looks at one of the next 32 Gaussians
            k = k0 + lane
            mask = wp.int32(0)
            if k < end:
                g = pairs_in[k]
                mean = means2d_in[g]
                conic = conics_in[g]
                opacity = view_opacities_in[g]
                mask = live & touched(p.corner, mean, conic, opacity, frame.alpha_min)
                at = lane * RECORD
                stage(arena, frame, at, first, g, mean, conic, opacity, colors_in, mask, 0)
            todo = ballot(arena, lane, mask)
            sync()
            mine = wp.int32(0)
            while todo != 0 and live != 0:
                i = lowest_bit(todo)
                todo &= todo - 1
                shape = get4(arena, i * RECORD)
                level = get4(arena, i * RECORD + 4)
                color = get4(arena, i * RECORD + 8)
                mask = live & get_int(arena, i * RECORD + 6)
                dx = x - shape[0]
                dy = y - shape[1]
                bits = wp.int32(0)
                stopped = wp.int32(0)
                for j in range(PIXELS):
                    if (mask & wp.static(1 << j)) != 0:
                        dyj = dy + wp.static(float(sub_tile(j)[1]))
                        u = sheared(shape[3], dx + wp.static(float(sub_tile(j)[0])), dyj)
                        alpha = exp2(exponent(shape[2], level[0], level[1], u, dyj))
                        weight = T[j] * wp.min(alpha, frame.alpha_max)
                        after = T[j] - weight
                        if alpha >= frame.alpha_min and T[j] > 0.0:
                            if after > _T_MIN:
                                bits |= wp.static(1 << first_block(j))
                                T[j] = after
                                for c in range(wp.static(channels)):
                                    sums[j, c] += weight * color[c]
                            else:
                                stopped |= wp.static(1 << (_STOP + j))
                bits = any_of(arena, lane, (bits << half) | stopped)
                if lane == i:
                    mine = bits
                if (bits >> _STOP) != 0:
                    for j in range(PIXELS):
                        if (bits & wp.static(1 << (_STOP + j))) != 0:
                            if (stopped & wp.static(1 << (_STOP + j))) != 0:
                                T[j] = -T[j]
                                stops_out[tile, j * WARP + lane] = k0 + i
                            going = wp.int32(0)
                            if T[j] > 0.0:
                                going = 1
                            if ballot(arena, lane, going) == 0:
                                live &= wp.static(~(1 << j))
                    if live == 0:
                        walked = k0 + i - begin + 1
            if k < end:
                blocks_out[k] = mine
            sync()

        if lane == 0:
            walked_out[tile] = walked
        for j in range(PIXELS):
            transmittances_out[tile, j * WARP + lane] = T[j]
            if T[j] != 0.0:
                row = p.py + wp.static(sub_tile(j)[1])
                column = p.px + wp.static(sub_tile(j)[0])
                alphas_out[p.image, row, column, 0] = 1.0 - wp.abs(T[j])
                for c in range(wp.static(channels)):
                    renders_out[p.image, row, column, first + c] = sums[j, c]

    return composite
