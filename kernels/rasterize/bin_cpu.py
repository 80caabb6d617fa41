"""Tile lists on the CPU: a radix sort by depth, then counting and writing straight into place.

The Gaussians of a view, front to back, are cut into parts, one task each. Counting gives the pairs
of each (part, tile); their running sum is where each part writes its pairs of each tile.
"""

from collections.abc import Callable

import torch
import warp as wp
from torch import Tensor

from ..interop import parallel_launch
from .tiles import Grid, box_pairs, make_ellipse, q_limit, tile_columns, tile_rows

wp.set_module_options({"enable_backward": False})

_BITS = wp.constant(11)
_DIGITS = wp.constant(2048)
_PARTS_PER_THREAD = 4  # Gaussians differ in size, and so do parts


@wp.kernel
def _sort_depths(
    offset: wp.int32,
    depths_in: wp.array2d[wp.float32],
    keys_out: wp.array3d[wp.int32],
    places_out: wp.array2d[wp.int32],
    counts_out: wp.array3d[wp.int32],
    order_out: wp.array2d[wp.int32],
):
    """Front to back, equal depths by index; room to work: keys, places and counts of digits."""
    image = offset + wp.tid()
    num = depths_in.shape[1]
    for digit in range(_DIGITS):
        for turn in range(3):
            counts_out[image, turn, digit] = 0
    for i in range(num):
        # depths are not negative: their bits are ordered as they are
        key = wp.cast(depths_in[image, i], wp.int32)
        keys_out[image, 0, i] = key
        order_out[image, i] = i
        for turn in range(3):
            digit = (key >> (turn * _BITS)) & (_DIGITS - 1)
            counts_out[image, turn, digit] = counts_out[image, turn, digit] + 1
    # three turns end in the other half of the room
    for turn in range(3):
        total = wp.int32(0)
        for digit in range(_DIGITS):
            count = counts_out[image, turn, digit]
            counts_out[image, turn, digit] = total
            total += count
        source = turn % 2
        for i in range(num):
            key = keys_out[image, source, i]
            digit = (key >> (turn * _BITS)) & (_DIGITS - 1)
            place = counts_out[image, turn, digit]
            counts_out[image, turn, digit] = place + 1
            keys_out[image, 1 - source, place] = key
            if source == 0:
                places_out[image, place] = order_out[image, i]
            else:
                order_out[image, place] = places_out[image, i]
    for i in range(num):
        order_out[image, i] = image * num + places_out[image, i]


@wp.func
def _part(num: wp.int32, part: wp.int32, parts: wp.int32) -> wp.int32:
    # where a part begins; num * part may not fit an int32
    return wp.int32(wp.int64(num) * wp.int64(part) / wp.int64(parts))


@wp.kernel
def _count(
    offset: wp.int32,
    grid: Grid,
    order_in: wp.array[wp.int32],
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    counts_out: wp.array[wp.int32],
    box_counts_out: wp.array[wp.int64],
    in_tiles_out: wp.array3d[wp.int32],
):
    task = offset + wp.tid()
    parts = in_tiles_out.shape[1]
    image = task // parts
    part = task % parts
    box_count = wp.int64(0)
    for j in range(
        image * grid.num + _part(grid.num, part, parts),
        image * grid.num + _part(grid.num, part + 1, parts),
    ):
        i = order_in[j]
        extent = extents_in[i]
        count = wp.int32(0)
        if extent[0] > 0.0:
            limit = q_limit(view_opacities_in[i], grid.alpha_min)
            ellipse = make_ellipse(means2d_in[i], conics_in[i], limit)
            rows = tile_rows(grid, ellipse.mean[1], extent[1])
            for ty in range(rows[0], rows[1] + 1):
                columns = tile_columns(grid, ellipse, extent, ty)
                for tx in range(columns[0], columns[1] + 1):
                    tile = ty * grid.tiles_x + tx
                    in_tiles_out[image, part, tile] = in_tiles_out[image, part, tile] + 1
                count += wp.max(columns[1] - columns[0] + 1, 0)
            box_count += box_pairs(grid, ellipse.mean, extent)
        counts_out[j] = count
    box_counts_out[task] = box_count


