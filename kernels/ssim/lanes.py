"""1 - SSIM of float32 images on a CPU: sizes and launches of the kernels of ``ssim_cpu.h``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..runtime.launch import parallel_launch
from ..runtime.native import native, native_kernel
from ..runtime.views import StructValue, struct
from .products import box_of_windows, groups
from .reference import EDGE

_LANES = 16
_STRIP = 8  # rows of windows of a task, whose values are summed before they are stored
# Largest size of a launch's images, in numbers: data between two launches is some ten
# times as large, and should stay in the cache.
_TOGETHER = 1 << 18


@struct
class Maps:
    """Images and the data between the launches; without a slope the last three are empty."""

    channels: int
    scale: float  # 1 / windows of an image, all channels
    got: wp.array3d[wp.float32]
    want: wp.array3d[wp.float32]
    shift: wp.array3d[wp.float32]  # [P, 1, E], subtracted from the sums
    hor: wp.array3d[wp.float32]
    values: wp.array3d[wp.float32]
    by: wp.array3d[wp.float32]
    col: wp.array3d[wp.float32]
    slope: wp.array3d[wp.float32]


def _kernel(function: str) -> Any:
    """The kernel of a function: a task per row, or strip of rows, and sixteen numbers of it."""
    header = native(Path(__file__).with_name("ssim_cpu.h"))
    name, call = f"ssim_{function.partition('<')[0]}", f"gamba::ssim::{function}"
    return native_kernel(name, call, {}, {"maps": Maps}, header, "task, group")


_across, _down, _up, _back = map(_kernel, ("across", f"down<{_STRIP}>", "up", "back"))


def dissimilarity_on_lanes(got: Tensor, want: Tensor, slope: bool) -> tuple[Tensor, Tensor | None]:
    """Computes ``dissimilarity`` of float32 images on the CPU.

    Args:
        got: ``[P, H, W, C]`` without a gradient.
        want: the same shape.
        slope: True to compute the derivative.

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
    """Shapes of the data between launches: ``hor, values``, and for a slope ``by, col``."""
    rows, inner = height - EDGE, (width - EDGE) * channels
    shapes = [(count, 4 * height, inner), (count, -(-rows // _STRIP), inner)]
    if not slope:
        return shapes
    return [*shapes, (count, 3 * rows, inner), (count, 3 * height, inner + 2 * EDGE * channels)]


def _compute(got: Tensor, want: Tensor, slope: Tensor | None, scratch: Tensor) -> Tensor:
    """Values ``[n]`` of images that are computed together; the slope goes into ``slope``."""
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
    hor, values, *between = (x.view(shape) for x, shape in zip(pieces, shapes))
    # Twice the corner's colour, for every pixel of a row.
    shift = (2 * want[:, :1, :1]).repeat(1, 1, width, 1).flatten(2)
    by, col, out = (None,) * 3 if slope is None else (*between, _rows(slope[:, box[0], box[1]]))
    a, b = _rows(got), _rows(want)
    maps = StructValue(Maps, channels, 1 / windows, a, b, shift, hor, values, by, col, out)
    inner, outer = (-(-x.shape[2] // _LANES) for x in (hor, a))
    parallel_launch(_across, (count * height, inner), [maps])
    parallel_launch(_down, (count * values.shape[1], inner), [maps])
    if col is not None:
        edge = EDGE * channels
        col[..., :edge] = col[..., -edge:] = 0
        parallel_launch(_up, (count * height, inner), [maps])
        parallel_launch(_back, (count * height, outer), [maps])
    return values.sum((1, 2)) / windows


def _rows(images: Tensor) -> Tensor:
    """``[P, H, W, C]``, whose rows are dense, as ``[P, H, W · C]`` without a copy."""
    count, height, width, channels = images.shape
    strides = (*images.stride()[:2], 1)
    return images.as_strided((count, height, width * channels), strides)
