"""Which Gaussians each tile has to look at, front to back.

Gaussians are ordered by depth in each view, then emit one pair per tile that their ellipse touches,
then the pairs are put in tile order by a stable sort: within a tile depth order stays. README.md §2
proves the test.
"""

from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from ..constants import TILE
from .launch import launch, vectors

wp.set_module_options({"enable_backward": False})

MAX_PAIRS = 2**31 - 1  # pairs are numbered in int32

_TILE = wp.constant(TILE)
# Rounding of q, relative and absolute; the test may keep too much, never too little.
SLACK = 1.0 + 1e-4
SLACK_ABS = 1e-4
_SLACK = wp.constant(SLACK)
_SLACK_ABS = wp.constant(SLACK_ABS)


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


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles."""
    return -(-width // TILE), -(-height // TILE)


@wp.struct
class Grid:
    """Per launch: the picture and its tiles."""

    num: wp.int32
    width: wp.int32
    height: wp.int32
    tiles_x: wp.int32
    tiles_y: wp.int32
    alpha_min: wp.float32


@wp.func
def _to_tile(x: wp.float32, size: wp.int32) -> wp.int32:
    # clamped before the cast: a footprint may be larger than an int32
    return wp.int32(wp.clamp(x, 0.0, float(size - 1))) // _TILE


@wp.func
def _tile_rows(grid: Grid, y: wp.float32, extent: wp.float32) -> wp.vec2i:
    # first and last row with a pixel centre (at +0.5) in reach, with a pixel to spare
    return wp.vec2i(
        _to_tile(y - extent - 1.0, grid.height), _to_tile(y + extent + 1.0, grid.height)
    )


@wp.func
def _tile_columns(
    grid: Grid, mean: wp.vec2, conic: wp.vec3, limit: wp.float32, ty: wp.int32
) -> wp.vec2i:
    # README eq. 6: columns of row ty that the ellipse q <= limit touches; first > last: none
    a, k, e = conic[0], conic[1], conic[2]
    reach = wp.sqrt(limit / e)
    y0 = wp.max(float(ty * _TILE) + 0.5 - mean[1], -reach)
    y1 = wp.min(float(wp.min(ty * _TILE + _TILE, grid.height)) - 0.5 - mean[1], reach)
    if y0 > y1:
        return wp.vec2i(0, -1)
    # the ellipse is rightmost at y = top, leftmost at -top; convex, so clamping finds the extremes
    top = -k * a * wp.sqrt(limit / (a * (a * k * k + e) * e))
    right = wp.clamp(top, y0, y1)
    left = wp.clamp(-top, y0, y1)
    x1 = mean[0] - k * right + wp.sqrt(wp.max(limit - e * right * right, 0.0) / a)
    x0 = mean[0] - k * left - wp.sqrt(wp.max(limit - e * left * left, 0.0) / a)
    if x1 < 0.5 or x0 > float(grid.width) - 0.5:
        return wp.vec2i(0, -1)
    # a tile spans pixel centres 0.5 to 15.5; a gap between two tiles belongs to neither
    first = _to_tile(x0 + 0.5, grid.width)
    last = _to_tile(x1 - 0.5, grid.width)
    return wp.vec2i(first, last)


@wp.func
def _limit(opacity: wp.float32, alpha_min: wp.float32) -> wp.float32:
    return 2.0 * wp.log(opacity / alpha_min) * _SLACK + _SLACK_ABS


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
    box_counts_out: wp.array[wp.int32],
):
    j = offset + wp.tid()
    i = order_in[j]
    extent = extents_in[i]
    count = wp.int32(0)
    box_count = wp.int32(0)
    if extent[0] > 0.0:
        mean = means2d_in[i]
        limit = _limit(view_opacities_in[i], grid.alpha_min)
        rows = _tile_rows(grid, mean[1], extent[1])
        first = _to_tile(mean[0] - extent[0], grid.width)
        last = _to_tile(mean[0] + extent[0], grid.width)
        box_count = (rows[1] - rows[0] + 1) * (last - first + 1)
        for ty in range(rows[0], rows[1] + 1):
            columns = _tile_columns(grid, mean, conics_in[i], limit, ty)
            count += wp.max(columns[1] - columns[0] + 1, 0)
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
        mean = means2d_in[i]
        limit = _limit(view_opacities_in[i], grid.alpha_min)
        rows = _tile_rows(grid, mean[1], extent[1])
        for ty in range(rows[0], rows[1] + 1):
            columns = _tile_columns(grid, mean, conics_in[i], limit, ty)
            row = ((i // grid.num) * grid.tiles_y + ty) * grid.tiles_x
            for tx in range(columns[0], columns[1] + 1):
                tiles_out[p] = row + tx
                gaussians_out[p] = i
                p += 1


@wp.kernel
def _sort_view(
    offset: wp.int32,
    grid: Grid,
    offsets_in: wp.array[wp.int32],
    tiles_in: wp.array[wp.int32],
    gaussians_in: wp.array[wp.int32],
    starts_in: wp.array[wp.int32],
    cursors_out: wp.array[wp.int32],
    pairs_out: wp.array[wp.int32],
    rows_out: wp.array[wp.int32],
):
    """Counting sort of one view's pairs by tile: stable, for the CPU."""
    image = offset + wp.tid()
    tiles = grid.tiles_x * grid.tiles_y
    for tile in range(image * tiles, (image + 1) * tiles):
        cursors_out[tile] = starts_in[tile]
    for p in range(offsets_in[image * grid.num], offsets_in[(image + 1) * grid.num]):
        place = cursors_out[tiles_in[p]]
        cursors_out[tiles_in[p]] = place + 1
        pairs_out[place] = gaussians_in[p]
        rows_out[place] = p


