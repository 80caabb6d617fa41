"""Compositing on CUDA: launches of one warp per tile of 16 x 16 pixels.

Channels go in chunks of at most four: a chunk is a launch, and the geometry's gradients of chunks
add up. Sums are written per pair and reduced by Gaussian afterwards: no atomics. README.md §3 and
§5 hold the maths, CUDA.md the design.
"""

import torch
import warp as wp
from torch import Tensor

from ..interop import cuda_launch
from .bin import Bins
from .composite_cuda_backward import backward_kernel
from .composite_cuda_forward import forward_kernel
from .composite_cuda_warp import CHUNK, WARP
from .frame import Frame, Walk
from .launch import vectors


def _chunks(channels: int) -> list[tuple[int, int]]:
    """First channel and number of channels of each launch."""
    return [(first, min(CHUNK, channels - first)) for first in range(0, channels, CHUNK)]


def composite_forward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    frame: Frame,
) -> tuple[Tensor, Tensor, Walk]:
    """As ``composite_cpu.composite_forward``.

    A ``Walk``'s pixels are in the order of the lanes, its ``stops`` are set where a pixel stopped
    only, and bit 16 + j of its ``blocks`` says that a pixel of sub-tile j stopped at the pair.
    """
    images, channels = means2d.shape[0], colors.shape[1]
    tiles = images * frame.tiles_x * frame.tiles_y
    renders = colors.new_empty(images, frame.height, frame.width, channels)
    alphas = colors.new_empty(images, frame.height, frame.width, 1)
    walk = Walk(
        colors.new_empty(tiles * 16, 16),
        bins.pairs.new_empty(tiles * 16, 16),
        torch.zeros_like(bins.pairs),
        bins.pairs.new_empty(tiles),
    )
    for first, count in _chunks(channels) if tiles else ():
        cuda_launch(
            forward_kernel(count),
            (tiles, WARP),
            [
                frame,
                first,
                vectors(means2d, wp.vec2),
                vectors(conics, wp.vec3),
                view_opacities.view(-1),
                colors,
                bins.pairs,
                bins.starts,
            ],
            [
                walk.transmittances.view(tiles, -1),
                walk.stops.view(tiles, -1),
                walk.blocks,
                walk.walked,
                renders,
                alphas,
            ],
            device=colors.device,
            block_dim=WARP,
        )
    return renders, alphas, walk


def composite_backward(
    means2d: Tensor,
    conics: Tensor,
    view_opacities: Tensor,
    colors: Tensor,
    bins: Bins,
    frame: Frame,
    walk: Walk,
    v_renders: Tensor,
    v_alphas: Tensor,
    geometry: bool,
) -> tuple[Tensor, Tensor]:
    """As ``composite_cpu.composite_backward``."""
    tiles, channels = walk.walked.numel(), colors.shape[1]
    v_pairs = colors.new_zeros(bins.pairs.numel(), 6 + channels)
    skipped = torch.ones_like(walk.walked)
    for first, count in _chunks(channels) if tiles else ():
        cuda_launch(
            backward_kernel(count, geometry),
            (tiles, WARP),
            [
                frame,
                first,
                vectors(means2d, wp.vec2),
                vectors(conics, wp.vec3),
                view_opacities.view(-1),
                colors,
                bins.pairs,
                bins.rows,
                bins.starts,
                walk.transmittances.view(tiles, -1),
                walk.stops.view(tiles, -1),
                walk.blocks,
                walk.walked,
                v_renders,
                v_alphas,
            ],
            [v_pairs, skipped],
            device=colors.device,
            block_dim=WARP,
        )
    return v_pairs, skipped
