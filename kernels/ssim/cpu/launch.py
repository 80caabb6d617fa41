"""1 - SSIM on a CPU: the parts of pictures that differ, and the launches of ``kernels.py``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...runtime.lanes import W
from ...runtime.launch import parallel_launch
from ..constants import EDGE
from ..parts import box_of_windows, groups
from .kernels import STRIP, across, back, down, up

# Pictures of a launch have at most so many numbers: what lies between two launches is some ten
# times as large, and should stay in the cache.
_TOGETHER = 1 << 18


def dissimilarity_on_lanes(got: Tensor, want: Tensor, slope: bool) -> tuple[Tensor, Tensor | None]:
    """Computes ``dissimilarity`` of float32 pictures on the CPU.

    Args:
        got: ``[P, H, W, C]`` without a gradient.
        want: the same shape.
        slope: whether the derivative is wanted.

    Returns:
        Values ``[P]`` and the slope ``[P, H, W, C]`` or None.
    """
    got, want = got.contiguous(), want.contiguous()
    slopes = torch.zeros_like(got) if slope else None
    size = max(1, min(len(got), _TOGETHER // max(1, got[:1].numel())))
    height, width, channels = got.shape[1:]
    most = sum(map(math.prod, _between(size, height, width, channels, slope)))
    scratch = got.new_empty(max(most, got[:size].numel()))
    values = [_compute(*group, scratch) for group in groups(size, got, want, slopes)]
    return torch.cat(values) if values else got.new_zeros(0), slopes


def _between(
    count: int, height: int, width: int, channels: int, slope: bool
) -> list[tuple[int, int, int]]:
    """The shapes of what lies between the launches: ``hor``, ``values``, ``by`` and ``col``."""
    rows, inner = height - EDGE, (width - EDGE) * channels
    shapes = [(count, 4 * height, inner), (count, -(-rows // STRIP), inner)]
    if not slope:
        return [*shapes, (count, 0, inner), (count, 0, inner)]
    return [*shapes, (count, 3 * rows, inner), (count, 3 * height, inner + 2 * EDGE * channels)]


def _compute(got: Tensor, want: Tensor, slope: Tensor | None, scratch: Tensor) -> Tensor:
    """Values ``[n]`` of pictures that are computed together; the slope goes into ``slope``."""
    windows = (got.shape[1] - EDGE) * (got.shape[2] - EDGE) * got.shape[3]
    # Reductions of bool are slow. A difference of float32 is 0 only between equal numbers.
    apart = torch.sub(got, want, out=scratch[: got.numel()].view(got.shape)).abs_().amax(0)
    box = box_of_windows((apart != 0).any(-1))
    if box is None:
        return got.new_zeros(len(got))
    got, want = got[:, box[0], box[1]], want[:, box[0], box[1]]
    count, height, width, channels = got.shape
    shapes = _between(count, height, width, channels, slope is not None)
    sizes = [math.prod(shape) for shape in shapes]
    pieces = scratch[: sum(sizes)].split(sizes)
    hor, values, by, col = (x.view(shape) for x, shape in zip(pieces, shapes))
    # Twice the corner's colour, for every pixel of a row.
    shift = (2 * want[:, :1, :1]).repeat(1, 1, width, 1).flatten(2)
    rows, edge, a, b = height - EDGE, EDGE * channels, _rows(got), _rows(want)
    groups = -(-hor.shape[2] // W)
    parallel_launch(across, (count * height, groups), [channels, a, b, shift], [hor])
    given = [rows, 1 / windows, hor, shift]
    parallel_launch(down, (count * values.shape[1], groups), given, [by, values])
    if slope is not None:
        col[..., :edge] = col[..., -edge:] = 0
        parallel_launch(up, (count * height, groups), [rows, edge, by], [col])
        groups = -(-a.shape[2] // W)
        given = [channels, a, b, shift, col]
        parallel_launch(back, (count * height, groups), given, [_rows(slope[:, box[0], box[1]])])
    return values.sum((1, 2)) / windows


def _rows(pictures: Tensor) -> Tensor:
    """``[P, H, W, C]``, whose rows are dense, as ``[P, H, W · C]`` without a copy."""
    count, height, width, channels = pictures.shape
    strides = (*pictures.stride()[:2], 1)
    return pictures.as_strided((count, height, width * channels), strides)
