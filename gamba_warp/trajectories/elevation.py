"""Elevation of the camera that took an image, from the Gaussians made of it.

The network works in the camera's axes, so an object seen from above leans back. Upright, most
things have a concentrated vertical profile (of horizontal faces, say), and little height and depth.
With the entropy H of that profile, the height h and the depth d of the object turned by an angle,

    probability(angle) ~ exp(-ENTROPY_WEIGHT H - HEIGHT_WEIGHT h - DEPTH_WEIGHT d - z²/2),
    z = (angle - USUAL) / SPREAD,

and the estimate is the median. Where the quartiles are far apart, it is in doubt. The weights are
fitted to results of the shipped model for 1,389 views of its training objects; docs/cameras.md has
the errors on others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..gaussians import Gaussians

ANGLES = np.arange(-20.0, 65.1, 2.5)  # degrees
ENTROPY_WEIGHT, HEIGHT_WEIGHT, DEPTH_WEIGHT = 4.5, 22.0, 25.0  # the latter per object unit
USUAL, SPREAD = 12.0, 20.0  # degrees; of images of single objects
LEAST_OPACITY = 0.3  # of counted Gaussians
_FEWEST, _MOST = 50, 4_000  # counted Gaussians; more are thinned out
_DOUBTFUL = 15.0  # degrees between the quartiles
_BINS, _SMOOTH = 96, (0.25, 0.5, 0.25)  # of a profile over 1.6 object units


class ElevationEstimate(NamedTuple):
    """Elevation of a camera over an object, whole degrees.

    Attributes:
        degrees: median of the distribution, between -20 and 65.
        low: its lower quartile.
        high: its upper quartile.
    """

    degrees: int
    low: int
    high: int

    @property
    def doubtful(self) -> bool:
        """True if the quartiles are far apart; the error is then 2.5 times as large."""
        return self.high - self.low > _DOUBTFUL

    def __str__(self) -> str:
        doubt = f", in doubt ({self.low} to {self.high})" if self.doubtful else ""
        return f"{self.degrees} degree{'' if abs(self.degrees) == 1 else 's'}{doubt}"


UNKNOWN = ElevationEstimate(0, round(ANGLES[0]), round(ANGLES[-1]))


def estimate_elevation(gaussians: Gaussians) -> ElevationEstimate:
    """Estimate the elevation of the reference camera over an object.

    Args:
        gaussians: ``[N]``, the object in object units, in the reference camera's frame.

    Returns:
        The estimate; ``UNKNOWN`` for an object of fewer than 50 opaque, finite Gaussians.
    """
    finite = (gaussians.means + gaussians.scales).isfinite().all(-1)
    chosen = (finite & (gaussians.opacities > LEAST_OPACITY)).nonzero()[:, 0]
    chosen = chosen[:: max(1, len(chosen) // _MOST)]
    if len(chosen) < _FEWEST:
        return UNKNOWN
    _, y, z = gaussians.means[chosen].double().cpu().numpy().T
    areas = gaussians.scales[chosen].double().cpu().numpy().prod(1) ** (2 / 3)
    weights = areas * gaussians.opacities[chosen].double().cpu().numpy()
    weights /= weights.sum()
    angles = np.radians(ANGLES)[:, None]
    up = -y * np.cos(angles) - z * np.sin(angles)  # a camera above sees "up" lean towards it
    depth = -z * np.cos(angles) + y * np.sin(angles)
    height, length = (np.ptp(np.quantile(x, (0.01, 0.99), axis=1), axis=0) for x in (up, depth))
    entropy = np.array([_entropy(heights, weights) for heights in up])
    usual = ((ANGLES - USUAL) / SPREAD) ** 2 / 2
    energy = ENTROPY_WEIGHT * entropy + HEIGHT_WEIGHT * height + DEPTH_WEIGHT * length + usual
    fractions = np.exp(energy.min() - energy)
    below = (np.cumsum(fractions) - fractions / 2) / fractions.sum()
    low, median, high = (round(float(x)) for x in np.interp((0.25, 0.5, 0.75), below, ANGLES))
    return ElevationEstimate(median, low, high)


def _entropy(values: np.ndarray, weights: np.ndarray) -> float:
    """Entropy of the smoothed profile of weighted values."""
    bins = np.clip((values / 1.6 + 0.5) * _BINS, 0, _BINS - 1).astype(int)
    profile = np.convolve(np.bincount(bins, weights, _BINS), _SMOOTH, "same")
    profile = profile[profile > 0]
    return float(-(profile * np.log(profile)).sum())
