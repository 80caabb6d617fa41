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
        steps: of Adam; 0 returns the start.
        seconds: where given, stop there if ``steps`` are not done; the learning rates then fall
            with the time, so the result depends on the machine.
        views: rendered in each step.
        lr_means: first learning rate, object units a step.
        lr_scales: of the logarithms.
        lr_quats: of the quaternions.
        lr_opacities: of the logits.
        lr_colors: of the logits.
        lr_end: the last learning rates as a share of the first; they fall exponentially.
        weight_alpha: of the squared error of alpha, beside that of colour.
        weight_l1: of the absolute error of colour.
        relocate_every: steps between relocations; 0 for none.
        relocate_share: at most so much of the Gaussians at once.
        relocate_until: none after this share of the steps.
        min_weight: a Gaussian that has less blending weight than so many pixels in all views
            together is relocated.
        rasterize_mode: what renders the Gaussians, here and later: files do not hold it, and most
            viewers are classic; antialiased ones fit small pictures better.
        seed: of everything random.
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
