"""Compositing on the CPU: one task per tile, 16 lanes = the pixels of a 4 x 4 block.

A tile of 16 x 16 pixels is 16 such blocks. For each Gaussian of the tile the 16 blocks are tested
at once (lanes = blocks), and only those that its ellipse touches are evaluated (lanes = pixels).
Backward walks back to front and writes one gradient row per (tile, Gaussian) pair, which are summed
by Gaussian afterwards: no atomics. README.md §3 and §5 hold the maths.
"""

import torch
import warp as wp
from torch import Tensor

from ..constants import T_MIN, TILE
from ..interop import parallel_launch, view
from . import lanes as L
from .bin import SLACK, SLACK_ABS, Bins
from .frame import Frame, Walk, color_row
from .launch import vectors

# Unrolled, the loops over blocks and pixels would take the compiler long for no gain.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

PIECES = 16  # of a launch: tiles differ in work

_TILE = wp.constant(TILE)
_T_MIN = wp.constant(T_MIN)
_SLACK = wp.constant(SLACK)
_SLACK_ABS = wp.constant(SLACK_ABS)
_NEVER = wp.constant(2**31 - 1)
_EXP2 = wp.constant(-0.72134752044)  # exp(-q/2) = 2^(_EXP2 q)


@wp.func
def _blocks_inside(frame: Frame, x: int, y: int) -> int:
    # bit b is set if block b of the tile at (x, y) has a pixel in the picture
    bits = wp.int32(0)
    for b in range(16):
        if x + (b % 4) * 4 < frame.width and y + (b // 4) * 4 < frame.height:
            bits = bits | (1 << b)
    return bits


@wp.kernel
def _composite(
    offset: wp.int32,
    frame: Frame,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    colors_in: wp.array2d[wp.float32],
    pairs_in: wp.array[wp.int32],
    starts_in: wp.array[wp.int32],
    transmittances_out: wp.array[L.lanes],
    sums_out: wp.array2d[L.lanes],
    stops_out: wp.array[L.lanes_int],
    blocks_out: wp.array[wp.int32],
    walked_out: wp.array[wp.int32],
    renders_out: wp.array4d[wp.float32],
    alphas_out: wp.array4d[wp.float32],
):
    tile = offset + wp.tid()
    image = tile // (frame.tiles_x * frame.tiles_y)
    x = tile % frame.tiles_x * _TILE
    y = tile // frame.tiles_x % frame.tiles_y * _TILE
    xs = L.block_x(float(x) + 0.5)
    ys = L.block_y(float(y) + 0.5)
    channels = colors_in.shape[1]
    first = tile * 16
    walked_out[tile] = 0
    if starts_in[tile] == starts_in[tile + 1]:
        return
    for b in range(16):
        transmittances_out[first + b] = L.lanes(1.0)
        stops_out[first + b] = L.lanes_int(_NEVER)
        for c in range(channels):
            sums_out[first + b, c] = L.lanes(0.0)

    alive = _blocks_inside(frame, x, y)
    k = starts_in[tile]
    while k < starts_in[tile + 1] and alive != 0:
        g = pairs_in[k]
        row = color_row(frame, g)
        mean = means2d_in[g]
        conic = conics_in[g]
        shear = conic[1]
        opacity = view_opacities_in[g]
        limit = 2.0 * wp.log(opacity / frame.alpha_min) * _SLACK + _SLACK_ABS
        slope = -conic[0] * shear / (conic[0] * shear * shear + conic[2])
        bits = alive & L.blocks_touched(
            xs, ys, mean[0], mean[1], conic[0], shear, conic[2], slope, limit
        )
        used = wp.int32(0)
        while bits != 0:
            b = L.lowest_bit(bits)
            bits = bits & (bits - 1)
            dx = float(x + (b % 4) * 4) + 0.5 - mean[0]
            dy = float(y + (b // 4) * 4) + 0.5 - mean[1]
            alpha = L.alphas(
                L.sheared(shear, dx + shear * dy),
                L.rows(dy),
                _EXP2 * conic[0],
                _EXP2 * conic[2],
                opacity,
                frame.alpha_min,
                frame.alpha_max,
            )
            if L.any_nonzero(alpha) != 0:
                used = used | (1 << b)
                before = transmittances_out[first + b]
                after = L.advance(before, alpha, _T_MIN)
                weight = L.weights(before, after, alpha)
                transmittances_out[first + b] = after
                for c in range(channels):
                    sums_out[first + b, c] = L.axpy(
                        weight, colors_in[row, c], sums_out[first + b, c]
                    )
                if L.any_stopped(before, after) != 0:
                    stops_out[first + b] = L.record_stops(stops_out[first + b], before, after, k)
                    if L.any_positive(after) == 0:
                        alive = alive & ~(1 << b)
        blocks_out[k] = used
        k += 1
    walked_out[tile] = k - starts_in[tile]

    inside = _blocks_inside(frame, x, y)
    while inside != 0:
        b = L.lowest_bit(inside)
        inside = inside & (inside - 1)
        px = x + (b % 4) * 4
        py = y + (b // 4) * 4
        covered = L.coverage(transmittances_out[first + b])
        L.store_block(alphas_out, image, py, px, 0, covered)
        for c in range(channels):
            L.store_block(renders_out, image, py, px, c, sums_out[first + b, c])


@wp.kernel
def _composite_vjp(
    offset: wp.int32,
    frame: Frame,
    geometry: wp.int32,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    colors_in: wp.array2d[wp.float32],
    pairs_in: wp.array[wp.int32],
    rows_in: wp.array[wp.int32],
    starts_in: wp.array[wp.int32],
    transmittances_in: wp.array[L.lanes],
    stops_in: wp.array[L.lanes_int],
    blocks_in: wp.array[wp.int32],
    walked_in: wp.array[wp.int32],
    v_renders_in: wp.array4d[wp.float32],
    v_alphas_in: wp.array4d[wp.float32],
    v_sums_out: wp.array2d[L.lanes],
    v_colors_out: wp.array2d[L.lanes],
    v_pairs_out: wp.array2d[wp.float32],
    skipped_out: wp.array[wp.int32],
):
    """Room to work: v_sums, upstream gradients by lanes; v_colors, those of one pair's colour."""
    tile = offset + wp.tid()
    image = tile // (frame.tiles_x * frame.tiles_y)
    x = tile % frame.tiles_x * _TILE
    y = tile // frame.tiles_x % frame.tiles_y * _TILE
    channels = colors_in.shape[1]
    first = tile * 16
    walked = walked_in[tile]
    skipped_out[tile] = 1
    if walked == 0:
        return

    any_v = wp.int32(0)
    inside = _blocks_inside(frame, x, y)
    while inside != 0:
        b = L.lowest_bit(inside)
        inside = inside & (inside - 1)
        px = x + (b % 4) * 4
        py = y + (b // 4) * 4
        v_alpha = L.load_block(v_alphas_in, image, py, px, 0)
        v_sums_out[first + b, channels] = v_alpha
        any_v = any_v | L.any_nonzero(v_alpha)
        for c in range(channels):
            v_c = L.load_block(v_renders_in, image, py, px, c)
            v_sums_out[first + b, c] = v_c
            any_v = any_v | L.any_nonzero(v_c)
    if any_v == 0:
        return
    skipped_out[tile] = 0

    T = wp.zeros(shape=16, dtype=L.lanes)
    R = wp.zeros(shape=16, dtype=L.lanes)
    for b in range(16):
        T[b] = L.absolute(transmittances_in[first + b])
    k = starts_in[tile] + walked - 1
    while k >= starts_in[tile]:
        bits = blocks_in[k]
        if bits != 0:
            g = pairs_in[k]
            row = color_row(frame, g)
            mean = means2d_in[g]
            conic = conics_in[g]
            shear = conic[1]
            opacity = view_opacities_in[g]
            sum_h = L.lanes(0.0)
            sum_u = L.lanes(0.0)
            sum_y = L.lanes(0.0)
            sum_uu = L.lanes(0.0)
            sum_uy = L.lanes(0.0)
            sum_yy = L.lanes(0.0)
            for c in range(channels):
                v_colors_out[tile, c] = L.lanes(0.0)
            while bits != 0:
                b = L.lowest_bit(bits)
                bits = bits & (bits - 1)
                dx = float(x + (b % 4) * 4) + 0.5 - mean[0]
                dy = float(y + (b // 4) * 4) + 0.5 - mean[1]
                u = L.sheared(shear, dx + shear * dy)
                v = L.rows(dy)
                alpha = L.alphas(
                    u,
                    v,
                    _EXP2 * conic[0],
                    _EXP2 * conic[2],
                    opacity,
                    frame.alpha_min,
                    frame.alpha_max,
                )
                alpha = L.before_stop(alpha, stops_in[first + b], k)
                T[b] = L.rewind(T[b], alpha)
                weight = L.mul(T[b], alpha)
                s = v_sums_out[first + b, channels]
                for c in range(channels):
                    v_c = v_sums_out[first + b, c]
                    s = L.axpy(v_c, colors_in[row, c], s)
                    v_colors_out[tile, c] = L.fma(weight, v_c, v_colors_out[tile, c])
                if geometry != 0:
                    diff = L.sub(s, R[b])
                    R[b] = L.fma(alpha, diff, R[b])
                    h = L.alpha_gradients(alpha, weight, diff, frame.alpha_max)
                    hu = L.mul(h, u)
                    hy = L.mul(h, v)
                    sum_h = L.add(sum_h, h)
                    sum_u = L.add(sum_u, hu)
                    sum_y = L.add(sum_y, hy)
                    sum_uu = L.fma(hu, u, sum_uu)
                    sum_uy = L.fma(hu, v, sum_uy)
                    sum_yy = L.fma(hy, v, sum_yy)
            out = rows_in[k]
            v_pairs_out[out, 0] = L.total(sum_h)
            v_pairs_out[out, 1] = L.total(sum_u)
            v_pairs_out[out, 2] = L.total(sum_y)
            v_pairs_out[out, 3] = L.total(sum_uu)
            v_pairs_out[out, 4] = L.total(sum_uy)
            v_pairs_out[out, 5] = L.total(sum_yy)
            for c in range(channels):
                v_pairs_out[out, 6 + c] = L.total(v_colors_out[tile, c])
        k -= 1


def composite_forward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    frame: Frame,
) -> tuple[Tensor, Tensor, Walk]:
    """Blends I views; float32, contiguous tensors on the CPU.

    Args:
        means2d: ``[I, N, 2]``.
        conics: ``[I, N, 3]``.
        view_opacities: ``[I, N]``.
        colors: ``[rows, C]``, rows = B * N, or I * N if ``frame.colors_per_view``.
        bins: from ``bin_gaussians``.
        frame: from ``make_frame``.

    Returns:
        ``renders [I, H, W, C]``, ``alphas [I, H, W, 1]`` and a ``Walk``.
    """
    images, channels = means2d.shape[0], colors.shape[1]
    tiles = images * frame.tiles_x * frame.tiles_y
    renders = colors.new_zeros(images, frame.height, frame.width, channels)
    alphas = colors.new_zeros(images, frame.height, frame.width, 1)
    sums = colors.new_empty(tiles * 16, channels, 16)
    walk = Walk(
        colors.new_empty(tiles * 16, 16),
        bins.pairs.new_empty(tiles * 16, 16),
        torch.zeros_like(bins.pairs),
        bins.pairs.new_empty(tiles),
    )
    parallel_launch(
        _composite,
        tiles,
        [
            frame,
            vectors(means2d, wp.vec2),
            vectors(conics, wp.vec3),
            view_opacities.view(-1),
            colors,
            bins.pairs,
            bins.starts,
        ],
        [
            view(walk.transmittances, L.lanes),
            view(sums, L.lanes),
            view(walk.stops, L.lanes_int),
            walk.blocks,
            walk.walked,
            renders,
            alphas,
        ],
        pieces=PIECES,
    )
    return renders, alphas, walk


def composite_backward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    frame: Frame,
    walk: Walk,
    v_renders: Tensor,
    v_alphas: Tensor,
    geometry: bool,
) -> tuple[Tensor, Tensor]:
    """Gradient sums of each pair, in emission order, for ``reduce_pairs``.

    Args:
        means2d: and the rest as forward.
        conics: as forward.
        view_opacities: as forward.
        colors: as forward.
        bins: as forward.
        frame: as forward.
        walk: as returned forward.
        v_renders: ``[I, H, W, C]``.
        v_alphas: ``[I, H, W, 1]``.
        geometry: whether anything but colours is asked for.

    Returns:
        ``v_pairs [P, 6 + C]`` and ``skipped [tiles]`` int32, 1 where a tile was not walked.
    """
    tiles, channels = walk.walked.numel(), colors.shape[1]
    v_pairs = colors.new_zeros(bins.pairs.numel(), 6 + channels)
    skipped = torch.empty_like(walk.walked)
    parallel_launch(
        _composite_vjp,
        tiles,
        [
            frame,
            int(geometry),
            vectors(means2d, wp.vec2),
            vectors(conics, wp.vec3),
            view_opacities.view(-1),
            colors,
            bins.pairs,
            bins.rows,
            bins.starts,
            view(walk.transmittances, L.lanes),
            view(walk.stops, L.lanes_int),
            walk.blocks,
            walk.walked,
            v_renders,
            v_alphas,
        ],
        [
            view(colors.new_empty(tiles * 16, channels + 1, 16), L.lanes),
            view(colors.new_empty(tiles, channels, 16), L.lanes),
            v_pairs,
            skipped,
        ],
        pieces=PIECES,
    )
    return v_pairs, skipped
