"""Options of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from ..untrusted.ranges import Seed, check_options

RasterizeMode = Literal["classic", "antialiased"]
Count = Annotated[int, Meta(ge=2, le=5_000_000)]
Steps = Annotated[int, Meta(ge=1, le=10_000_000)]
_Rate = Annotated[float, Meta(ge=0, le=10)]
_Weight = Annotated[float, Meta(ge=0, le=1e6)]
BETAS = (0.9, 0.99)  # Adam's second moment spans 100 steps, as a fit has only hundreds
MIN_SCALE, MAX_SCALE = 1e-3, 0.1  # object units


@dataclass(frozen=True)
class FitConfig:
    """Options of a fit.

    Attributes:
        gaussians: N, which stays constant.
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
        rasterize_mode: rendering mode. Files do not store it, and most viewers are classic;
            antialiased Gaussians fit small pictures better.
        seed: seed of all random numbers.
    """

    gaussians: Count = 8000
    steps: Annotated[int, Meta(ge=0, le=10_000_000)] = 600
    seconds: Annotated[float, Meta(gt=0, le=1e8)] | None = None
    views: Annotated[int, Meta(ge=1, le=1000)] = 5
    lr_means: _Rate = 2e-3
    lr_scales: _Rate = 2e-2
    lr_quats: _Rate = 2e-2
    lr_opacities: _Rate = 5e-2
    lr_colors: _Rate = 2e-2
    lr_end: Annotated[float, Meta(gt=0, le=1)] = 0.03
    weight_alpha: _Weight = 0.5
    weight_l1: _Weight = 0.3
    rasterize_mode: RasterizeMode = "classic"
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_options(self)
