"""GrabCut (Rother, Kolmogorov and Blake 2004): segmentation by colours, without a trained model.

The object is expected in the middle. The method alternates between fitting mixtures of Gaussians to
the colours of object and background, and the minimum cut between them. The cut is computed exactly
by its convex form, a weighted total variation, with a primal-dual iteration (Pock and Chambolle
2011), so neither OpenCV nor a graph library is needed.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ..data.preprocess import planes_of, resize

_SIDE = 256  # longer side of the segmented image, pixels
_LEAST = 16  # smallest shorter side of an image, pixels
_ROUNDS = 5  # of mixtures and cut
_STEPS = 150  # of the primal-dual iteration per round, warm-started by the last one
_PARTS = 5  # Gaussians of a mixture
_MEANS = 8  # steps of k-means that initialise a mixture
_SMOOTH = 50.0  # weight of the border, as in the paper
_LEAST_SPREAD = 2e-4  # added to variances of colours in [0, 1], for plain areas
_MOST = 12.0  # clamp of the log ratio of two densities
_MIDDLE = 0.12  # half axes of the ellipse that is always object, fraction of the sides
_OBJECT = 0.38  # half axes of the initial object's ellipse
_PRIOR = 2.0  # log odds of object in the middle, and of background in the corners
_OFFSETS = ((0, 1), (1, 0), (1, 1), (1, -1))  # half of a pixel's eight neighbours


def grabcut(rgb: np.ndarray) -> np.ndarray:
    """Segment the object in the middle by its colours.

    Args:
        rgb: ``[H, W, 3]`` float32 in [0, 1].

    Returns:
        Alpha ``[H, W]`` float32 in [0, 1], soft along the border; all 0 if nothing in the middle
        differs from the rest.
    """
    height, width = rgb.shape[:2]
    if min(height, width) < _LEAST:
        return np.zeros((height, width), np.float32)
    factor = min(1.0, _SIDE / max(height, width))
    small = (max(4, round(height * factor)), max(4, round(width * factor)))
    inside = _connected(planes_of(_cut(resize(rgb, *small))[..., None]))
    alpha = planes_of(resize(inside[0, 0, ..., None].numpy(), height, width))
    filtered = _guided_filter(alpha, planes_of(rgb), max(1, round(1 / factor)))
    return filtered[0, 0].clamp(0, 1).numpy()


def _cut(colors: np.ndarray) -> np.ndarray:
    """Return the object's pixels, bool ``[h, w]``, from colours ``[h, w, 3]``."""
    height, width = colors.shape[:2]
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)[None]
    radius = np.hypot(x, y).astype(np.float32)  # 1 in the middle of an edge
    middle = radius < 2 * _MIDDLE
    prior = _PRIOR * np.clip(1 - 1.6 * radius, -1, 1)
    inside = radius < 2 * _OBJECT
    borders = _Borders(colors)
    fraction = inside.astype(np.float32)
    for _ in range(_ROUNDS):
        ratio = _log_density(colors, ~inside) - _log_density(colors, inside)
        price = np.clip(ratio, -_MOST, _MOST) - prior
        price[middle] = np.minimum(price[middle], -1.0)
        fraction = borders.cheapest(price.astype(np.float32), fraction)
        inside = fraction > 0.5
        if not 0 < inside.sum() < inside.size:
            break
    return inside


