"""Tile lists on the CPU: a radix sort by depth, then counting and writing straight into place.

The Gaussians of a view, front to back, are cut into parts, one task each. Counting gives the pairs
of each (part, tile); their running sum is where each part writes its pairs of each tile.
"""

from collections.abc import Callable

import torch
import warp as wp
from torch import Tensor

from ..interop import parallel_launch
from .tiles import Ellipse, Grid, box_pairs, make_ellipse, q_limit, tile_columns, tile_rows

wp.set_module_options({"enable_backward": False})

_BITS = wp.constant(11)
_DIGITS = wp.constant(2048)
_ROWS = wp.constant(8)  # of tiles, whose columns are kept from counting to writing
_PARTS_PER_THREAD = 4  # Gaussians differ in size, and so do parts


@wp.func
def _next_place(counts: wp.array3d[wp.int32], image: int, turn: int, key: int) -> int:
    digit = (key >> (turn * _BITS)) & (_DIGITS - 1)
    place = counts[image, turn, digit]
    counts[image, turn, digit] = place + 1
    return place


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
        for turn in range(3):
            digit = (key >> (turn * _BITS)) & (_DIGITS - 1)
            counts_out[image, turn, digit] = counts_out[image, turn, digit] + 1
    for turn in range(3):
        total = wp.int32(0)
        for digit in range(_DIGITS):
            count = counts_out[image, turn, digit]
            counts_out[image, turn, digit] = total
            total += count
    for i in range(num):
        key = wp.cast(depths_in[image, i], wp.int32)
        place = _next_place(counts_out, image, 0, key)
        keys_out[image, 0, place] = key
        order_out[image, place] = i
    for i in range(num):
        key = keys_out[image, 0, i]
        place = _next_place(counts_out, image, 1, key)
        keys_out[image, 1, place] = key
        places_out[image, place] = order_out[image, i]
    for i in range(num):
        place = _next_place(counts_out, image, 2, keys_out[image, 1, i])
        order_out[image, place] = image * num + places_out[image, i]


@wp.func
def _part(num: wp.int32, part: wp.int32, parts: wp.int32) -> wp.int32:
    # where a part begins; num * part may not fit an int32
    return wp.int32(wp.int64(num) * wp.int64(part) / wp.int64(parts))


@wp.func
def _rows_kept(grid: Grid) -> wp.int32:
    # a span is two numbers of 16 bits
    return wp.where(grid.tiles_x < 32768, _ROWS, 0)


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
    steps_out: wp.array3d[wp.int32],
    spans_out: wp.array2d[wp.int32],
):
    """Steps: of the number of pairs from tile to tile along a row; its running sum is the number.

    Spans: the columns of each row of tiles, for Gaussians with few rows.
    """
    task = offset + wp.tid()
    parts = steps_out.shape[1]
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
                if ty - rows[0] < _rows_kept(grid):
                    spans_out[j, ty - rows[0]] = columns[0] | columns[1] << 16
                if columns[0] <= columns[1]:
                    count += columns[1] - columns[0] + 1
                    first = ty * (grid.tiles_x + 1) + columns[0]
                    last = ty * (grid.tiles_x + 1) + columns[1] + 1
                    steps_out[image, part, first] = steps_out[image, part, first] + 1
                    steps_out[image, part, last] = steps_out[image, part, last] - 1
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
    spans_in: wp.array2d[wp.int32],
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
            mean = means2d_in[i]
            rows = tile_rows(grid, mean[1], extent[1])
            ellipse = Ellipse()
            if rows[1] - rows[0] >= _rows_kept(grid):
                limit = q_limit(view_opacities_in[i], grid.alpha_min)
                ellipse = make_ellipse(mean, conics_in[i], limit)
            for ty in range(rows[0], rows[1] + 1):
                columns = wp.vec2i(0, 0)
                if ty - rows[0] < _rows_kept(grid):
                    span = spans_in[j, ty - rows[0]]
                    columns = wp.vec2i(span & 0xFFFF, span >> 16)
                else:
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
    counts = order.new_empty(images * num)
    steps = order.new_zeros(images, parts, grid.tiles_y, grid.tiles_x + 1)
    box_counts = torch.zeros(images * parts, dtype=torch.int64)
    tasks = images * parts
    spans = order.new_empty(images * num, _ROWS)
    outputs = [counts, box_counts, steps.flatten(2), spans]
    parallel_launch(_count, tasks, [grid, order, *inputs], outputs, pieces=tasks)
    offsets = torch.nn.functional.pad(counts.cumsum(0, dtype=torch.int64), (1, 0))
    total = int(offsets[-1])
    check(total)
    offsets = offsets.int()
    # running sums in the order of the pairs: view, tile, part
    in_tiles = steps.cumsum(3, dtype=torch.int32)[..., :-1].reshape(images, parts, tiles)
    ends = in_tiles.transpose(1, 2).reshape(-1).cumsum(0).int()
    begins = torch.nn.functional.pad(ends, (1, 0)).view(-1)
    starts = begins[::parts].clone()  # not the memory of the cursors
    cursors = begins[:-1].view(images, tiles, parts).transpose(1, 2).contiguous()
    pairs, rows = order.new_empty(total), order.new_empty(total)
    if total:
        inputs = [grid, order, *inputs, offsets, spans]
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
