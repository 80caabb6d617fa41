"""Tile lists of views of many Gaussians on the CPU: written in the order of index, then sorted.

A sort of a million Gaussians by depth, and every later step in that random order, wait for memory.
Here each step but the last goes through the Gaussians as they lie, sixteen at a time: ``_count``
finds the tiles of each, leaves them as a window of 4 x 4 tiles, and finds how many pairs each tile
has; ``_scatter`` writes the pairs of the windows to the lists. ``_sort`` puts each list, which fits
the nearest cache, in order of depth. README.md §2 holds the maths.
"""

from collections.abc import Callable
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ..tiles import Bins, Grid
from .lanes import take
from .lists import count_part, scatter_part, sort_list
from .places import place_pairs

wp.set_module_options({"enable_backward": False})

MANY = 1 << 15  # Gaussians of a view from which these lists are the faster ones
_PARTS_PER_THREAD = 4
_LANES = wp.constant(16)  # Gaussians of a group


@wp.func
@no_type_check
def _groups(num: wp.int32) -> wp.int32:
    return (num + _LANES - 1) // _LANES


@wp.func
@no_type_check
def _group(num: wp.int32, part: wp.int32, parts: wp.int32) -> wp.int32:
    # the first group of a part of a view; their product may not fit an int32
    return wp.int32(wp.int64(_groups(num)) * wp.int64(part) / wp.int64(parts))


@wp.func
@no_type_check
def _part(num: wp.int32, parts: wp.int32, task: wp.int32) -> wp.vec3i:
    # the Gaussians of a task, from and to, and the first group of them
    image = task // parts
    first = _group(num, task % parts, parts)
    last = _group(num, task % parts + 1, parts)
    return wp.vec3i(
        image * num + first * _LANES,
        image * num + wp.min(last * _LANES, num),
        image * _groups(num) + first,
    )


@wp.kernel
@no_type_check
def _count(
    offset: wp.int32,
    grid: Grid,
    parts: wp.int32,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    corners_out: wp.array2d[wp.int32],
    windows_out: wp.array2d[wp.int16],
    counts_out: wp.array2d[wp.int32],
    totals_out: wp.array[wp.int64],
    boxes_out: wp.array[wp.int64],
):
    """Tasks are parts of the Gaussians of a view."""
    task = offset + wp.tid()
    part = _part(grid.num, parts, task)
    count_part(
        task,
        part[0],
        part[1],
        part[2],
        grid,
        means2d_in,
        conics_in,
        view_opacities_in,
        extents_in,
        corners_out,
        windows_out,
        counts_out,
        totals_out,
        boxes_out,
    )


@wp.kernel
@no_type_check
def _scatter(
    offset: wp.int32,
    grid: Grid,
    parts: wp.int32,
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    depths_in: wp.array[wp.float32],
    numbers_in: wp.array[wp.int32],
    corners_in: wp.array2d[wp.int32],
    windows_in: wp.array2d[wp.int16],
    cursors_out: wp.array2d[wp.int32],
    offsets_out: wp.array[wp.int32],
    staged_out: wp.array2d[wp.int32],
):
    """Cursors hold, at first, the place of the first pair of each (task, tile)."""
    task = offset + wp.tid()
    part = _part(grid.num, parts, task)
    scatter_part(
        task,
        part[0],
        part[1],
        part[2],
        numbers_in[task],
        grid,
        means2d_in,
        conics_in,
        view_opacities_in,
        extents_in,
        depths_in,
        corners_in,
        windows_in,
        cursors_out,
        offsets_out,
        staged_out,
    )


@wp.kernel
@no_type_check
def _sort(
    offset: wp.int32,
    tiles: wp.int32,
    starts_in: wp.array[wp.int32],
    staged_in: wp.array2d[wp.int32],
    counter_out: wp.array[wp.int32],
    room_out: wp.array2d[wp.int64],
    pairs_out: wp.array[wp.int32],
    rows_out: wp.array[wp.int32],
):
    """``counter`` is the next tile to take, ``room`` holds a worker's list twice."""
    worker = offset + wp.tid()
    tile = take(counter_out)
    while tile < tiles:
        begin = starts_in[tile]
        end = starts_in[tile + 1]
        if begin < end:
            sort_list(worker, begin, end, staged_in, room_out, pairs_out, rows_out)
        tile = take(counter_out)


def bin_many(grid: Grid, depths: Tensor, inputs: list, check: Callable[[int], None]) -> Bins:
    """As ``bin_views``, with the same lists; pairs are numbered in the order of the Gaussians.

    Args:
        grid: from ``make_grid``.
        depths: ``[I, N]``, not negative.
        inputs: flat views of means2d, conics, opacities and extents.
        check: raises if there are too many.
    """
    (images, num), workers = depths.shape, torch.get_num_threads()
    tiles, parts = grid.tiles_x * grid.tiles_y, _PARTS_PER_THREAD * workers
    tasks, groups = images * parts, images * -(-num // 16)
    order = torch.arange(images * num, out=empty([images * num], torch.int32))
    corners, windows = empty([groups, 16], torch.int32), empty([groups, 16], torch.int16)
    counts = order.new_zeros(tasks, tiles)
    totals, boxes = (order.new_empty(tasks, dtype=torch.int64) for _ in range(2))
    outputs = [corners, windows, counts, totals, boxes]
    parallel_launch(_count, tasks, [grid, parts, *inputs], outputs, pieces=tasks)
    offsets = empty([images * num + 1], torch.int32)
    by_row = counts.view(images, parts, grid.tiles_y, grid.tiles_x)
    places = place_pairs(by_row, totals, boxes, offsets, grid.tiles_x, check)
    staged = empty([places.total, 3], torch.int32)
    inputs = [grid, parts, *inputs, depths.view(-1), places.numbers, corners, windows]
    parallel_launch(_scatter, tasks, inputs, [counts, offsets, staged], pieces=tasks)
    pairs, rows = (empty([places.total], torch.int32) for _ in range(2))
    longest = int(places.starts.diff().max())
    room = totals.new_empty(workers, 2 * max(longest, 1))
    outputs = [order.new_zeros(1), room, pairs, rows]
    parallel_launch(_sort, workers, [images * tiles, places.starts, staged], outputs)
    return Bins(order, offsets, pairs, rows, places.starts, places.box_pairs, places.count)
