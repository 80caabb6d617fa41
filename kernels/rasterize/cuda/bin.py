"""Tile lists on CUDA: a sort by depth, then counting, writing, and a stable sort by tile.

The lists are as long as there are pairs, but for a CUDA graph, whose lists have a capacity: unused
entries sort behind the last tile. If it is too small, no pair is written and all lists are empty.
README.md §2 holds the maths, ``bin.h`` the code.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.native import constants, native, native_kernel
from ...runtime.views import as_struct, struct_of
from ..projection import Projected
from ..skip import SQUARES, TILE_TEST
from ..tiles import SLACK, SLACK_ABS, Bins, Grid
from . import capacity

_KEPT = 7  # rows of tiles of a Gaussian whose columns are kept between counting and writing
_EACH = 4  # pairs of a thread of ``in_tile_order``

_CONFIG = constants(
    "Config",
    **{"SLACK": SLACK, "SLACK_ABS": SLACK_ABS, "TILE_TEST": TILE_TEST, "SQUARES": SQUARES},
    **{"KEPT": _KEPT, "EACH": _EACH},
)
_HEADER = _CONFIG + native(Path(__file__).with_name("bin.h"))
_OPTIONS: dict[str, Any] = {"header": _HEADER, "grouped": True, "grid_stride": False}
_INTS, _LONGS = wp.array[wp.int32], wp.array[wp.int64]

_count = native_kernel(
    "count",
    "gamba::raster::count<Config>",
    inputs={"grid": Grid, "splats_in": struct_of(Projected), "nearest_in": _LONGS},
    outputs={"order_out": _INTS, "spans_out": wp.array2d[wp.int32], "counts_out": _LONGS},
    **_OPTIONS,
)


@functools.cache
def _tile_kernels(number: Any) -> tuple[Any, Any]:
    """The kernels that write and read the numbers of tiles, of this type, between the sort."""
    tiles = wp.array(dtype=number)
    emit = native_kernel(
        "emit",
        "gamba::raster::emit<Config>",
        inputs={
            **{"grid": Grid, "splats_in": struct_of(Projected), "order_in": _INTS},
            **{"spans_in": wp.array2d[wp.int32], "sums_in": _LONGS, "first": int, "behind": int},
        },
        outputs={
            **{"tiles_out": tiles, "gaussians_out": _INTS},
            **{"offsets_out": _INTS, "count_out": _LONGS},
        },
        **_OPTIONS,
    )
    in_tile_order = native_kernel(
        "in_tile_order",
        "gamba::raster::in_tile_order<Config>",
        inputs={
            **{"threads": int, "tiles_in": tiles, "emitted_in": _LONGS, "gaussians_in": _INTS},
            **{"count_in": _LONGS, "first": int},
        },
        outputs={"pairs_out": _INTS, "rows_out": _INTS, "starts_out": _INTS},
        **_OPTIONS,
    )
    return emit, in_tile_order


def bin_views(grid: Grid, projected: Projected, check: Callable[[int], None]) -> Bins:
    """Make the lists as on the CPU; in a CUDA graph they may be longer or too short.

    Args:
        grid: from ``make_grid``.
        projected: as the CPU's.
        check: raises if there are too many pairs.
    """
    depths = projected.depths
    device, images = depths.device, len(depths)
    # stable: equal depths stay in the order of the Gaussians
    nearest = torch.argsort(depths, dim=1, stable=True)
    num = depths.numel()
    order = torch.empty(num, dtype=torch.int32, device=device)
    make = torch.empty if num else torch.zeros
    counts = make(num + 1, dtype=torch.int64, device=device)
    # holds [1 + _KEPT, num] words of ``_span``; Warp has no strides of 2^31 bytes
    spans = order.new_empty(num, 1 + _KEPT)
    splats = as_struct(projected)
    inputs = [grid, splats, nearest.view(-1)]
    launch(_count, num, inputs, [order, spans, counts], device)
    sums = counts.cumsum(0)
    size = _list_size(grid, depths, sums[-1:], check)
    tiles = images * grid.tiles_x * grid.tiles_y
    # a sort of 16 bits takes half as long as one of 32
    short = tiles < 1 << 16
    first, dtype = (-(1 << 15), torch.int16) if short else (0, torch.int32)
    emit, in_tile_order = _tile_kernels(wp.int16 if short else wp.int32)
    tile_of, gaussians = order.new_empty(size, dtype=dtype), order.new_empty(size)
    offsets = make(num + 1, dtype=torch.int32, device=device)
    count = make(1, dtype=torch.int64, device=device)
    # free places have the number behind the last tile's, so that they come last
    inputs = [grid, splats, order, spans, sums, first, first + tiles]
    launch(emit, num, inputs, [tile_of, gaussians, offsets, count], device)
    sorted_tiles, emitted = torch.sort(tile_of, stable=True)
    pairs, rows, starts = order.new_empty(size), order.new_empty(size), order.new_empty(tiles + 1)
    threads = max(-(-size // _EACH), tiles + 1)
    inputs = [threads, sorted_tiles, emitted, gaussians, count, first]
    launch(in_tile_order, threads, inputs, [pairs, rows, starts], device)
    return Bins(order, offsets, pairs, rows, starts, count.view(()))


def _list_size(grid: Grid, depths: Tensor, count: Tensor, check: Callable[[int], None]) -> int:
    """Return the length of the lists: the number of pairs, for which this waits, or a capacity."""
    key = *depths.shape, grid.width, grid.height, grid.skip & (TILE_TEST | SQUARES)
    if capacity.is_capturing(depths.device):
        return capacity.graph_capacity(key, count)
    total = int(count)
    check(total)
    capacity.note_count(key, depths.device, total)
    return total
