"""Colours along an object's edge, without those of its background.

A pixel of the edge mixes both: c = alpha · object + (1 - alpha) · background. If the background's
fraction stays, it is visible as a fringe on any other background, and stretched over the object's
sides. A mask that is too wide leaves a boundary of such pixels, whose alpha is too large.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ..data.preprocess import planes_of

_SOLID = 0.99  # alpha from which a pixel has the object's colour alone
_EDGE = 0.05, 0.95  # alpha of the edge's pixels
_REACH = 2  # pixels between these and solid ones
_LEAST = 20  # number of these
_FRINGE = 0.1  # least rms difference of their colours from the solid ones beside them
_UNEXPLAINED = 0.2  # largest fraction of its square that white or black may leave
_WIDTH = 128  # a boundary is this part of the image's longer side wide, at least two pixels
# The same two bounds for a boundary, and the least excess of its background over what alpha admits.
_RIM_FRINGE, _RIM_UNEXPLAINED, _EXCESS = 0.08, 0.3, 0.17


def without_matte(rgba: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Remove white or black that is mixed into the edge of an image with transparency.

    Icons and cut-outs often keep the colours that their edge had on white. A soft edge has such a
    colour if it explains the difference to the mean of the solid pixels beside; a hard one has a
    boundary of white, see ``_narrowed``.

    Args:
        rgba: ``[H, W, 4]`` in [0, 1], straight alpha.

    Returns:
        The image, and "white" or "black"; the same image and None if its edge has neither.
    """
    alpha = rgba[..., 3]
    solid = alpha > _SOLID
    near, beside = _around(rgba[..., :3], solid, _REACH)
    edge = (alpha > _EDGE[0]) & (alpha < _EDGE[1]) & (beside[0, 0].numpy() > 0)
    inner, fraction = near[0].permute(1, 2, 0).numpy()[edge], 1 - alpha[edge, None]
    added = rgba[edge, :3] - inner
    if len(inner) >= _LEAST and np.sqrt((added**2).mean()) >= _FRINGE:
        for name, color in (("white", 1.0), ("black", 0.0)):
            left = added - fraction * (color - inner)
            if (left**2).sum() < _UNEXPLAINED * (added**2).sum():
                return _unmixed(rgba, alpha, color), name
    narrow = _narrowed(rgba[..., :3], alpha, np.ones_like(rgba[..., :3]))
    return (rgba, None) if narrow is alpha else (_unmixed(rgba, narrow, 1.0), "white")


def _unmixed(rgba: np.ndarray, alpha: np.ndarray, color: float) -> np.ndarray:
    """Return an image of another alpha, without the grey value ``color`` that is mixed into it."""
    fraction = alpha[..., None]
    colors = (rgba[..., :3] - (1 - fraction) * color) / np.maximum(fraction, 1e-3)
    return np.dstack([colors.clip(0, 1), alpha]).astype(np.float32)


def without_background(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return a photograph's object ``[H, W, 4]`` without its background along the edge.

    Colours of object and of background are local means weighted by alpha (the fusion of blurs of
    Forte 2021); alpha is that of ``_narrowed``.

    Args:
        rgb: ``[H, W, 3]`` in [0, 1].
        alpha: ``[H, W]`` in [0, 1].
    """
    alpha = _narrowed(rgb, alpha)
    image, fraction = planes_of(rgb), planes_of(alpha[..., None])
    ours, theirs = local_colors(rgb, alpha, max(2, max(rgb.shape[:2]) // 64))
    colors = ours + fraction * (image - fraction * ours - (1 - fraction) * theirs)
    colors = torch.where(fraction > _SOLID, image, colors).clamp(0, 1)
    return np.dstack([colors[0].permute(1, 2, 0).numpy(), alpha])


def _narrowed(
    rgb: np.ndarray, alpha: np.ndarray, background: np.ndarray | None = None
) -> np.ndarray:
    """Return alpha, less along a boundary that has more background than alpha admits.

    Each pixel's fraction of the background is its colour's place between those of the object inside
    and of the background.

    Args:
        rgb: ``[H, W, 3]`` in [0, 1].
        alpha: ``[H, W]`` in [0, 1].
        background: ``[H, W, 3]``; None for the local mean outside the boundary.
    """
    width = max(2, max(rgb.shape[:2]) // _WIDTH)
    opacity = planes_of(alpha[..., None])
    solid = (opacity > 0.5).float()
    near, known = _around(rgb, _eroded(solid, width + 1)[0, 0].numpy(), width + 3)
    boundary = (solid > _eroded(solid, width)) & (known > 0)
    if background is None:
        outside = _eroded(1 - solid, width + 1)[0, 0].numpy()
        theirs, known = _around(rgb, outside, width + 3)
        boundary &= known > 0
    else:
        theirs = planes_of(background)
    added, full = planes_of(rgb) - near, theirs - near
    fraction = (_dot(added, full) / _dot(full, full).clamp(min=1e-3)).clamp(0, 1)
    excess = (fraction - (1 - opacity)).clamp(min=0)
    whole, left = (_dot(x, x)[boundary].double() for x in (added, added - fraction * full))
    is_mixed = (
        len(whole) >= _LEAST
        and whole.mean() > 3 * _RIM_FRINGE**2
        and left.sum() < _RIM_UNEXPLAINED * whole.sum()
        and excess[boundary].mean() > _EXCESS
    )
    return torch.where(boundary, opacity - excess, opacity)[0, 0].numpy() if is_mixed else alpha


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(1, keepdim=True)


def _eroded(mask: Tensor, width: int) -> Tensor:
    """Return a mask ``[1, 1, H, W]`` without the pixels within ``width`` of others."""
    size = 2 * width + 1
    columns = F.max_pool2d(-mask, (size, 1), 1, (width, 0))
    return -F.max_pool2d(columns, (1, size), 1, (0, width))


def local_colors(rgb: np.ndarray, alpha: np.ndarray, radius: int) -> tuple[Tensor, Tensor]:
    """Return mean colours ``[1, 3, H, W]`` of object and of background around each pixel."""
    return _around(rgb, alpha, radius)[0], _around(rgb, 1 - alpha, radius)[0]


def _around(rgb: np.ndarray, weight: np.ndarray, radius: int) -> tuple[Tensor, Tensor]:
    """Return weighted means ``[1, 3, H, W]`` around each pixel, and the mean weight there."""
    fraction, size = planes_of(weight[..., None]), 2 * radius + 1
    mean = torch.cat([planes_of(rgb) * fraction, fraction], 1)
    for kernel, pad in (((size, 1), (radius, 0)), ((1, size), (0, radius))):  # first the columns
        mean = F.avg_pool2d(mean, kernel, 1, pad)
    return mean[:, :3] / mean[:, 3:].clamp(min=1e-5), mean[:, 3:]
