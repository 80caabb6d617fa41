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


@wp.func
def _touches(
    conic: wp.vec3,
    limit: wp.float32,
    x0: wp.float32,
    x1: wp.float32,
    y0: wp.float32,
    y1: wp.float32,
) -> bool:
    # README eq. 6: the least q = a (x + k y)² + e y² on a rectangle, on its two nearest edges
    a, k, e = conic[0], conic[1], conic[2]
    ny = wp.clamp(0.0, y0, y1)
    u = wp.clamp(-k * ny, x0, x1) + k * ny
    best = a * u * u + e * ny * ny
    nx = wp.clamp(0.0, x0, x1)
    y = wp.clamp(-nx * a * k / (a * k * k + e), y0, y1)
    u = nx + k * y
    best = wp.min(best, a * u * u + e * y * y)
    return best <= limit


@wp.func
def _tile_range(center: wp.float32, extent: wp.float32, size: wp.int32) -> wp.vec2i:
    # the tiles whose pixel centres (at +0.5) the interval can reach; clamped before the cast
    last = float(size - 1)
    first = wp.int32(wp.clamp(center - extent - 0.5, 0.0, last)) // _TILE
    return wp.vec2i(first, wp.int32(wp.clamp(center + extent + 0.5, 0.0, last)) // _TILE + 1)


@wp.kernel
def _emit(
    offset: wp.int32,
    num: wp.int32,
    width: wp.int32,
    height: wp.int32,
    tiles_x: wp.int32,
    tiles_y: wp.int32,
    alpha_min: wp.float32,
    count_only: wp.int32,
    order_in: wp.array[wp.int32],
    means2d_in: wp.array[wp.vec2],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    extents_in: wp.array[wp.vec2],
    offsets_in: wp.array[wp.int32],
    counts_out: wp.array[wp.int32],
    box_counts_out: wp.array[wp.int32],
    tiles_out: wp.array[wp.int32],
):
    """Counts the pairs of a Gaussian, or writes them: one code, so that the two agree."""
    j = offset + wp.tid()
    i = order_in[j]
    extent = extents_in[i]
    count = wp.int32(0)
    box_count = wp.int32(0)
    if extent[0] > 0.0:
        center = means2d_in[i]
        conic = conics_in[i]
        limit = 2.0 * wp.log(view_opacities_in[i] / alpha_min) * _SLACK + _SLACK_ABS
        xs = _tile_range(center[0], extent[0], width)
        ys = _tile_range(center[1], extent[1], height)
        box_count = (xs[1] - xs[0]) * (ys[1] - ys[0])
        first_tile = (i // num) * tiles_x * tiles_y
        for ty in range(ys[0], ys[1]):
            y0 = float(ty * _TILE) + 0.5 - center[1]
            y1 = float(wp.min(ty * _TILE + _TILE, height)) - 0.5 - center[1]
            for tx in range(xs[0], xs[1]):
                x0 = float(tx * _TILE) + 0.5 - center[0]
                x1 = float(wp.min(tx * _TILE + _TILE, width)) - 0.5 - center[0]
                if _touches(conic, limit, x0, x1, y0, y1):
                    if count_only == 0:
                        tiles_out[offsets_in[j] + count] = first_tile + ty * tiles_x + tx
                    count += 1
    if count_only != 0:
        counts_out[j] = count
        box_counts_out[j] = box_count


@wp.kernel
def _place(
    offset: wp.int32,
    order_in: wp.array[wp.int32],
    offsets_in: wp.array[wp.int32],
    gaussians_out: wp.array[wp.int32],
):
    """Writes each Gaussian's index at its pairs."""
    j = offset + wp.tid()
    for p in range(offsets_in[j], offsets_in[j + 1]):
        gaussians_out[p] = order_in[j]


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
    counts, box_counts = order.new_zeros(2, order.numel())
    inputs = [num, width, height, tiles_x, tiles_y, alpha_min]
    arrays = [
        order,
        vectors(means2d, wp.vec2),
        vectors(conics, wp.vec3),
        view_opacities.view(-1),
        vectors(extents, wp.vec2),
    ]
    dim = order.numel()
    launch(_emit, dim, [*inputs, 1, *arrays, None], [counts, box_counts, None], device)
    ends = counts.cumsum(0, dtype=torch.int64)
    total = int(ends[-1]) if dim else 0
    if total > MAX_PAIRS:
        raise ValueError(
            f"{total} pairs of tiles and Gaussians; at most 2^31 - 1 fit: fewer views, a smaller "
            "picture or smaller scales are needed"
        )
    offsets = torch.cat([ends.new_zeros(1), ends]).int()
    tile_of = order.new_empty(total)
    gaussians = order.new_empty(total)
    if total:
        launch(_emit, dim, [*inputs, 0, *arrays, offsets], [None, None, tile_of], device)
        launch(_place, dim, [order, offsets], [gaussians], device)
    tile_of, rows = torch.sort(tile_of, stable=True)
    starts = torch.searchsorted(
        tile_of, torch.arange(tiles + 1, dtype=torch.int32, device=device), out_int32=True
    )
    box_pairs = box_counts.sum(dtype=torch.int64)
    return Bins(order, offsets, gaussians[rows], rows.int(), starts, box_pairs)