@wp.kernel
def _emit(
    offset: wp.int32,
    grid: Grid,
    order_in: wp.array[wp.int32],
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    offsets_in: wp.array[wp.int32],
    cursors_out: wp.array3d[wp.int32],
    pairs_out: wp.array[wp.int32],
    rows_out: wp.array[wp.int32],
):
    """Cursors come in as the place of the first pair of each (part, tile)."""
    task = offset + wp.tid()
    parts = cursors_out.shape[1]
    image = task // parts
    part = task % parts
    for j in range(
        image * grid.num + _part(grid.num, part, parts),
        image * grid.num + _part(grid.num, part + 1, parts),
    ):
        i = order_in[j]
        extent = extents_in[i]
        if extent[0] > 0.0:
            p = offsets_in[j]
            limit = q_limit(view_opacities_in[i], grid.alpha_min)
            ellipse = make_ellipse(means2d_in[i], conics_in[i], limit)
            rows = tile_rows(grid, ellipse.mean[1], extent[1])
            for ty in range(rows[0], rows[1] + 1):
                columns = tile_columns(grid, ellipse, extent, ty)
                for tx in range(columns[0], columns[1] + 1):
                    tile = ty * grid.tiles_x + tx
                    place = cursors_out[image, part, tile]
                    cursors_out[image, part, tile] = place + 1
                    pairs_out[place] = i
                    rows_out[place] = p
                    p += 1


def bin_views(
    grid: Grid, depths: Tensor, inputs: list, check: Callable[[int], None]
) -> tuple[Tensor, ...]:
    """The fields of ``Bins``; ``check`` is given the number of pairs before they are made.

    Args:
        grid: from ``make_grid``.
        depths: ``[I, N]``, not negative.
        inputs: flat views of means2d, conics, opacities and extents.
        check: raises if there are too many.
    """
    (images, num), tiles = depths.shape, grid.tiles_x * grid.tiles_y
    order = _by_depth(depths)
    threads = torch.get_num_threads()
    parts = 1 if images >= _PARTS_PER_THREAD * threads else _PARTS_PER_THREAD * threads
    counts, in_tiles = order.new_empty(images * num), order.new_zeros(images, parts, tiles)
    box_counts = torch.zeros(images * parts, dtype=torch.int64)
    tasks = images * parts
    outputs = [counts, box_counts, in_tiles]
    parallel_launch(_count, tasks, [grid, order, *inputs], outputs, pieces=tasks)
    offsets = torch.nn.functional.pad(counts.cumsum(0, dtype=torch.int64), (1, 0))
    total = int(offsets[-1])
    check(total)
    offsets = offsets.int()
    # running sums in the order of the pairs: view, tile, part
    ends = in_tiles.transpose(1, 2).reshape(-1).cumsum(0).int()
    begins = torch.nn.functional.pad(ends, (1, 0)).view(-1)
    starts = begins[::parts].clone()  # not the memory of the cursors
    cursors = begins[:-1].view(images, tiles, parts).transpose(1, 2).contiguous()
    pairs, rows = order.new_empty(total), order.new_empty(total)
    if total:
        inputs = [grid, order, *inputs, offsets]
        parallel_launch(_emit, tasks, inputs, [cursors, pairs, rows], pieces=tasks)
    return order, offsets, pairs, rows, starts, box_counts.sum()


def _by_depth(depths: Tensor) -> Tensor:
    """``[I * N]`` view-major indices, front to back within each view."""
    images, num = depths.shape
    order = torch.empty(images, num, dtype=torch.int32)
    keys = torch.empty(images, 2, num, dtype=torch.int32)
    outputs = [keys, torch.empty_like(order), order.new_empty(images, 3, 2048)]
    if num:
        parallel_launch(_sort_depths, images, [depths], [*outputs, order], pieces=images)
    return order.view(-1)
