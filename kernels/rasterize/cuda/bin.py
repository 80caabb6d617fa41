"""Tile lists on CUDA: a sort by depth, then counting, writing, and a stable sort by tile.

The lists have a capacity above the number of pairs, so that nothing waits for the count; unused
entries sort behind the last tile. If the capacity is too small, no pair is written and all lists
are empty: then ``composite_unlisted`` makes the pictures.
"""

import functools
from collections.abc import Callable
from typing import Any, no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.views import as_struct, struct_of
from ..projection import Projected
from ..skip import TILE_TEST
from ..tiles import Bins, Grid, box_pairs, make_ellipse, q_limit, tile_columns, tile_rows
from . import capacity
from . import leaves as L

wp.set_module_options({"enable_backward": False})


@wp.kernel
@no_type_check
def _count(
    offset: wp.int32,
    grid: Grid,
    splats_in: struct_of(Projected),
    nearest_in: wp.array[wp.int64],
    order_out: wp.array[wp.int32],
    counts_out: wp.array[wp.int32],
    totals_out: wp.array2d[wp.int64],
):
    j = offset + wp.tid()
    i = j / grid.num * grid.num + wp.int32(nearest_in[j])
    order_out[j] = i
    extent = splats_in.extents[i]
    count = wp.int32(0)
    box_count = wp.int64(0)
    if extent[0] > 0.0:
        limit = q_limit(splats_in.view_opacities[i], grid.alpha_min)
        ellipse = make_ellipse(splats_in.means2d[i], splats_in.conics[i], limit)
        rows = tile_rows(grid, ellipse.mean[1], extent[1])
        for ty in range(rows[0], rows[1] + 1):
            columns = tile_columns(grid, ellipse, extent, ty)
            count += wp.max(columns[1] - columns[0] + 1, 0)
        box_count = box_pairs(grid, ellipse.mean, extent)
    if j == 0:
        counts_out[0] = 0  # so that their running sum says where each begins
    counts_out[j + 1] = count
    totals_out[0, j] = wp.int64(count)
    totals_out[1, j] = box_count


