"""1 - SSIM by matrix products in torch, for GPUs and for other dtypes than float32.

A mean over the window along rows or columns is a product with a matrix that is zero but for a band,
so a product makes ``_TILE`` columns of it at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import pad

from .reference import C1, C2, EDGE, SIGMA, WINDOW

_TILE = 32  # columns of a banded product
_TOGETHER = 1 << 17  # numbers of the images that a CPU takes together, two of 128²


def groups(
    size: int, got: Tensor, want: Tensor, slopes: Tensor | None
) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Images that are computed together, at most ``size``, with the views of their slopes."""
    for i in range(0, len(got), size):
        part = slice(i, i + size)
        yield got[part], want[part], None if slopes is None else slopes[part]


def box_of_windows(unequal: Tensor) -> tuple[slice, slice] | None:
    """The rows and columns of all windows that hold a True of ``[H, W]``; or None."""
    sides = []
    for axis in (1, 0):
        rows = unequal.any(axis).nonzero()[:, 0].tolist()
        if not rows:
            return None
        sides.append(slice(max(0, rows[0] - EDGE), rows[-1] + EDGE + 1))
    return sides[0], sides[1]


def dissimilarity_by_products(
    got: Tensor, want: Tensor, slope: bool
) -> tuple[Tensor, Tensor | None]:
    """Computes ``dissimilarity`` of images of any floating dtype, on any device.

    Args:
        got: ``[P, H, W, C]`` without a gradient.
        want: the same shape.
        slope: True to compute the derivative.

    Returns:
        Values ``[P]`` and the slope ``[P, H, W, C]`` or None.
    """
    got, want = (x.movedim(-1, 1).contiguous() for x in (got, want))
    band = _band(got)
    slopes = torch.zeros_like(got) if slope else None
    size = max(1, len(got))
    if got.device.type == "cpu":
        size = max(1, _TOGETHER // max(1, math.prod(got.shape[1:])))
    values = [_compute(*group, band) for group in groups(size, got, want, slopes)]
    slopes = None if slopes is None else slopes.movedim(1, -1)
    return torch.cat(values) if values else got.new_zeros(0), slopes


def _compute(got: Tensor, want: Tensor, slope: Tensor | None, band: Tensor) -> Tensor:
    """Values ``[n]`` of ``[n, C, H, W]``; the derivative goes into ``slope``, if that is given."""
    count = got.shape[1] * (got.shape[2] - EDGE) * (got.shape[3] - EDGE)
    if got.device.type == "cpu":
        box = box_of_windows((got != want).flatten(0, 1).any(0))
        if box is None:
            return got.new_zeros(len(got))
        got, want = got[..., box[0], box[1]], want[..., box[0], box[1]]
        slope = None if slope is None else slope[..., box[0], box[1]]
    # The variances do not depend on a constant. Without the background, which a corner has as a
    # rule, flat regions' values are not differences of large numbers.
    shift = 2 * want[..., :1, :1]
    maps = got.new_empty(4, *got.shape)
    torch.sub(torch.add(got, want, out=maps[0]), shift, out=maps[0])
    torch.sub(got, want, out=maps[1])
    torch.mul(maps[:2], maps[:2], out=maps[2:])
    means = _window_means(maps, band)
    s, d = means[0] + shift, means[1]
    variances = means[2:] - means[:2].square()
    bright, dark = s.square() + C1 * 2, d.square()
    rough, odd = variances[0] + C2 * 2, variances[1]
    light, shape = (bright - dark) / (bright + dark), (rough - odd) / (rough + odd)
    if slope is not None:
        # of the value by the means of s and d together, of s², and of d²
        by = torch.empty_like(means[:3])
        factor = light * (-2 / count) / (rough + odd).square()
        torch.mul(factor, odd, out=by[1])
        torch.mul(factor, -rough, out=by[2])
        factor = shape * (-4 / count) / (bright + dark).square()
        by[0] = factor * (dark * s - bright * d) - 2 * (by[1] * means[0] + by[2] * d)
        # the window is symmetric, so its transpose is itself, padded
        back = _window_means(pad(by, (EDGE,) * 4), band)
        slope.copy_(back[0] + 2 * (maps[0] * back[1] + maps[1] * back[2]))
    return (1 - light * shape).sum((1, 2, 3)) / count


def _band(like: Tensor) -> Tensor:
    """SSIM's Gaussian window as the band of a matrix: ``[_TILE + 10, _TILE]``."""
    rows = torch.arange(_TILE + EDGE, device=like.device)  # no copy from the host
    offsets = (rows[:, None] - rows[:_TILE]).double()
    weights = torch.exp(-(offsets - WINDOW // 2).square() / (2 * SIGMA**2))
    weights = torch.where((offsets >= 0) & (offsets < WINDOW), weights, 0.0)
    return (weights / weights[:WINDOW, 0].sum()).to(like.dtype)


def _window_means(maps: Tensor, band: Tensor) -> Tensor:
    """Means over SSIM's window, ``[.., H, W]`` to ``[.., H - 10, W - 10]``."""
    lead = maps.shape[:-2]
    planes = maps.reshape(-1, *maps.shape[-2:])
    for axis in (2, 1):
        total = planes.shape[axis] - EDGE
        parts = []
        for start in range(0, total, _TILE):
            size = min(_TILE, total - start)
            piece, tile = planes.narrow(axis, start, size + EDGE), band[: size + EDGE, :size]
            parts.append(piece @ tile if axis == 2 else tile.mT @ piece)
        planes = torch.cat(parts, axis)
    return planes.unflatten(0, lead)
