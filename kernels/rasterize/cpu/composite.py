"""Compositing on the CPU: threads take tile after tile, 16 lanes = the pixels of a 4 x 4 block.

A tile of 16 x 16 pixels is 16 such blocks (``tuning.py`` has other sizes). For each Gaussian of the
tile its blocks are tested at once (lanes = blocks), and only those that the ellipse touches are
evaluated (lanes = pixels). The gradient walks back to front and writes one row per (tile, Gaussian)
pair; rows are summed by Gaussian afterwards, without atomics. README.md §3 and §5 hold the maths.
"""

import functools
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ...runtime.views import vectors, view
from ..skip import BLOCK_TEST, EMPTY_TILES, STOPPED, UNUSED, ZERO_UPSTREAM
from ..tiles import Bins, PairGradients, Picture, Walk, color_row, q_limit
from . import lanes as L
from .blend import blend_leaves
from .lanes import block_leaves, lanes, lanes_int
from .reduce import reduce_rows
from .tuning import Tuning

# To unroll the loops over blocks and pixels would take the compiler long, for no gain.
_OPTIONS = {"enable_backward": False, "max_unroll": 1}

_BLOCK_TEST = wp.constant(BLOCK_TEST)
_STOPPED = wp.constant(STOPPED)
_EMPTY_TILES = wp.constant(EMPTY_TILES)
_ZERO_UPSTREAM = wp.constant(ZERO_UPSTREAM)
_UNUSED = wp.constant(UNUSED)
_AHEAD = wp.constant(8)  # pairs that pass while a Gaussian comes from memory
_NEVER = wp.constant(2**31 - 1)
_EXP2 = wp.constant(-0.72134752044)  # exp(-q/2) = 2^(_EXP2 q)


