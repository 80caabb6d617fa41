"""Tile lists on the CPU: a radix sort by depth, then counting and writing straight into place.

Which tiles a Gaussian touches is found in the order of the Gaussians, beside the sort. Then the
Gaussians of a view, front to back, are cut into parts, one task each. Counting gives the pairs
of each (part, tile); their running sum is where each part writes its pairs of each tile.
"""

from collections.abc import Callable
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ..tiles import Bins, Ellipse, Grid, box_pairs, make_ellipse, q_limit, tile_columns, tile_rows
from .bin_many import MANY, bin_many
from .places import place_pairs

wp.set_module_options({"enable_backward": False})

_BITS = wp.constant(11)
_DIGITS = wp.constant(2048)
# A Gaussian's record: number of pairs, first and last row of tiles, columns of the first rows,
# two numbers of 16 bits each: a picture has at most 2^12 tiles in a row.
_COUNT, _FIRST_ROW, _LAST_ROW, _SPANS = (wp.constant(i) for i in range(4))
_ROWS = wp.constant(9)
_RECORD = 12
_AHEAD = wp.constant(12)  # Gaussians that pass while a record comes from memory
_PARTS_PER_THREAD = 4  # more than 1, since Gaussians differ in size, and so do parts


@wp.func_native("""
const int* record = records.data + (size_t)i * records.shape[1];
__builtin_prefetch(record);
__builtin_prefetch(record + records.shape[1] - 1);
""")
def _fetch(records: wp.array2d[wp.int32], i: wp.int32):
    """Prefetches a record: records are read in the order of depth, which is a random one."""
    ...


@wp.func
@no_type_check
def _next_place(counts: wp.array3d[wp.int32], image: int, turn: int, key: int) -> int:
    digit = (key >> (turn * _BITS)) & (_DIGITS - 1)
    place = counts[image, turn, digit]
    counts[image, turn, digit] = place + 1
    return place


@wp.func
@no_type_check
def _sort_view(
    image: wp.int32,
    depths: wp.array2d[wp.float32],
    keys: wp.array3d[wp.int32],
    places: wp.array2d[wp.int32],
    counts: wp.array3d[wp.int32],
    order: wp.array2d[wp.int32],
):
    # front to back, equal depths by index; keys, places and counts are room to work
    num = depths.shape[1]
    for digit in range(_DIGITS):
        for turn in range(3):
            counts[image, turn, digit] = 0
    for i in range(num):
        # depths are not negative: their bits are ordered as they are
        key = wp.cast(depths[image, i], wp.int32)
        for turn in range(3):
            digit = (key >> (turn * _BITS)) & (_DIGITS - 1)
            counts[image, turn, digit] = counts[image, turn, digit] + 1
    for turn in range(3):
        total = wp.int32(0)
        for digit in range(_DIGITS):
            count = counts[image, turn, digit]
            counts[image, turn, digit] = total
            total += count
    for i in range(num):
        key = wp.cast(depths[image, i], wp.int32)
        place = _next_place(counts, image, 0, key)
        keys[image, 0, place] = key
        order[image, place] = i
    for i in range(num):
        key = keys[image, 0, i]
        place = _next_place(counts, image, 1, key)
        keys[image, 1, place] = key
        places[image, place] = order[image, i]
    for i in range(num):
        place = _next_place(counts, image, 2, keys[image, 1, i])
        order[image, place] = image * num + places[image, i]


@wp.func
@no_type_check
def _part(num: wp.int32, part: wp.int32, parts: wp.int32) -> wp.int32:
    # where a part begins; num * part may not fit an int32
    return wp.int32(wp.int64(num) * wp.int64(part) / wp.int64(parts))


@wp.func
@no_type_check
def _ellipse(
    grid: Grid,
    means2d: wp.array[wp.vec2],
    conics: wp.array[wp.vec3],
    view_opacities: wp.array[wp.float32],
    i: wp.int32,
) -> Ellipse:
    limit = q_limit(view_opacities[i], grid.alpha_min)
    return make_ellipse(means2d[i], conics[i], limit)


