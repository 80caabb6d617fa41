"""Tile lists of views of many Gaussians on the CPU: written in the order of index, then sorted.

A sort of a million Gaussians by depth, and every later step in that random order, wait for memory.
Here each step but the last goes through the Gaussians as they lie, sixteen at a time: ``_count``
finds how many pairs each tile has, ``_scatter`` finds the tiles once more, which is quicker than to
remember them, and writes the pairs to the lists. ``_sort`` puts each list, which fits the nearest
cache, in order of depth. README.md §2 holds the maths.
"""

from collections.abc import Callable
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ..skip import TILE_TEST
from ..tiles import Bins, Grid
from .lanes import take
from .lists import count_part, scatter_part, sort_list

wp.set_module_options({"enable_backward": False})

_TILE_TEST = wp.constant(TILE_TEST)
MANY = 1 << 15  # Gaussians of a view from which these lists are the faster ones
_PARTS_PER_THREAD = 4


@wp.func
@no_type_check
def _begin(num: wp.int32, parts: wp.int32, task: wp.int32) -> wp.int32:
    # where the Gaussians of a task begin; num * part may not fit an int32
    part = wp.int64(num) * wp.int64(task % parts) / wp.int64(parts)
    return task // parts * num + wp.int32(part)


@wp.func
@no_type_check
def _end(num: wp.int32, parts: wp.int32, task: wp.int32) -> wp.int32:
    part = wp.int64(num) * wp.int64(task % parts + 1) / wp.int64(parts)
    return task // parts * num + wp.int32(part)


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
    steps_out: wp.array2d[wp.int32],
    totals_out: wp.array2d[wp.int64],
):
    """Tasks are parts of the Gaussians of a view; totals are pairs, and pairs of boxes."""
    task = offset + wp.tid()
    count_part(
        task,
        _begin(grid.num, parts, task),
        _end(grid.num, parts, task),
        grid.width,
        grid.height,
        grid.tiles_x,
        grid.shift,
        grid.skip & _TILE_TEST,
        grid.alpha_min,
        means2d_in,
        conics_in,
        view_opacities_in,
        extents_in,
        steps_out,
        totals_out,
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
    cursors_out: wp.array2d[wp.int32],
    offsets_out: wp.array[wp.int32],
    staged_out: wp.array2d[wp.int32],
):
    """Cursors hold, at first, the place of the first pair of each (task, tile)."""
    task = offset + wp.tid()
    scatter_part(
        task,
        _begin(grid.num, parts, task),
        _end(grid.num, parts, task),
        numbers_in[task],
        grid.width,
        grid.height,
        grid.tiles_x,
        grid.shift,
        grid.skip & _TILE_TEST,
        grid.alpha_min,
        means2d_in,
        conics_in,
        view_opacities_in,
        extents_in,
        depths_in,
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
    (images, num), tiles, workers = (
        depths.shape,
        grid.tiles_x * grid.tiles_y,
        torch.get_num_threads(),
    )
    parts = _PARTS_PER_THREAD * workers
    tasks = images * parts
    order = torch.arange(images * num, dtype=torch.int32)
    steps = order.new_zeros(tasks, grid.tiles_y * (grid.tiles_x + 1))
    totals = order.new_empty(tasks, 2, dtype=torch.int64)
    parallel_launch(_count, tasks, [grid, parts, *inputs], [steps, totals], pieces=tasks)
    ends = totals[:, 0].cumsum(0)
    total = int(ends[-1])
    check(total)
    numbers = torch.nn.functional.pad(ends, (1, 0)).int()
    # running sums in the order of the pairs: view, tile, part
    in_tiles = steps.view(images, parts, grid.tiles_y, -1).cumsum(3, dtype=torch.int32)
    in_tiles = in_tiles[..., :-1].reshape(images, parts, tiles)
    begins = in_tiles.transpose(1, 2).reshape(-1).cumsum(0).int()
    begins = torch.nn.functional.pad(begins, (1, 0))
    starts = begins[::parts].clone()  # the cursors, which are changed, share the memory
    cursors = begins[:-1].view(images, tiles, parts).transpose(1, 2).contiguous().flatten(0, 1)
    offsets = order.new_empty(images * num + 1)
    offsets[-1] = total
    staged = empty([total, 3], torch.int32)
    inputs = [grid, parts, *inputs, depths.view(-1), numbers[:-1]]
    parallel_launch(_scatter, tasks, inputs, [cursors, offsets, staged], pieces=tasks)
    pairs, rows = (empty([total], torch.int32) for _ in range(2))
    longest = int(starts.diff().max())
    room = totals.new_empty(workers, 2 * max(longest, 1))
    outputs = [order.new_zeros(1), room, pairs, rows]
    parallel_launch(_sort, workers, [images * tiles, starts, staged], outputs)
    return Bins(order, offsets, pairs, rows, starts, totals[:, 1].sum(), torch.tensor(total))
