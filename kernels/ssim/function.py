"""1 - SSIM and its slope: the checks, the parts of pictures that differ, and the launches."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..runtime.lanes import W
from ..runtime.launch import parallel_launch
from .kernels import EDGE, STRIP, across, back, down, up
from .reference import WINDOW

# Pictures of a launch have at most so many numbers: what lies between two launches is some ten
# times as large, and should stay in the cache.
_TOGETHER = 1 << 18


def dissimilarity(got: Tensor, want: Tensor, slope: bool) -> tuple[Tensor, Tensor | None]:
    """Computes 1 - SSIM of pictures, and its derivative by ``got`` (README).

    A picture's value depends on no other picture. Windows in which two pictures are equal, as they
    are on the background, add 0 and have no slope; what lies in no other window is left out.

    Args:
        got: ``[P, H, W, C]`` float32 on the CPU, H and W at least 11.
        want: the same shape, values in [0, 1].
        slope: whether the derivative is wanted.

    Returns:
        Values ``[P]``, means over channels and whole windows, and the slope ``[P, H, W, C]``.

    Raises:
        TypeError: another dtype than float32, or tensors that are not on the CPU.
        ValueError: the shapes differ or are too small.
    """
    for name, x in (("got", got), ("want", want)):
        if x.dtype != torch.float32 or x.device.type != "cpu":
            raise TypeError(f"{name} is {x.dtype} on {x.device}, must be torch.float32 on cpu")
        if x.ndim != 4 or x.shape != got.shape or min(x.shape[1:3]) < WINDOW:
            raise ValueError(
                f"{name} has shape {tuple(x.shape)}, must be that of got, [P, H, W, C] with H and "
                f"W >= {WINDOW}"
            )
    got, want = got.detach().contiguous(), want.detach().contiguous()
    slopes = torch.zeros_like(got) if slope else None
    size = min(len(got), max(1, _TOGETHER // max(1, got[:1].numel())))
    height, width, channels = got.shape[1:]
    most = sum(map(math.prod, _between(size, height, width, channels, slope)))
    scratch = got.new_empty(max(most, got[:size].numel()))
    values = []
    for i in range(0, len(got), max(1, size)):
        part = slice(i, i + size)
        own = None if slopes is None else slopes[part]
        values.append(_part(got[part], want[part], own, scratch))
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


def _part(got: Tensor, want: Tensor, slope: Tensor | None, scratch: Tensor) -> Tensor:
    """Values of pictures that are computed together; the slope goes into ``slope``."""
    windows = (got.shape[1] - EDGE) * (got.shape[2] - EDGE) * got.shape[3]
    # Reductions of bool are slow. A difference of float32 is 0 only between equal numbers.
    apart = torch.sub(got, want, out=scratch[: got.numel()].view(got.shape)).abs_().amax(0)
    box = _box((apart != 0).any(-1))
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


def _box(unequal: Tensor) -> tuple[slice, slice] | None:
    """The rows and columns of all windows that hold a True of ``[H, W]``; None if there is none."""
    sides = []
    for axis in (1, 0):
        places = unequal.any(axis).nonzero()[:, 0].tolist()
        if not places:
            return None
        sides.append(slice(max(0, places[0] - EDGE), places[-1] + EDGE + 1))
    return sides[0], sides[1]