@wp.kernel
@no_type_check
def _prepare(
    offset: wp.int32,
    grid: Grid,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    depths_in: wp.array2d[wp.float32],
    keys_out: wp.array3d[wp.int32],
    places_out: wp.array2d[wp.int32],
    digits_out: wp.array3d[wp.int32],
    order_out: wp.array2d[wp.int32],
    records_out: wp.array2d[wp.int32],
    box_counts_out: wp.array[wp.int64],
):
    """The first tasks each sort a view, the others each make records of some Gaussians."""
    images = depths_in.shape[0]
    task = offset + wp.tid() - images
    if task < 0:
        _sort_view(task + images, depths_in, keys_out, places_out, digits_out, order_out)
        return
    total = records_out.shape[0]
    parts = box_counts_out.shape[0]
    box_count = wp.int64(0)
    for i in range(_part(total, task, parts), _part(total, task + 1, parts)):
        extent = extents_in[i]
        count = wp.int32(0)
        rows = wp.vec2i(0, -1)
        if extent[0] > 0.0:
            ellipse = _ellipse(grid, means2d_in, conics_in, view_opacities_in, i)
            rows = tile_rows(grid, ellipse.mean[1], extent[1])
            for ty in range(rows[0], rows[1] + 1):
                columns = tile_columns(grid, ellipse, extent, ty)
                if ty - rows[0] < _ROWS:
                    records_out[i, _SPANS + ty - rows[0]] = columns[0] | columns[1] << 16
                count += wp.max(columns[1] - columns[0] + 1, 0)
            box_count += box_pairs(grid, ellipse.mean, extent)
        records_out[i, _COUNT] = count
        records_out[i, _FIRST_ROW] = rows[0]
        records_out[i, _LAST_ROW] = rows[1]
    box_counts_out[task] = box_count


@wp.func
@no_type_check
def _columns(
    grid: Grid,
    means2d: wp.array[wp.vec2],
    conics: wp.array[wp.vec3],
    view_opacities: wp.array[wp.float32],
    extents: wp.array[wp.vec2],
    records: wp.array2d[wp.int32],
    i: wp.int32,
    ty: wp.int32,
) -> wp.vec2i:
    row = ty - records[i, _FIRST_ROW]
    if row < _ROWS:
        span = records[i, _SPANS + row]
        return wp.vec2i(span & 0xFFFF, span >> 16)
    ellipse = _ellipse(grid, means2d, conics, view_opacities, i)
    return tile_columns(grid, ellipse, extents[i], ty)


@wp.kernel
@no_type_check
def _count(
    offset: wp.int32,
    grid: Grid,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    order_in: wp.array[wp.int32],
    records_in: wp.array2d[wp.int32],
    counts_out: wp.array4d[wp.int32],
    totals_out: wp.array[wp.int64],
):
    """Counts hold zeros at first, and a column more than there are tiles in a row."""
    task = offset + wp.tid()
    parts = counts_out.shape[1]
    image = task // parts
    part = task % parts
    total = wp.int64(0)
    for j in range(
        image * grid.num + _part(grid.num, part, parts),
        image * grid.num + _part(grid.num, part + 1, parts),
    ):
        i = order_in[j]
        _fetch(records_in, order_in[wp.min(j + _AHEAD, order_in.shape[0] - 1)])
        total += wp.int64(records_in[i, _COUNT])
        for ty in range(records_in[i, _FIRST_ROW], records_in[i, _LAST_ROW] + 1):
            columns = _columns(
                grid, means2d_in, conics_in, view_opacities_in, extents_in, records_in, i, ty
            )
            if columns[0] <= columns[1]:
                # how the number of pairs changes from tile to tile, until all are through
                end = columns[1] + 1
                counts_out[image, part, ty, columns[0]] = (
                    counts_out[image, part, ty, columns[0]] + 1
                )
                counts_out[image, part, ty, end] = counts_out[image, part, ty, end] - 1
    totals_out[task] = total
    for ty in range(grid.tiles_y):
        count = wp.int32(0)
        for tx in range(grid.tiles_x):
            count += counts_out[image, part, ty, tx]
            counts_out[image, part, ty, tx] = count


