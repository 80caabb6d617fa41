"""Tile lists on CUDA: a sort by depth, then counting, writing, and a stable sort by tile.

The lists are as long as there are pairs, but for a CUDA graph, whose lists have a capacity: unused
entries sort behind the last tile. If it is too small, no pair is written and all lists are empty.
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
from ..skip import SQUARES, TILE_TEST
from ..tiles import Bins, Grid
from . import capacity
from . import leaves as L
from .ellipse import Ellipse, make_ellipse, tile_columns, tile_rows

wp.set_module_options({"enable_backward": False})


_KEPT = 7  # rows of tiles of a Gaussian whose columns are kept between counting and writing
_EACH = 4  # pairs of a thread of ``in_tile_order``


@wp.func
@no_type_check
def _ellipse(grid: Grid, splats_in: struct_of(Projected), i: wp.int32) -> Ellipse:
    mean = L.load_vec2(splats_in.means2d, i)
    opacity = L.load_float(splats_in.view_opacities, i)
    ellipse = make_ellipse(mean, L.load_vec3(splats_in.conics, i), opacity, grid.alpha_min)
    if (grid.skip & (TILE_TEST | SQUARES)) != TILE_TEST:
        ellipse.box = L.load_vec2(splats_in.extents, i)
    return ellipse


@wp.func
@no_type_check
def _are_kept(grid: Grid, rows: wp.vec2i) -> bool:
    # few rows, and tiles whose numbers a word has room for
    return rows[1] - rows[0] < _KEPT and wp.max(grid.tiles_x, grid.tiles_y) < 1 << 15


@wp.func
@no_type_check
def _span(tiles: wp.vec2i) -> wp.int32:
    # first and number in a word, from first and last, which is first - 1 at the least
    return tiles[0] | tiles[1] - tiles[0] + 1 << 16


@wp.kernel(grid_stride=False)
@no_type_check
def _count(
    offset: wp.int32,
    grid: Grid,
    splats_in: struct_of(Projected),
    nearest_in: wp.array[wp.int64],
    order_out: wp.array[wp.int32],
    spans_out: wp.array2d[wp.int32],
    counts_out: wp.array[wp.int64],
):
    j = offset + wp.tid()
    num = order_out.shape[0]
    i = j / grid.num * grid.num + wp.int32(L.load_long(nearest_in, j))
    L.store_int(order_out, j, i)
    extent = L.load_vec2(splats_in.extents, i)
    count = wp.int32(0)
    if extent[0] > 0.0:
        ellipse = _ellipse(grid, splats_in, i)
        rows = tile_rows(grid, ellipse)
        kept = _are_kept(grid, rows)
        at = wp.int64(j)
        L.store_word(spans_out, at, 0, wp.where(kept, _span(rows), 0))
        ty = rows[0]
        while ty <= rows[1]:
            columns = tile_columns(grid, ellipse, ty)
            count += columns[1] - columns[0] + 1
            at += wp.int64(num)
            if kept:
                L.store_word(spans_out, at, 0, _span(columns))
            ty = L.opaque(ty + 1)  # keeps the loop from being unrolled, which splits warps more
    if j == 0:
        L.store_long(counts_out, 0, wp.int64(0))  # their running sum is where each begins
    L.store_long(counts_out, j + 1, wp.int64(count))


@functools.cache
def _tile_kernels(number: Any):
    """The kernels that write and read the numbers of tiles, of this type, between the sort."""

    @wp.func_native("values.data[i] = v;")
    def store_tile(values: wp.array(dtype=number), i: wp.int32, v: number): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    @no_type_check
    def emit(
        offset: wp.int32,
        grid: Grid,
        splats_in: struct_of(Projected),
        order_in: wp.array[wp.int32],
        spans_in: wp.array2d[wp.int32],
        sums_in: wp.array[wp.int64],
        first: wp.int32,
        behind: wp.int32,
        tiles_out: wp.array(dtype=number),
        gaussians_out: wp.array[wp.int32],
        offsets_out: wp.array[wp.int32],
        count_out: wp.array[wp.int64],
    ):
        j = offset + wp.tid()
        num = order_in.shape[0]
        size = tiles_out.shape[0]
        total = L.load_long(sums_in, num)
        p = wp.int32(L.load_long(sums_in, j))
        end = wp.int32(L.load_long(sums_in, j + 1))
        if j == 0:
            count_out[0] = total
            L.store_int(offsets_out, 0, 0)
        L.store_int(offsets_out, j + 1, end)
        count = wp.int32(0)
        if total <= wp.int64(size):
            count = wp.int32(total)
            if p < end:
                i = L.load_int(order_in, j)
                at = wp.int64(j)
                span = L.load_word(spans_in, at, 0)
                kept = span != 0
                row = span & 0xFFFF
                rows = span >> 16
                ellipse = Ellipse()
                if not kept:
                    ellipse = _ellipse(grid, splats_in, i)
                    ends = tile_rows(grid, ellipse)
                    row = ends[0]
                    rows = ends[1] - row + 1
                tile = first + (i / grid.num * grid.tiles_y + row) * grid.tiles_x
                for r in range(rows):
                    at += wp.int64(num)
                    if kept:
                        span = L.load_word(spans_in, at, 0)
                        tx = tile + (span & 0xFFFF)
                        last = p + (span >> 16)
                    else:
                        ends = tile_columns(grid, ellipse, row + r)
                        tx = tile + ends[0]
                        last = p + ends[1] - ends[0] + 1
                    # no more than were counted: a compiler may round otherwise here than there
                    last = wp.min(last, end)
                    while p < last:
                        store_tile(tiles_out, p, number(tx))
                        L.store_int(gaussians_out, p, i)
                        tx += 1
                        p += 1
                    tile += grid.tiles_x
                for free in range(p, end):  # where rounding found fewer
                    store_tile(tiles_out, free, number(behind))
                    L.store_int(gaussians_out, free, i)
        place = wp.int64(count) + wp.int64(j)  # of 64 bits, as the last step may pass 2^31
        while place < wp.int64(size):
            store_tile(tiles_out, wp.int32(place), number(behind))
            place += wp.int64(num)

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    @no_type_check
    def in_tile_order(
        offset: wp.int32,
        threads: wp.int32,
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
        count = wp.int32(0)
        if count_in[0] <= wp.int64(size):
            count = wp.int32(count_in[0])
        # all loads before the stores, so that they are in flight together
        left = count - k
        row = wp.vec4i()
        g = wp.vec4i()
        for n in range(_EACH):
            if n * threads < left:
                row[n] = wp.int32(L.load_long(emitted_in, k + n * threads))
        for n in range(_EACH):
            if n * threads < left:
                g[n] = L.load_int(gaussians_in, row[n])
        for n in range(_EACH):
            if n * threads < left:
                L.store_int(rows_out, k + n * threads, row[n])
                L.store_int(pairs_out, k + n * threads, g[n])
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
