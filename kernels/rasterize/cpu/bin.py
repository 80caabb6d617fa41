"""Tile lists on the CPU: windows of tiles, sixteen Gaussians at a time, and a radix sort.

The Gaussians of a view are cut into parts, one task each. ``count`` finds the tiles of each
Gaussian, leaves them as a window of 4 x 4 tiles, and finds how many intersections each (part, tile)
has; their running sum is where ``scatter`` writes. Views of few Gaussians are sorted by depth
before that. A sort of a million Gaussians, and every later step in that random order, would wait
for memory: large views keep their order, and each list, which fits a cache, is sorted last.
README.md §2 holds the maths, ``bin.h`` the code.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import warp as wp

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ...runtime.native import constants, native, native_kernel
from ...runtime.views import StructValue, as_struct, struct, struct_of
from ..projection import Projected
from ..skip import SQUARES, TILE_TEST
from ..tiles import SLACK, SLACK_ABS, Bins, Grid

MANY = 1 << 15  # Gaussians of a view from which sorting each list is quicker
_PARTS_PER_THREAD = 4  # more than 1, since Gaussians differ in size, and so do parts

_CONFIG = constants(
    "Config", SLACK=SLACK, SLACK_ABS=SLACK_ABS, TILE_TEST=TILE_TEST, SQUARES=SQUARES
)
_HEADER = _CONFIG + native(Path(__file__).with_name("bin.h"))


@struct
class Work:
    """Intermediate results: of groups of 16 Gaussians, and of the parts."""

    corners: wp.array[wp.int32]  # [groups * 16] first tile of each window
    windows: wp.array[wp.int16]  # [groups * 16] its bits
    counts: wp.array2d[wp.int32]  # [parts, tiles] intersections, then where the next one goes
    totals: wp.array[wp.int64]  # [parts] intersections
    numbers: wp.array[wp.int32]  # [parts] the number of the first intersection


# a task is a worker; ``counter`` is the next list, ``workspace`` holds two of a worker
_sort = native_kernel(
    "sort",
    "gamba::raster::sort",
    inputs={"count": int, "splats": struct_of(Projected), "staged": wp.array2d[wp.int32]},
    outputs={
        "counter": wp.array[wp.int32],
        "workspace": wp.array2d[wp.int64],
        "lists": struct_of(Bins),
    },
    header=_HEADER,
)
_count = native_kernel(
    "count",
    "gamba::raster::count<Config>",
    inputs={"parts": int, "grid": Grid, "splats": struct_of(Projected), "lists": struct_of(Bins)},
    outputs={"work": Work},
    header=_HEADER,
)
_offsets = native_kernel(
    "offsets",
    "gamba::raster::offsets",
    inputs={"parts": int},
    outputs={"work": Work, "lists": struct_of(Bins)},
    header=_HEADER,
)
_scatter = native_kernel(
    "scatter",
    "gamba::raster::scatter<Config>",
    inputs={"parts": int, "grid": Grid, "splats": struct_of(Projected)},
    outputs={"work": Work, "lists": struct_of(Bins), "staged": wp.array2d[wp.int32]},
    header=_HEADER,
)


def _sort_lists(
    count: int, longest: int, splats: StructValue, staged: Any, lists: StructValue
) -> None:
    workers = torch.get_num_threads()
    counter = torch.zeros(1, dtype=torch.int32)
    workspace = torch.empty(workers, 2 * max(longest, 1), dtype=torch.int64)
    parallel_launch(_sort, workers, [count, splats, staged, counter, workspace, lists])


def bin_views(grid: Grid, projected: Projected, check: Callable[[int], None]) -> Bins:
    """Make the lists; ``check`` gets the number of intersections before they are made.

    Args:
        grid: from ``make_grid``.
        projected: without status, of I views, ``[I, N, ..]``; depths are not negative.
        check: raises if there are too many.
    """
    images, num = projected.depths.shape
    tiles, most = grid.tiles_x * grid.tiles_y, _PARTS_PER_THREAD * torch.get_num_threads()
    parts = 1 if images >= most else most
    tasks, groups, by_depth = images * parts, images * -(-num // 16), num < MANY
    order, offsets = (empty([images * num + i], torch.int32) for i in range(2))
    starts = order.new_empty(images * tiles + 1)
    count = torch.empty((), dtype=torch.int64)
    splats = as_struct(projected)
    work = StructValue(
        Work,
        empty([groups * 16], torch.int32),
        empty([groups * 16], torch.int16),
        order.new_zeros(tasks, tiles),
        count.new_empty(tasks),
        order.new_empty(tasks),
    )
    if not by_depth:
        torch.arange(images * num, out=order)
    ordered = order if by_depth else None  # none: by index
    sizes = dict(offsets=offsets, starts=starts, count=count)
    lists = as_struct(Bins(order=ordered, **sizes))
    if by_depth and images:
        _sort_lists(images, num, splats, None, lists)
    parallel_launch(_count, tasks, [parts, grid, splats, lists, work], pieces=tasks)
    parallel_launch(_offsets, 1, [parts, work, lists])
    total = int(count)
    check(total)
    intersections, rows = (empty([total], torch.int32) for _ in range(2))
    bins = Bins(order=order, pairs=intersections, rows=rows, **sizes)
    lists = as_struct(bins._replace(order=ordered))
    staged = None if by_depth else empty([total, 3], torch.int32)
    parallel_launch(_scatter, tasks, [parts, grid, splats, work, lists, staged], pieces=tasks)
    if total and not by_depth:
        _sort_lists(images * tiles, int(starts.diff().max()), splats, staged, lists)
    return bins