@wp.kernel
@no_type_check
def _emit(
    offset: wp.int32,
    grid: Grid,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    order_in: wp.array[wp.int32],
    records_in: wp.array2d[wp.int32],
    numbers_in: wp.array[wp.int32],
    cursors_out: wp.array4d[wp.int32],
    offsets_out: wp.array[wp.int32],
    pairs_out: wp.array[wp.int32],
    rows_out: wp.array[wp.int32],
):
    """Cursors hold, at first, the place of the first pair of each (part, tile)."""
    task = offset + wp.tid()
    parts = cursors_out.shape[1]
    image = task // parts
    part = task % parts
    p = numbers_in[task]
    for j in range(
        image * grid.num + _part(grid.num, part, parts),
        image * grid.num + _part(grid.num, part + 1, parts),
    ):
        i = order_in[j]
        _fetch(records_in, order_in[wp.min(j + _AHEAD, order_in.shape[0] - 1)])
        offsets_out[j] = p
        for ty in range(records_in[i, _FIRST_ROW], records_in[i, _LAST_ROW] + 1):
            columns = _columns(
                grid, means2d_in, conics_in, view_opacities_in, extents_in, records_in, i, ty
            )
            for tx in range(columns[0], columns[1] + 1):
                place = cursors_out[image, part, ty, tx]
                cursors_out[image, part, ty, tx] = place + 1
                pairs_out[place] = i
                rows_out[place] = p
                p += 1


def bin_views(grid: Grid, depths: Tensor, inputs: list, check: Callable[[int], None]) -> Bins:
    """Makes the lists; ``check`` is given the number of pairs before they are made.

    Args:
        grid: from ``make_grid``.
        depths: ``[I, N]``, not negative.
        inputs: flat views of means2d, conics, opacities and extents.
        check: raises if there are too many.
    """
    images, num = depths.shape
    if images and num >= MANY:
        return bin_many(grid, depths, inputs, check)
    most = _PARTS_PER_THREAD * torch.get_num_threads()
    parts = 1 if images >= most else most
    order, records, boxes = _sorted_and_recorded(grid, depths, inputs, most)
    counts = order.new_zeros(images, parts, grid.tiles_y, grid.tiles_x + 1)
    totals = boxes.new_empty(images * parts)
    tasks = images * parts
    inputs = [grid, *inputs, order, records]
    parallel_launch(_count, tasks, inputs, [counts, totals], pieces=tasks)
    offsets = order.new_empty(images * num + 1)
    places = place_pairs(counts, totals, boxes, offsets, grid.tiles_x, check)
    pairs, rows = (order.new_empty(places.total) for _ in range(2))
    outputs = [counts, offsets, pairs, rows]
    parallel_launch(_emit, tasks, [*inputs, places.numbers], outputs, pieces=tasks)
    return Bins(order, offsets, pairs, rows, places.starts, places.box_pairs, places.count)


def _sorted_and_recorded(
    grid: Grid, depths: Tensor, inputs: list, parts: int
) -> tuple[Tensor, Tensor, Tensor]:
    """``order``, the records ``[I * N, 12]``, and pairs of boxes by ``parts`` of the Gaussians."""
    images, num = depths.shape
    order = torch.empty(images, num, dtype=torch.int32)
    box_counts = torch.empty(parts, dtype=torch.int64)
    records = order.new_empty(images * num, _RECORD)
    room = [order.new_empty(images, 2, num), torch.empty_like(order)]
    outputs = [*room, order.new_empty(images, 3, 1 << 11), order, records, box_counts]
    tasks = images + parts
    if depths.numel():
        parallel_launch(_prepare, tasks, [grid, *inputs, depths], outputs, pieces=tasks)
    else:
        box_counts.zero_()
    return order.view(-1), records, box_counts
