"""Which Gaussians each tile has to look at, front to back.

Gaussians are ordered by depth in each view, then emit one pair per tile that their ellipse touches,
and the pairs come in tile order, stable: within a tile depth order stays. ``bin_cpu.py`` has
the way of the CPU; here is that of CUDA.
"""

from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from . import bin_cpu
from .launch import launch, vectors
from .tiles import (
    Grid,
    box_pairs,
    make_ellipse,
    make_grid,
    q_limit,
    tile_columns,
    tile_grid,
    tile_rows,
)

wp.set_module_options({"enable_backward": False})

MAX_PAIRS = 2**31 - 1  # pairs are numbered in int32


class Bins(NamedTuple):
    """P pairs of I views; everything int32.

    Attributes:
        order: ``[I * N]`` view-major Gaussian indices, front to back within each view.
        offsets: ``[I * N + 1]`` where the pairs of ``order[j]`` begin, in emission order.
        pairs: ``[P]`` view-major Gaussian index of each pair, in tile order.
        rows: ``[P]`` emission number of each pair, in tile order.
        starts: ``[I * tiles + 1]`` where each tile begins in ``pairs``.
        box_pairs: ``[]`` int64, number of pairs if tiles were tested against boxes only.
    """

    order: Tensor
    offsets: Tensor
    pairs: Tensor
    rows: Tensor
    starts: Tensor
    box_pairs: Tensor


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
):
    j = offset + wp.tid()
    i = order_in[j]
    extent = extents_in[i]
    count = wp.int32(0)
    box_count = wp.int64(0)
    if extent[0] > 0.0:
        limit = q_limit(view_opacities_in[i], grid.alpha_min)
        ellipse = make_ellipse(means2d_in[i], conics_in[i], limit)
        rows = tile_rows(grid, ellipse.mean[1], extent[1])
        for ty in range(rows[0], rows[1] + 1):
            columns = tile_columns(grid, ellipse, extent, ty)
            count += wp.max(columns[1] - columns[0] + 1, 0)
        box_count = box_pairs(grid, ellipse.mean, extent)
    counts_out[j] = count
    box_counts_out[j] = box_count


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
    tiles_out: wp.array[wp.int32],
    gaussians_out: wp.array[wp.int32],
):
    j = offset + wp.tid()
    i = order_in[j]
    p = offsets_in[j]
    extent = extents_in[i]
    if extent[0] > 0.0:
        limit = q_limit(view_opacities_in[i], grid.alpha_min)
        ellipse = make_ellipse(means2d_in[i], conics_in[i], limit)
        rows = tile_rows(grid, ellipse.mean[1], extent[1])
        for ty in range(rows[0], rows[1] + 1):
            columns = tile_columns(grid, ellipse, extent, ty)
            row = ((i // grid.num) * grid.tiles_y + ty) * grid.tiles_x
            for tx in range(columns[0], columns[1] + 1):
                tiles_out[p] = row + tx
                gaussians_out[p] = i
                p += 1


def bin_gaussians(
    means2d: Tensor,
    conics: Tensor,
    depths: Tensor,
    view_opacities: Tensor,
    extents: Tensor,
    width: int,
    height: int,
    alpha_min: float,
    skip: int,
) -> Bins:
    """Makes the tile lists of all views; reads the number of pairs back (the one synchronisation).

    Args:
        means2d: ``[I, N, 2]``, and so on as ``project_forward`` returns them, with I = B * V.
        conics: ``[I, N, 3]``.
        depths: ``[I, N]``.
        view_opacities: ``[I, N]``.
        extents: ``[I, N, 2]``, zero where culled.
        width: pixels.
        height: pixels.
        alpha_min: what is fainter than this is not drawn.
        skip: from ``Skip.bits``.

    Raises:
        ValueError: there are more than 2^31 - 1 pairs, or more tiles.
    """
    images, num = depths.shape
    tiles_x, tiles_y = tile_grid(width, height)
    tiles = images * tiles_x * tiles_y
    if max(tiles, depths.numel()) >= MAX_PAIRS:
        raise ValueError(f"{images} views of {tiles_x * tiles_y} tiles, {num} Gaussians: over 2^31")
    grid = make_grid(num, width, height, alpha_min, skip)
    inputs = [
        vectors(means2d, wp.vec2),
        vectors(conics, wp.vec3),
        view_opacities.view(-1),
        vectors(extents, wp.vec2),
    ]
    bin_views = bin_cpu.bin_views if depths.device.type == "cpu" else _bin_views
    return Bins(*bin_views(grid, depths, inputs, _refuse_too_many))


def _refuse_too_many(pairs: int) -> None:
    if pairs > MAX_PAIRS:
        raise ValueError(
            f"{pairs} pairs of tiles and Gaussians; at most 2^31 - 1 fit: fewer views, a smaller "
            "picture or smaller scales are needed"
        )


def _bin_views(grid: Grid, depths: Tensor, inputs: list, check) -> tuple[Tensor, ...]:
    """The fields of ``Bins``; ``check`` is given the number of pairs before they are made."""
    device, (images, num) = depths.device, depths.shape
    # stable: equal depths stay in the order of the Gaussians
    order = torch.argsort(depths, dim=1, stable=True)
    order += torch.arange(images, device=device)[:, None] * num
    order = order.view(-1).int()
    counts = torch.empty_like(order)
    box_counts = torch.empty_like(order, dtype=torch.int64)
    launch(_count, order.numel(), [grid, order, *inputs], [counts, box_counts], device)
    offsets = torch.nn.functional.pad(counts.cumsum(0, dtype=torch.int64), (1, 0))
    total = int(offsets[-1])
    check(total)
    offsets = offsets.int()
    tile_of, gaussians = order.new_empty(2, total)
    if total:
        outputs = [tile_of, gaussians]
        launch(_emit, order.numel(), [grid, order, *inputs, offsets], outputs, device)
    tiles = images * grid.tiles_x * grid.tiles_y
    sorted_tiles, rows = torch.sort(tile_of, stable=True)
    # not bincount: on CUDA it reads the largest value back
    firsts = torch.arange(tiles + 1, dtype=torch.int32, device=device)
    starts = torch.searchsorted(sorted_tiles, firsts, out_int32=True)
    return order, offsets, gaussians[rows], rows.int(), starts, box_counts.sum()