@functools.cache
def _forward_kernel(tuning: Tuning):
    columns, blocks, side = tuning.columns, tuning.blocks, tuning.tile
    leaves, blend = block_leaves(tuning), blend_leaves(tuning).blend
    first_x, first_y, touched = leaves.first_x, leaves.first_y, leaves.touched

    @wp.kernel(module="unique", module_options=_OPTIONS)
    @no_type_check
    def composite(
        offset: wp.int32,
        picture: Picture,
        tiles: wp.int32,
        means2d_in: wp.array[wp.vec2],
        conics_in: wp.array[wp.vec3],
        view_opacities_in: wp.array[wp.float32],
        colors_in: wp.array2d[wp.float32],
        pairs_in: wp.array[wp.int32],
        starts_in: wp.array[wp.int32],
        counter_out: wp.array[wp.int32],
        room_out: wp.array2d[lanes],
        transmittances_out: wp.array[lanes],
        stops_out: wp.array[lanes_int],
        blocks_out: wp.array[wp.int32],
        walked_out: wp.array[wp.int32],
        blocks_walked_out: wp.array[wp.int64],
        renders_out: wp.array4d[wp.float32],
        alphas_out: wp.array4d[wp.float32],
    ):
        """``counter`` is the next tile to take, ``room`` holds a worker's sums of colours."""
        worker = offset + wp.tid()
        channels = colors_in.shape[1]
        tile = L.take(counter_out)
        while tile < tiles:
            begin = starts_in[tile]
            end = starts_in[tile + 1]
            walked_out[tile] = 0
            blocks_walked_out[tile] = wp.int64(0)
            if begin < end or (picture.skip & _EMPTY_TILES) == 0:
                image = tile // (picture.tiles_x * picture.tiles_y)
                x = tile % picture.tiles_x * side
                y = tile // picture.tiles_x % picture.tiles_y * side
                xs = first_x(float(x) + 0.5)
                ys = first_y(float(y) + 0.5)
                first = tile * blocks
                for b in range(blocks):
                    transmittances_out[first + b] = lanes(1.0)
                    stops_out[first + b] = lanes_int(_NEVER)
                for i in range(blocks * channels):
                    room_out[worker, i] = lanes(0.0)

                inside = L.blocks_inside(picture.width - x, picture.height - y, columns)
                alive = inside
                evaluated = wp.int64(0)
                k = begin
                while k < end and alive != 0:
                    g = pairs_in[k]
                    later = pairs_in[wp.min(k + _AHEAD, end - 1)]
                    row = color_row(picture, later)
                    L.fetch(means2d_in, conics_in, view_opacities_in, colors_in, later, row)
                    mean = means2d_in[g]
                    conic = conics_in[g]
                    shear = conic[1]
                    opacity = view_opacities_in[g]
                    bits = alive
                    if (picture.skip & _BLOCK_TEST) != 0:
                        slope = -conic[0] * shear / (conic[0] * shear * shear + conic[2])
                        limit = q_limit(opacity, picture.alpha_min)
                        bits = alive & touched(
                            xs, ys, mean[0], mean[1], conic[0], shear, conic[2], slope, limit
                        )
                    used = wp.int32(0)
                    if bits != 0:
                        used = blend(
                            bits,
                            k,
                            float(x) + 0.5 - mean[0],
                            float(y) + 0.5 - mean[1],
                            shear,
                            _EXP2 * conic[0],
                            _EXP2 * conic[2],
                            opacity,
                            picture.alpha_min,
                            picture.alpha_max,
                            picture.t_min,
                            colors_in,
                            color_row(picture, g),
                            first,
                            worker,
                            transmittances_out,
                            stops_out,
                            room_out,
                        )
                        evaluated += wp.int64(L.count_bits(bits))
                        if (picture.skip & _STOPPED) != 0:
                            alive = alive & ~(used >> 16)
                    blocks_out[k] = used & 0xFFFF
                    k += 1
                walked_out[tile] = k - begin
                blocks_walked_out[tile] = evaluated

                while inside != 0:
                    b = L.lowest_bit(inside)
                    inside = inside & (inside - 1)
                    px = x + (b % columns) * 4
                    py = y + (b // columns) * 4
                    L.store_block(
                        alphas_out, image, py, px, 0, L.coverage(transmittances_out[first + b])
                    )
                    for c in range(channels):
                        L.store_block(
                            renders_out, image, py, px, c, room_out[worker, b * channels + c]
                        )
            tile = L.take(counter_out)

    return composite


@functools.cache
def _backward_kernel(tuning: Tuning):
    columns, blocks, side = tuning.columns, tuning.blocks, tuning.tile
    unblend = blend_leaves(tuning).unblend

    @wp.kernel(module="unique", module_options=_OPTIONS)
    @no_type_check
    def composite_vjp(
        offset: wp.int32,
        picture: Picture,
        tiles: wp.int32,
        geometry: wp.int32,
        means2d_in: wp.array[wp.vec2],
        conics_in: wp.array[wp.vec3],
        view_opacities_in: wp.array[wp.float32],
        colors_in: wp.array2d[wp.float32],
        pairs_in: wp.array[wp.int32],
        rows_in: wp.array[wp.int32],
        starts_in: wp.array[wp.int32],
        transmittances_in: wp.array[lanes],
        stops_in: wp.array[lanes_int],
        blocks_in: wp.array[wp.int32],
        walked_in: wp.array[wp.int32],
        v_renders_in: wp.array4d[wp.float32],
        v_alphas_in: wp.array4d[wp.float32],
        counter_out: wp.array[wp.int32],
        room_out: wp.array2d[lanes],
        v_pairs_out: wp.array2d[wp.float32],
        written_out: wp.array[wp.uint8],
        skipped_out: wp.array[wp.int32],
    ):
        """``counter`` is the next tile to take, ``room`` is as ``unblend`` has it."""
        worker = offset + wp.tid()
        channels = colors_in.shape[1]
        upstream = 32 + channels
        tile = L.take(counter_out)
        while tile < tiles:
            image = tile // (picture.tiles_x * picture.tiles_y)
            x = tile % picture.tiles_x * side
            y = tile // picture.tiles_x % picture.tiles_y * side
            first = tile * blocks
            any_v = wp.int32(0)
            inside = wp.int32(0)
            if walked_in[tile] > 0:
                inside = L.blocks_inside(picture.width - x, picture.height - y, columns)
            every = inside
            while inside != 0:
                b = L.lowest_bit(inside)
                inside = inside & (inside - 1)
                px = x + (b % columns) * 4
                py = y + (b // columns) * 4
                place = upstream + b * (channels + 1)
                v_alpha = L.load_block(v_alphas_in, image, py, px, 0)
                room_out[worker, place + channels] = v_alpha
                any_v = any_v | L.any_nonzero(v_alpha)
                for c in range(channels):
                    v_c = L.load_block(v_renders_in, image, py, px, c)
                    room_out[worker, place + c] = v_c
                    any_v = any_v | L.any_nonzero(v_c)
            wanted = any_v != 0 or ((picture.skip & _ZERO_UPSTREAM) == 0 and every != 0)
            skipped_out[tile] = wp.where(wanted, 0, 1)
            if wanted:
                for b in range(blocks):
                    room_out[worker, b] = L.absolute(transmittances_in[first + b])
                    room_out[worker, 16 + b] = lanes(0.0)
                k = starts_in[tile] + walked_in[tile] - 1
                while k >= starts_in[tile]:
                    bits = blocks_in[k]
                    later = wp.max(k - _AHEAD, starts_in[tile])
                    if blocks_in[later] != 0:
                        L.fetch_row(v_pairs_out, written_out, rows_in[later])
                        later = pairs_in[later]
                        row = color_row(picture, later)
                        L.fetch(means2d_in, conics_in, view_opacities_in, colors_in, later, row)
                    if (picture.skip & _UNUSED) == 0:
                        bits = every
                    if bits != 0:
                        g = pairs_in[k]
                        mean = means2d_in[g]
                        conic = conics_in[g]
                        unblend(
                            bits,
                            k,
                            geometry,
                            float(x) + 0.5 - mean[0],
                            float(y) + 0.5 - mean[1],
                            conic[1],
                            _EXP2 * conic[0],
                            _EXP2 * conic[2],
                            view_opacities_in[g],
                            picture.alpha_min,
                            picture.alpha_max,
                            colors_in,
                            color_row(picture, g),
                            first,
                            worker,
                            stops_in,
                            room_out,
                            rows_in[k],
                            v_pairs_out,
                        )
                        written_out[rows_in[k]] = wp.uint8(1)
                    k -= 1
            tile = L.take(counter_out)

    return composite_vjp


def composite_forward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    picture: Picture,
    tuning: Tuning,
) -> tuple[Tensor, Tensor, Walk]:
    """Blends I views; float32, contiguous tensors on the CPU.

    Args:
        means2d: ``[I, N, 2]``.
        conics: ``[I, N, 3]``.
        view_opacities: ``[I, N]``.
        colors: ``[rows, C]``, rows = B * N, or I * N if ``picture.colors_per_view``.
        bins: from ``bin_op``.
        picture: from ``make_picture``, with the tuning's tile.
        tuning: the choice of kernels; the lists were made with its tile.

    Returns:
        ``renders [I, H, W, C]``, ``alphas [I, H, W, 1]`` and a ``Walk``.
    """
    images, channels = means2d.shape[0], colors.shape[1]
    tiles = images * picture.tiles_x * picture.tiles_y
    renders = colors.new_zeros(images, picture.height, picture.width, channels)
    alphas = colors.new_zeros(images, picture.height, picture.width, 1)
    workers, blocks = torch.get_num_threads(), tuning.blocks
    walk = Walk(
        transmittances=colors.new_empty(tiles * blocks, 16),
        stops=bins.pairs.new_empty(tiles * blocks, 16),
        blocks=torch.zeros_like(bins.pairs),
        walked=bins.pairs.new_empty(tiles),
        blocks_walked=bins.pairs.new_empty(tiles, dtype=torch.int64),
    )
    parallel_launch(
        _forward_kernel(tuning),
        workers,
        [
            picture,
            tiles,
            vectors(means2d, wp.vec2),
            vectors(conics, wp.vec3),
            view_opacities.view(-1),
            colors,
            bins.pairs,
            bins.starts,
        ],
        [
            bins.pairs.new_zeros(1),
            view(colors.new_empty(workers, 16 * channels, 16), lanes),
            view(walk.transmittances, lanes),
            view(walk.stops, lanes_int),
            walk.blocks,
            walk.walked,
            walk.blocks_walked,
            renders,
            alphas,
        ],
    )
    return renders, alphas, walk


def composite_backward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    picture: Picture,
    tuning: Tuning,
    walk: Walk,
    v_renders: Tensor,
    v_alphas: Tensor,
    geometry: bool,
) -> tuple[PairGradients, Tensor]:
    """Gradients of ``composite_forward`` by (view, Gaussian), from a row of sums for each pair.

    Args:
        means2d: as forward.
        conics: as forward.
        view_opacities: as forward.
        colors: as forward.
        bins: as forward.
        picture: as forward.
        tuning: as forward.
        walk: as returned forward.
        v_renders: ``[I, H, W, C]``.
        v_alphas: ``[I, H, W, 1]``.
        geometry: whether anything but colours is asked for.

    Returns:
        The gradients and ``skipped [tiles]`` int32, 1 where a tile was not walked.
    """
    tiles, channels = walk.walked.numel(), colors.shape[1]
    v_pairs = empty([bins.pairs.numel(), 6 + channels], torch.float32)
    written = bins.pairs.new_zeros(bins.pairs.numel(), dtype=torch.uint8)
    skipped = torch.empty_like(walk.walked)
    workers, room = torch.get_num_threads(), 32 + channels + 16 * (channels + 1)
    parallel_launch(
        _backward_kernel(tuning),
        workers,
        [
            picture,
            tiles,
            int(geometry),
            vectors(means2d, wp.vec2),
            vectors(conics, wp.vec3),
            view_opacities.view(-1),
            colors,
            bins.pairs,
            bins.rows,
            bins.starts,
            view(walk.transmittances, lanes),
            view(walk.stops, lanes_int),
            walk.blocks,
            walk.walked,
            v_renders,
            v_alphas,
        ],
        [
            bins.pairs.new_zeros(1),
            view(colors.new_empty(workers, room, 16), lanes),
            v_pairs,
            written,
            skipped,
        ],
    )
    return reduce_rows(v_pairs, written, bins, conics, view_opacities, geometry), skipped
