"""Compositing on CUDA: launches of one warp per tile of 16 x 16 pixels, or per part of one.

Channels go in chunks of at most four: a chunk is a launch, and has its own sums for the geometry's
gradient. Sums are written per pair and reduced by Gaussian afterwards: no atomics. README.md §3 and
§5 hold the maths, CUDA.md the design.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ...runtime import gpu
from ...runtime.launch import cuda_launch
from ...runtime.views import StructValue, as_struct
from ..constants import BLOCKS
from ..tiles import CHUNK, Bins, Pixels, RasterParams, Saved, Splats2D
from . import capacity
from .kernels import WARP, Rows, backward_kernel, forward_kernel, row_sizes
from .records import Gaussians, make_records
from .reduce import reduce_rows


def parts_of_tile(tiles: int, device: torch.device) -> int:
    """Number of warps that share a tile: 1, or where tiles are few, 2 or 4.

    A few views do not fill the machine: the tile with the longest list sets the time, and its parts
    run side by side. With more views, parts would only repeat the work of a Gaussian for each warp.
    CUDA.md has the estimate behind the limits.
    """
    few = 10 * gpu.multiprocessors_of(device)
    return 4 if tiles <= few else 2 if tiles <= 2 * few else 1


def _launch(
    kernel: Callable[[int], Any],
    warps: int,
    params: RasterParams,
    records: Tensor,
    channels: int,
    inputs: list,
    outputs: list,
    block: int = 1,
    chunk: int = CHUNK,
) -> None:
    """Launches the ``kernel`` of each chunk of channels, with so many warps, some a block."""
    for first in range(0, channels if warps else 0, chunk):
        gaussians = StructValue(Gaussians, records, channels, first)
        arguments = [params, gaussians, *inputs]
        compiled, threads = kernel(min(chunk, channels - first)), WARP * block
        cuda_launch(
            compiled, (warps, WARP), arguments, outputs, device=records.device, block_dim=threads
        )


def composite_forward(
    splats: Splats2D, bins: Bins, params: RasterParams
) -> tuple[Tensor, Tensor, Saved]:
    """Blend I views, like ``composite_forward`` on the CPU.

    A ``Saved``'s pixels are in the order of the lanes, its ``stops`` are set where a pixel stopped
    only, and bit 16 + j of its ``blocks`` says that a pixel of sub-tile j stopped at the pair.
    """
    colors = splats.colors
    images, channels = splats.means2d.shape[:-2], colors.shape[1]
    tiles = images.numel() * params.tiles_x * params.tiles_y
    renders = colors.new_empty(*images, params.height, params.width, channels)
    transmittances = colors.new_empty(*images, params.height, params.width, 1)
    parts = parts_of_tile(tiles, colors.device)
    saved = Saved(
        transmittances=colors.new_empty(tiles * BLOCKS, 16),
        stops=bins.pairs.new_empty(tiles * BLOCKS, 16),
        blocks=torch.zeros_like(bins.pairs),
        traversed=bins.pairs.new_zeros(tiles),
        blocks_traversed=bins.pairs.new_zeros(tiles, dtype=torch.int64),
        records=make_records(splats, params),
    )
    _launch(
        lambda count: forward_kernel(count, parts),
        tiles * parts,
        params,
        saved.records,
        channels,
        [as_struct(bins)],
        [as_struct(saved), StructValue(Pixels, renders, transmittances)],
    )
    if capacity.is_capturing(colors.device):  # NaN where a replay has too many pairs
        short = bins.count > bins.pairs.numel()
        renders.masked_fill_(short, math.nan)
        transmittances.masked_fill_(short, math.nan)
    return renders, transmittances, saved


def composite_backward(
    splats: Splats2D,
    bins: Bins,
    params: RasterParams,
    saved: Saved,
    v_pixels: list[Tensor],
    skipped: Tensor,
    geometry: bool,
    absolute: Tensor | None = None,
    passes: bool = False,
) -> Splats2D:
    """Gradients of ``composite_forward``, like ``composite_backward`` on the CPU."""
    colors = splats.colors
    tiles, channels = saved.traversed.numel(), colors.shape[1]
    parts = parts_of_tile(tiles, colors.device)
    pairs = bins.pairs.numel()
    # a chunk without gradients does not write its part of a row that another chunk has written
    make = colors.new_empty if channels <= CHUNK else colors.new_zeros
    sums = [make(pairs, size) for size in row_sizes(channels, absolute is not None)]
    rows = StructValue(Rows, *sums, bins.pairs.new_zeros(-(-pairs // 32)), skipped)
    # a pixel's absolute gradient is of all channels: several chunks leave it to another launch
    apart = absolute is not None and channels > CHUNK
    given = (
        tiles * parts,
        params,
        saved.records,
        channels,
        [as_struct(bins), as_struct(saved), StructValue(Pixels, *v_pixels)],
        [rows],
        parts,
    )
    flags = geometry and not apart, absolute is not None, passes
    _launch(lambda count: backward_kernel(count, parts, *flags), *given)
    if apart:
        _launch(lambda _: backward_kernel(0, parts, True, True, passes), *given, channels)
    return reduce_rows(rows, splats, bins, geometry, absolute)