def _log_density(colors: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return the log density ``[h, w]`` of each colour under the mixture of a mask's pixels."""
    chosen, flat = colors[where], colors.reshape(-1, 3)
    nearest = _nearest(chosen, _k_means(chosen))
    parts = []
    for cluster in (chosen[nearest == k] for k in range(_PARTS)):
        if len(cluster) == 0:
            continue
        off = cluster - cluster.mean(0)
        spread = off.T @ off / len(cluster) + _LEAST_SPREAD * np.eye(3)
        factor = np.linalg.inv(np.linalg.cholesky(spread))
        scaled = (flat - cluster.mean(0)) @ factor.T
        norm = np.log(len(cluster) / len(chosen)) + np.log(factor.diagonal()).sum()
        parts.append(norm - 0.5 * (scaled * scaled).sum(1))
    most = np.max(parts, axis=0)
    return (most + np.log(np.exp(parts - most).sum(0))).reshape(where.shape)


def _k_means(colors: np.ndarray) -> np.ndarray:
    """Return k-means centres ``[K, 3]``, initialised deterministically by the farthest colours."""
    last, distance, seeds = colors.mean(0), np.full(len(colors), np.inf), []
    for _ in range(_PARTS):
        distance = np.minimum(distance, ((colors - last) ** 2).sum(1))
        last = colors[distance.argmax()]
        seeds.append(last)
    centres = np.stack(seeds)
    for _ in range(_MEANS):
        nearest = _nearest(colors, centres)
        for k in np.unique(nearest):
            centres[k] = colors[nearest == k].mean(0)
    return centres


def _nearest(colors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    return ((centres * centres).sum(1) - 2 * colors @ centres.T).argmin(1)


class _Borders:
    """Cost of a border between two neighbours, low where their colours differ.

    Args:
        colors: ``[h, w, 3]``.
    """

    def __init__(self, colors: np.ndarray) -> None:
        squares = [((a - b) ** 2).sum(-1) for a, b in (_ends(colors, o) for o in _OFFSETS)]
        mean = max(1e-8, float(np.concatenate([s.ravel() for s in squares]).mean()))
        self._weights = [
            (_SMOOTH * np.exp(-values / (2 * mean)) / math.hypot(*offset)).astype(np.float32)
            for values, offset in zip(squares, _OFFSETS, strict=True)
        ]
        total = np.full(colors.shape[:2], 1e-3, np.float32)
        for weight, offset in zip(self._weights, _OFFSETS, strict=True):
            for end in _ends(total, offset):
                end += weight
        self._step = 1 / total
        self._flows = [np.zeros_like(weight) for weight in self._weights]

    def cheapest(self, price: np.ndarray, fraction: np.ndarray) -> np.ndarray:
        """Return the labelling ``[h, w]`` in [0, 1] with the least cost of pixels and borders.

        It converges to 0 or 1, except where costs are equal. The flows are kept for the next call.

        Args:
            price: cost of a pixel as object, ``[h, w]``.
            fraction: initial labelling, ``[h, w]`` in [0, 1].
        """
        ahead = fraction
        for _ in range(_STEPS):
            slope = price.copy()
            for weight, flow, offset in zip(self._weights, self._flows, _OFFSETS, strict=True):
                here, there = _ends(ahead, offset)
                push = here - there
                push *= 0.5 * weight
                flow += push
                np.clip(flow, -weight, weight, out=flow)
                to, back = _ends(slope, offset)
                to += flow
                back -= flow
            after = np.clip(fraction - self._step * slope, 0, 1)
            ahead, fraction = 2 * after - fraction, after
        return fraction


def _ends(plane: np.ndarray, offset: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return views of a plane ``[h, w, ..]``: pixels with that neighbour, and the neighbours."""
    down, right = offset
    height, width = plane.shape[:2]
    here, there = slice(max(0, -right), width - max(0, right)), slice(max(0, right), None)
    return plane[: height - down, here], plane[down:, there][:, : width - abs(right)]


def _connected(inside: Tensor) -> Tensor:
    """Return the components that touch the middle half, ``[1, 1, h, w]`` of 0 and 1."""
    height, width = inside.shape[-2:]
    reached, before = torch.zeros_like(inside), None
    middle = np.s_[..., height // 4 : height - height // 4, width // 4 : width - width // 4]
    reached[middle] = inside[middle]
    while before is None or not torch.equal(reached, before):
        before = reached
        for _ in range(8):
            reached = functional.max_pool2d(reached, 3, 1, 1) * inside
    return reached


def _guided_filter(alpha: Tensor, image: Tensor, radius: int) -> Tensor:
    """Align the border of an enlarged alpha with the image's edges (guided filter)."""
    size = 2 * radius + 1

    def mean(planes: Tensor) -> Tensor:
        return functional.avg_pool2d(planes, size, 1, size // 2, count_include_pad=False)

    grey = image.mean(1, keepdim=True)
    mean_grey, mean_alpha = mean(grey), mean(alpha)
    variance = mean(grey * grey) - mean_grey.square()
    slope = (mean(grey * alpha) - mean_grey * mean_alpha) / (variance + 1e-4)
    return mean(slope) * grey + mean(mean_alpha - slope * mean_grey)