def bin_gaussians(
    means2d: Tensor,
    conics: Tensor,
    depths: Tensor,
    view_opacities: Tensor,
    extents: Tensor,
    width: int,
    height: int,
    alpha_min: float,
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

    Raises:
        ValueError: there are more than 2^31 - 1 pairs, or more tiles.
    """
    device, (images, num) = depths.device, depths.shape
    tiles_x, tiles_y = tile_grid(width, height)
    tiles = images * tiles_x * tiles_y
    if max(tiles, depths.numel()) >= MAX_PAIRS:
        raise ValueError(f"{images} views of {tiles_x * tiles_y} tiles, {num} Gaussians: over 2^31")
    # stable: equal depths stay in the order of the Gaussians
    order = torch.argsort(depths, dim=1, stable=True)
    order += torch.arange(images, device=device)[:, None] * num
    order = order.view(-1).int()
    grid = Grid()
    grid.num, grid.width, grid.height = num, width, height
    grid.tiles_x, grid.tiles_y, grid.alpha_min = tiles_x, tiles_y, alpha_min
    inputs = [
        grid,
        order,
        vectors(means2d, wp.vec2),
        vectors(conics, wp.vec3),
        view_opacities.view(-1),
        vectors(extents, wp.vec2),
    ]
    counts, box_counts = order.new_empty(2, order.numel())
    launch(_count, order.numel(), inputs, [counts, box_counts], device)
    offsets = torch.nn.functional.pad(counts.cumsum(0, dtype=torch.int64), (1, 0))
    total = int(offsets[-1])
    if total > MAX_PAIRS:
        raise ValueError(
            f"{total} pairs of tiles and Gaussians; at most 2^31 - 1 fit: fewer views, a smaller "
            "picture or smaller scales are needed"
        )
    offsets = offsets.int()
    tile_of, gaussians = order.new_empty(2, total)
    if total:
        launch(_emit, order.numel(), [*inputs, offsets], [tile_of, gaussians], device)
    per_tile = torch.bincount(tile_of, minlength=tiles)
    starts = torch.nn.functional.pad(per_tile.cumsum(0), (1, 0)).int()
    if device.type == "cpu":
        pairs, rows = torch.empty_like(gaussians), torch.empty_like(gaussians)
        sort_inputs = [grid, offsets, tile_of, gaussians, starts]
        outputs = [order.new_empty(tiles), pairs, rows]
        launch(_sort_view, images if total else 0, sort_inputs, outputs, device)
    else:
        rows = torch.argsort(tile_of, stable=True)
        pairs, rows = gaussians[rows], rows.int()
    return Bins(order, offsets, pairs, rows, starts, box_counts.sum(dtype=torch.int64))
