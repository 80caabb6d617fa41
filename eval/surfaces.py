"""Gaussians to what is measured: a mesh (``gamba_warp.surfaces``) or the bare centres."""

from __future__ import annotations

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.gaussians import Gaussians
from gamba_warp.surfaces import Method, SurfaceOptions, extract_surface

from .metrics import Points
from .shapes import Mesh

__all__ = ["Method", "SurfaceOptions", "centers", "to_surface"]


def to_surface(
    gaussians: Gaussians, options: SurfaceOptions, seed: int, count: int
) -> Mesh | Points:
    """One object's Gaussians to a ``Mesh``, or to ``count`` ``Points`` for the method centers.

    Raises:
        UserError: there is no surface.
    """
    if options.method == "centers":
        return centers(gaussians, count, seed)
    surface = extract_surface(gaussians, options)
    return Mesh(surface.vertices, surface.faces)


def centers(gaussians: Gaussians, count: int, seed: int) -> Points:
    """Centres drawn with a chance proportional to opacity, ``count`` times, with repetition.

    Raises:
        UserError: no Gaussian has any opacity.
    """
    weights = gaussians.opacities.double().cpu().numpy()
    if weights.sum() <= 0:
        raise UserError("no Gaussian has any opacity")
    chosen = np.random.default_rng(seed).choice(len(weights), count, p=weights / weights.sum())
    return Points(gaussians.means.double().cpu().numpy()[chosen])