@functools.cache
def _tile_kernels(number: Any):
    """The kernels that write and read the numbers of tiles, of this type, between the sort."""

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def emit(
        offset: wp.int32,
        grid: Grid,
        splats_in: struct_of(Projected),
        order_in: wp.array[wp.int32],
        offsets_in: wp.array[wp.int32],
        count_in: wp.array[wp.int64],
        first: wp.int32,
        behind: wp.int32,
        tiles_out: wp.array(dtype=number),
        gaussians_out: wp.array[wp.int32],
    ):
        j = offset + wp.tid()
        size = tiles_out.shape[0]
        if j < size and (wp.int64(j) >= count_in[0] or count_in[0] > wp.int64(size)):
            tiles_out[j] = number(behind)
        if j < order_in.shape[0] and count_in[0] <= wp.int64(size):
            i = order_in[j]
            p = offsets_in[j]
            end = offsets_in[j + 1]
            extent = splats_in.extents[i]
            if extent[0] > 0.0:
                limit = q_limit(splats_in.view_opacities[i], grid.alpha_min)
                ellipse = make_ellipse(splats_in.means2d[i], splats_in.conics[i], limit)
                rows = tile_rows(grid, ellipse.mean[1], extent[1])
                for ty in range(rows[0], rows[1] + 1):
                    columns = tile_columns(grid, ellipse, extent, ty)
                    row = ((i // grid.num) * grid.tiles_y + ty) * grid.tiles_x
                    # no more than were counted: a compiler may round otherwise here than there
                    last = wp.min(columns[1], columns[0] + end - p - 1)
                    for tx in range(columns[0], last + 1):
                        tiles_out[p] = number(first + row + tx)
                        L.store_int(gaussians_out, p, i)
                        p += 1
            for free in range(p, end):  # where rounding found fewer
                tiles_out[free] = number(behind)
                L.store_int(gaussians_out, free, i)

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def in_tile_order(
        offset: wp.int32,
        tiles_in: wp.array(dtype=number),
        emitted_in: wp.array[wp.int64],
        gaussians_in: wp.array[wp.int32],
        count_in: wp.array[wp.int64],
        first: wp.int32,
        pairs_out: wp.array[wp.int32],
        rows_out: wp.array[wp.int32],
        starts_out: wp.array[wp.int32],
    ):
        k = offset + wp.tid()
        size = tiles_in.shape[0]
        if k < size:
            row = wp.int32(emitted_in[k])
            g = wp.int32(0)
            if wp.int64(k) < count_in[0] and count_in[0] <= wp.int64(size):
                g = gaussians_in[row]
            rows_out[k] = row
            pairs_out[k] = g
        if k < starts_out.shape[0]:
            # the first pair whose tile is k or later
            low = wp.int32(0)
            high = size
            while low < high:
                middle = low + (high - low) / 2
                if wp.int32(tiles_in[middle]) < first + k:
                    low = middle + 1
                else:
                    high = middle
            starts_out[k] = low

    return emit, in_tile_order


def bin_views(
    grid: Grid, projected: Projected, check: Callable[[int], None], exact: bool = False
) -> Bins:
    """As ``bin_views`` of the CPU, but the lists may have a capacity above the number of pairs.

    Args:
        grid: from ``make_grid``.
        projected: as the CPU's.
        check: raises if there are too many; it is called only where the number is read back.
        exact: True to read the number of pairs back and to make the lists as long.
    """
    depths = projected.depths
    device, images = depths.device, len(depths)
    # stable: equal depths stay in the order of the Gaussians
    nearest = torch.argsort(depths, dim=1, stable=True)
    num = depths.numel()
    order = torch.empty(num, dtype=torch.int32, device=device)
    make = torch.empty if num else torch.zeros
    counts = make(num + 1, dtype=torch.int32, device=device)
    totals = torch.empty(2, num, dtype=torch.int64, device=device)
    splats = as_struct(projected)
    launch(_count, num, [grid, splats, nearest.view(-1)], [order, counts, totals], device)
    offsets = counts.cumsum(0, dtype=torch.int32)
    totals = totals.sum(1)
    count = totals[:1]
    size = _list_capacity(grid, depths, count, check, exact)
    tiles = images * grid.tiles_x * grid.tiles_y
    # a sort of 16 bits takes half as long as one of 32
    short = tiles < 1 << 16
    first, dtype = (-(1 << 15), torch.int16) if short else (0, torch.int32)
    emit, in_tile_order = _tile_kernels(wp.int16 if short else wp.int32)
    tile_of, gaussians = order.new_empty(size, dtype=dtype), order.new_empty(size)
    # free places have the number behind the last tile's, so that they come last
    inputs = [grid, splats, order, offsets, count, first, first + tiles]
    launch(emit, max(num, size) if size else 0, inputs, [tile_of, gaussians], device)
    sorted_tiles, emitted = torch.sort(tile_of, stable=True)
    pairs, rows, starts = order.new_empty(size), order.new_empty(size), order.new_empty(tiles + 1)
    inputs = [sorted_tiles, emitted, gaussians, count, first]
    launch(in_tile_order, max(size, tiles + 1), inputs, [pairs, rows, starts], device)
    return Bins(order, offsets, pairs, rows, starts, box_pairs=totals[1].clone(), count=totals[0])


def _list_capacity(
    grid: Grid, depths: Tensor, count: Tensor, check: Callable[[int], None], exact: bool
) -> int:
    """Return the lists' capacity; waits for the device if ``exact`` or if the shape is new."""
    device, (images, num) = depths.device, depths.shape
    # similar numbers of Gaussians share a capacity: some models change theirs in each call
    shape = images, capacity.rounded_up(num), grid.width, grid.height, grid.shift
    key = (*shape, grid.skip & TILE_TEST)
    known = None if exact else capacity.find(key, device)
    capturing = capacity.is_capturing(device)
    if known is None:
        if capturing:
            raise RuntimeError(
                "a CUDA graph cannot begin with shapes that were never rendered: run the same "
                "call once before the capture, as torch asks for all that it captures"
            )
        total = int(count)
        check(total)
        if exact:
            return total
        known = capacity.add_shape(key, device, total)
    pairs = max(known.pairs, depths.numel())
    if capturing:
        capacity.add_graph(known, pairs)
    capacity.add_count(known, count)
    return pairs
