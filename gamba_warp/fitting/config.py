"""How one object is fitted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

RasterizeMode = Literal["classic", "antialiased"]
MIN_SCALE, MAX_SCALE = 1e-3, 0.1  # object units


@dataclass(frozen=True)
class FitConfig:
    """How one object is fitted.

    Attributes:
        gaussians: N, fixed throughout.
        steps: number of Adam steps; 0 returns the start.
        seconds: time limit, or None; the learning rates then fall with the time, so the result
            depends on the machine.
        views: number of views rendered in each step.
        lr_means: first learning rate of the means, object units a step.
        lr_scales: first learning rate of the scales' logarithms.
        lr_quats: first learning rate of the quaternions.
        lr_opacities: first learning rate of the opacities' logits.
        lr_colors: first learning rate of the colours' logits.
        lr_end: the last learning rates as a share of the first; they fall exponentially.
        weight_alpha: weight of the squared error of alpha; that of colour has the weight 1.
        weight_l1: weight of the absolute error of colour.
        relocate_every: steps between relocations; 0 for none.
        relocate_share: largest share of the Gaussians that is relocated at once.
        relocate_until: share of the steps after which none is relocated.
        min_weight: a Gaussian that has less blending weight than so many pixels in all views
            together is relocated.
        rasterize_mode: mode that renders the Gaussians. Files do not hold it, and most viewers are
            classic; antialiased Gaussians fit small pictures better.
        seed: seed of all random numbers.
    """

    gaussians: int = 8000
    steps: int = 600
    seconds: float | None = None
    views: int = 5
    lr_means: float = 2e-3
    lr_scales: float = 2e-2
    lr_quats: float = 2e-2
    lr_opacities: float = 5e-2
    lr_colors: float = 2e-2
    lr_end: float = 0.03
    weight_alpha: float = 0.5
    weight_l1: float = 0.3
    relocate_every: int = 25
    relocate_share: float = 0.2
    relocate_until: float = 0.7
    min_weight: float = 1.0
    rasterize_mode: RasterizeMode = "classic"
    seed: int = 0
