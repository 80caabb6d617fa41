"""The CUDA compositor's gradient kernel: one warp per tile, back to front (README §5)."""

import functools

import warp as wp

from .composite_cuda_warp import (
    PIXELS,
    PITCH,
    RECORD,
    WARP,
    exp2,
    exponent,
    first_block,
    lowest_bit,
    make_place,
    reciprocal,
    shared_memory,
    sheared,
    staging,
    sub_tile,
    vec8,
)
from .frame import Frame

_STOP = 16
_BLOCKS = wp.constant((1 << _STOP) - 1)
_EVEN = 0x5555


@functools.cache
def backward_kernel(channels: int, geometry: bool):
    """The kernel for so many channels, at most 4; without ``geometry`` for colours alone."""
    moments = 6 if geometry else 0
    values = moments + channels  # sums of a pair
    slots = WARP // values  # pairs whose sums are completed at once, a lane for each
    rows_at = WARP * RECORD
    sums_at = rows_at + WARP
    size = sums_at + slots * values * PITCH
    arena_type, sync, any_of, ballot, put, put_int, get_int, _, get4 = shared_memory(size)
    stage = staging(channels, size)
    values_type = wp.types.vector(values, wp.float32)
    upstream_type = wp.types.matrix((PIXELS, channels), wp.float32)

    @wp.func
    def complete(
        arena: arena_type, lane: wp.int32, count: wp.int32, first: wp.int32,
        v_pairs: wp.array2d[wp.float32],
    ):  # fmt: skip
        # each lane adds up one value of one of the waiting pairs, over the 32 lanes
        if lane < count * wp.static(values):
            at = wp.static(sums_at) + lane * PITCH
            total = get4(arena, at)
            for i in range(1, wp.static(WARP // 4)):
                total += get4(arena, at + 4 * i)
            value = (total[0] + total[1]) + (total[2] + total[3])
            row = get_int(arena, wp.static(rows_at) + lane / wp.static(values))
            v = lane % wp.static(values)
            if v < wp.static(moments):
                if first > 0:
                    value += v_pairs[row, v]
                v_pairs[row, v] = value
            else:
                v_pairs[row, v + wp.static(6 - moments) + first] = value

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=WARP, grid_stride=False)
    def composite_vjp(
        frame: Frame,
        first: wp.int32,
        means2d_in: wp.array[wp.vec2],
        conics_in: wp.array[wp.vec3],
        view_opacities_in: wp.array[wp.float32],
        colors_in: wp.array2d[wp.float32],
        pairs_in: wp.array[wp.int32],
        rows_in: wp.array[wp.int32],
        starts_in: wp.array[wp.int32],
        transmittances_in: wp.array2d[wp.float32],
        stops_in: wp.array2d[wp.int32],
        blocks_in: wp.array[wp.int32],
        walked_in: wp.array[wp.int32],
        v_renders_in: wp.array4d[wp.float32],
        v_alphas_in: wp.array4d[wp.float32],
        v_pairs_out: wp.array2d[wp.float32],
        skipped_out: wp.array[wp.int32],
    ):
        tile, lane = wp.tid()
        arena = wp.tile_empty(shape=(wp.static(WARP + size),), dtype=float, storage="shared")
        p = make_place(frame, tile, lane)
        x = float(p.px) + 0.5
        y = float(p.py) + 0.5
        T = vec8()  # as forward left it: negative until the walk comes to where the pixel stopped
        R = vec8()  # README eq. 10, less the gradient of alpha, which is the same for all pairs
        upstream = upstream_type()
        some = wp.int32(0)
        for j in range(PIXELS):
            T[j] = transmittances_in[tile, j * WARP + lane]
            if T[j] != 0.0:
                row = p.py + wp.static(sub_tile(j)[1])
                column = p.px + wp.static(sub_tile(j)[0])
                largest = wp.float32(0.0)
                for c in range(wp.static(channels)):
                    upstream[j, c] = v_renders_in[p.image, row, column, first + c]
                    largest += wp.abs(upstream[j, c])
                if first == 0:
                    R[j] = -v_alphas_in[p.image, row, column, 0]
                    largest += wp.abs(R[j])
                # NaN is not taken for zero
                if not (largest <= 0.0):
                    some |= wp.static(3 << first_block(j))
        wanted = any_of(arena, lane, some)
        walked = walked_in[tile]
        if wanted == 0:
            walked = 0
        if walked > 0 and lane == 0:
            skipped_out[tile] = 0

        begin = starts_in[tile]
        waiting = wp.int32(0)
        for done in range(0, walked, WARP):
            k = begin + walked - 1 - done - lane
            word = wp.int32(0)
            if k >= begin:
                word = blocks_in[k] & (wanted | wp.static(~((1 << _STOP) - 1)))
                if word != 0:
                    g = pairs_in[k]
                    at = lane * RECORD
                    stage(
                        arena, frame, at, first, g, means2d_in[g], conics_in[g],
                        view_opacities_in[g], colors_in, word, rows_in[k],
                    )  # fmt: skip
            todo = ballot(arena, lane, word)
            sync()
            while todo != 0:
                i = lowest_bit(todo)
                todo &= todo - 1
                shape = get4(arena, i * RECORD)
                level = get4(arena, i * RECORD + 4)
                color = get4(arena, i * RECORD + 8)
                bits = get_int(arena, i * RECORD + 6)
                dx = x - shape[0]
                dy = y - shape[1]
                sums = values_type()
                for j in range(PIXELS):
                    if (bits & wp.static(3 << first_block(j))) != 0:
                        dyj = dy + wp.static(float(sub_tile(j)[1]))
                        u = sheared(shape[3], dx + wp.static(float(sub_tile(j)[0])), dyj)
                        alpha = exp2(exponent(shape[2], level[0], level[1], u, dyj))
                        clamped = wp.min(alpha, frame.alpha_max)
                        if alpha >= frame.alpha_min and T[j] > 0.0:
                            T[j] = T[j] * reciprocal(1.0 - clamped)
                            weight = T[j] * clamped
                            for c in range(wp.static(channels)):
                                sums[wp.static(moments) + c] += weight * upstream[j, c]
                            if wp.static(geometry):
                                diff = -R[j]
                                for c in range(wp.static(channels)):
                                    diff += color[c] * upstream[j, c]
                                R[j] = R[j] + clamped * diff
                                if alpha < frame.alpha_max:
                                    h = weight * diff
                                    hu = h * u
                                    hy = h * dyj
                                    sums[0] += h
                                    sums[1] += hu
                                    sums[2] += hy
                                    sums[3] += hu * u
                                    sums[4] += hu * dyj
                                    sums[5] += hy * dyj
                if (bits & _BLOCKS) != 0:
                    at = wp.static(sums_at) + waiting * wp.static(values * PITCH) + lane
                    for v in range(wp.static(values)):
                        put(arena, at + wp.static(v * PITCH), sums[v])
                    row = get_int(arena, i * RECORD + 7)
                    put_int(arena, wp.static(rows_at) + waiting, row)
                    waiting += 1
                    if waiting == wp.static(slots):
                        sync()
                        complete(arena, lane, waiting, first, v_pairs_out)
                        sync()
                        waiting = 0
                if (bits >> _STOP) != 0:
                    # what stopped here takes part from the next pair on
                    k = begin + walked - 1 - done - i
                    for j in range(PIXELS):
                        if (bits & wp.static(1 << (_STOP + j))) != 0:
                            if T[j] < 0.0:
                                if stops_in[tile, j * WARP + lane] == k:
                                    T[j] = -T[j]
            sync()
        sync()
        complete(arena, lane, waiting, first, v_pairs_out)

    return composite_vjp
