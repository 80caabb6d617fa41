"""Colours along an object's edge, without those of its background.

A pixel of the edge mixes both: c = alpha · object + (1 - alpha) · background. If the background's
share stays, it is visible as a fringe on any other background.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

_SOLID = 0.99  # alpha from which a pixel has the object's colour alone
_EDGE = 0.05, 0.95  # alpha of the edge's pixels
_REACH = 2  # pixels between these and solid ones
_LEAST = 20  # number of these
_FRINGE = 0.1  # least rms difference of their colours from the solid ones beside them
_UNEXPLAINED = 0.2  # largest share of its square that white or black may leave


def without_matte(rgba: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Remove white or black that is mixed into the edge of a picture with transparency.

    Icons and cut-outs often keep the colours that their edge had on white. The edge has such a
    colour if it explains the difference to the mean of the solid pixels beside.

    Args:
        rgba: ``[H, W, 4]`` in [0, 1], straight alpha.

    Returns:
        The picture, and "white" or "black"; the same picture and None if its edge has neither.
    """
    alpha = rgba[..., 3]
    solid = alpha > _SOLID
    near, beside = _around(rgba[..., :3], solid, _REACH)
    edge = (alpha > _EDGE[0]) & (alpha < _EDGE[1]) & (beside[0, 0].numpy() > 0)
    inner, share = near[0].permute(1, 2, 0).numpy()[edge], 1 - alpha[edge, None]
    added = rgba[edge, :3] - inner
    if len(inner) < _LEAST or np.sqrt((added**2).mean()) < _FRINGE:
        return rgba, None
    for name, color in (("white", 1.0), ("black", 0.0)):
        left = added - share * (color - inner)
        if (left**2).sum() < _UNEXPLAINED * (added**2).sum():
            colors = (rgba[..., :3] - (1 - rgba[..., 3:]) * color) / np.maximum(rgba[..., 3:], 1e-3)
            return np.dstack([colors.clip(0, 1), alpha]).astype(np.float32), name
    return rgba, None


def without_background(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return a photograph's colours ``[H, W, 3]`` without its background along the object's edge.

    Colours of object and of background are local means weighted by alpha (the fusion of blurs of
    Forte 2021).

    Args:
        rgb: ``[H, W, 3]`` in [0, 1].
        alpha: ``[H, W]`` in [0, 1].
    """
    picture, share = _planes(rgb), _planes(alpha[..., None])
    ours, theirs = local_colors(rgb, alpha, max(2, max(rgb.shape[:2]) // 64))
    colors = ours + share * (picture - share * ours - (1 - share) * theirs)
    colors = torch.where(share > _SOLID, picture, colors).clamp(0, 1)
    return colors[0].permute(1, 2, 0).numpy()


def local_colors(rgb: np.ndarray, alpha: np.ndarray, radius: int) -> tuple[Tensor, Tensor]:
    """Return mean colours ``[1, 3, H, W]`` of object and of background around each pixel."""
    return _around(rgb, alpha, radius)[0], _around(rgb, 1 - alpha, radius)[0]


def _around(rgb: np.ndarray, weight: np.ndarray, radius: int) -> tuple[Tensor, Tensor]:
    """Return weighted means ``[1, 3, H, W]`` around each pixel, and the mean weight there."""
    share = _planes(weight[..., None])
    mean = F.avg_pool2d(torch.cat([_planes(rgb) * share, share], 1), 2 * radius + 1, 1, radius)
    return mean[:, :3] / mean[:, 3:].clamp(min=1e-5), mean[:, 3:]


def _planes(picture: np.ndarray) -> Tensor:
    """Return ``[H, W, C]`` as ``[1, C, H, W]`` float32."""
    return torch.from_numpy(np.ascontiguousarray(picture, np.float32)).permute(2, 0, 1)[None]
