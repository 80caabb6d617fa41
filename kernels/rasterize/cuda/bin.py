"""Tile lists on CUDA: a sort by depth, then counting, writing, and a stable sort by tile.

The lists have room for more pairs than there are, so that nothing waits for the count; what is left
over sorts behind the last tile. Where the pairs have no room, none is written and all lists are
empty: then ``composite_unlisted`` makes the pictures.
"""

from collections.abc import Callable, Sequence
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.views import Packed
from ..project import Splats
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
    splats_in: Splats,
    nearest_in: wp.array[wp.int64],
    order_out: wp.array[wp.int32],
    counts_out: wp.array[wp.int32],
    box_counts_out: wp.array[wp.int64],
):
    j = offset + wp.tid()
    i = j / grid.num * grid.num + wp.int32(nearest_in[j])
    order_out[j] = i
    extent = splats_in.extents[i]
    count = wp.int32(0)
    box_count = wp.int64(0)
    if extent[0] > 0.0:
        limit = q_limit(splats_in.opacities[i], grid.alpha_min)
        ellipse = make_ellipse(splats_in.means2d[i], splats_in.conics[i], limit)
        rows = tile_rows(grid, ellipse.mean[1], extent[1])
        for ty in range(rows[0], rows[1] + 1):
            columns = tile_columns(grid, ellipse, extent, ty)
            count += wp.max(columns[1] - columns[0] + 1, 0)
        box_count = box_pairs(grid, ellipse.mean, extent)
    counts_out[j] = count
    box_counts_out[j] = box_count


@wp.kernel
@no_type_check
def _emit(
    offset: wp.int32,
    grid: Grid,
    splats_in: Splats,
    order_in: wp.array[wp.int32],
    offsets_in: wp.array[wp.int32],
    count_in: wp.array[wp.int64],
    first: wp.int32,
    tiles_out: wp.array[wp.int32],
    gaussians_out: wp.array[wp.int32],
):
    j = offset + wp.tid()
    i = order_in[j]
    p = offsets_in[j]
    end = offsets_in[j + 1]
    extent = splats_in.extents[i]
    if extent[0] > 0.0 and count_in[0] <= wp.int64(tiles_out.shape[0]):
        limit = q_limit(splats_in.opacities[i], grid.alpha_min)
        ellipse = make_ellipse(splats_in.means2d[i], splats_in.conics[i], limit)
        rows = tile_rows(grid, ellipse.mean[1], extent[1])
        for ty in range(rows[0], rows[1] + 1):
            columns = tile_columns(grid, ellipse, extent, ty)
            row = ((i // grid.num) * grid.tiles_y + ty) * grid.tiles_x
            # not one more than was counted: a compiler may round otherwise here than it did there
            last = wp.min(columns[1], columns[0] + end - p - 1)
            for tx in range(columns[0], last + 1):
                L.store_int(tiles_out, p, first + row + tx)
                L.store_int(gaussians_out, p, i)
                p += 1


@wp.kernel
@no_type_check
def _in_tile_order(
    offset: wp.int32,
    gaussians_in: wp.array[wp.int32],
    emitted_in: wp.array[wp.int64],
    pairs_out: wp.array[wp.int32],
    rows_out: wp.array[wp.int32],
):
    k = offset + wp.tid()
    row = wp.int32(emitted_in[k])
    rows_out[k] = row
    pairs_out[k] = gaussians_in[row]


def bin_views(
    grid: Grid, tensors: Sequence[Tensor], check: Callable[[int], None], exact: bool = False
) -> Bins:
    """As ``bin_views`` of the CPU, but the lists may have room for more pairs than there are.

    Args:
        grid: from ``make_grid``.
        tensors: means2d, conics, depths (not negative), opacities and extents, ``[I, N, ..]``.
        check: raises if there are too many; it is called only where the number is read back.
        exact: whether to read the number of pairs back and to make the lists as long.
    """
    depths = tensors[2]
    device, images = depths.device, len(depths)
    # stable: equal depths stay in the order of the Gaussians
    nearest = torch.argsort(depths, dim=1, stable=True)
    order = torch.empty(depths.numel(), dtype=torch.int32, device=device)
    counts = torch.empty_like(order)
    box_counts = torch.empty_like(order, dtype=torch.int64)
    splats = Packed(Splats, *tensors, None)
    found = [order, counts, box_counts]
    launch(_count, order.numel(), [grid, splats, nearest.view(-1)], found, device)
    offsets = order.new_zeros(len(order) + 1)
    torch.cumsum(counts, 0, dtype=torch.int32, out=offsets[1:])
    count = counts.sum()
    room = _room(grid, depths, count, check, exact)
    tiles = images * grid.tiles_x * grid.tiles_y
    # a sort of 16 bits takes half as long as one of 32
    first, number = (-(1 << 15), torch.int16) if tiles < 1 << 16 else (0, torch.int32)
    # what stays free has the number behind the last tile's, so that it comes last
    tile_of, gaussians = order.new_full((room,), first + tiles), order.new_zeros(room)
    inputs = [grid, splats, order, offsets, count.view(1), first]
    launch(_emit, order.numel() if room else 0, inputs, [tile_of, gaussians], device)
    sorted_tiles, emitted = torch.sort(tile_of.to(number), stable=True)
    # not bincount: on CUDA it reads the largest value back
    firsts = torch.arange(first, first + tiles + 1, dtype=number, device=device)
    starts = torch.searchsorted(sorted_tiles, firsts, out_int32=True)
    pairs, rows = torch.empty_like(gaussians), torch.empty_like(gaussians)
    launch(_in_tile_order, room, [gaussians, emitted], [pairs, rows], device)
    return Bins(order, offsets, pairs, rows, starts, box_pairs=box_counts.sum(), count=count)


def _room(
    grid: Grid, depths: Tensor, count: Tensor, check: Callable[[int], None], exact: bool
) -> int:
    """The room of the lists; without a wait, unless they are ``exact`` or nothing is known yet."""
    device, (images, num) = depths.device, depths.shape
    # calls with about as many Gaussians share their room: some models give another number each time
    shape = images, capacity.in_steps(num), grid.width, grid.height, grid.shift
    key = (*shape, grid.skip & TILE_TEST)
    room = None if exact else capacity.find(key, device)
    capturing = capacity.is_capturing(device)
    if room is None:
        if capturing:
            raise RuntimeError(
                "a CUDA graph cannot begin with shapes that were never rendered: run the same "
                "call once before the capture, as torch asks for all that it captures"
            )
        total = int(count)
        check(total)
        if exact:
            return total
        room = capacity.remember(key, device, total)
    size = max(room.capacity, depths.numel())
    if capturing:
        capacity.captured(room, size)
    capacity.tell(room, count.view(1))
    return size
