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
_Share = Annotated[float, Meta(ge=0, le=1)]
Strategy = Literal["fixed", "mcmc", "default"]
BETAS = (0.9, 0.99)  # Adam's second moment spans 100 steps, as a fit has only hundreds
MIN_SCALE, MAX_SCALE = 1e-3, 0.1  # object units


@dataclass(frozen=True)
class FitConfig:
    """Options of a fit.

    Attributes:
        gaussians: N, constant with strategy "fixed", else the largest number.
        steps: number of Adam steps; 0 returns the start.
        seconds: time limit, or None; the learning rates then fall with the time, so the result
            depends on the machine. The schedules of gsplat's strategies still count steps.
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
        relocate_share: largest share of the Gaussians relocated at once.
        relocate_until: share of the steps after which relocation stops.
        min_weight: Gaussians with less total blending weight in all views, in pixels, are
            relocated.
        strategy: "fixed", or gsplat's "mcmc" or "default". The fields ``relocate_`` and
            ``min_weight`` apply to "fixed", those from ``start_share`` to ``grow_grad`` to the
            other two.
        start_share: N at the start, as a share of ``gaussians``.
        refine_start: share of the steps before gsplat's strategy changes the number.
        refine_stop: share of the steps after which the number stays.
        refine_times: number of refinements if they took place over all steps.
        weight_opacity: weight of the mean opacity in the loss of "mcmc": unneeded Gaussians fade
            and are relocated.
        noise: ``noise_lr`` of "mcmc", the noise on the means relative to their learning rate.
        grow_grad: "default" splits and copies Gaussians with a larger gradient in the picture.
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
    relocate_every: Annotated[int, Meta(ge=0)] = 25
    relocate_share: _Share = 0.2
    relocate_until: _Share = 0.7
    min_weight: _Weight = 1.0
    strategy: Strategy = "fixed"
    start_share: _Share = 0.5
    refine_start: _Share = 1 / 12
    refine_stop: _Share = 0.7
    refine_times: Annotated[int, Meta(ge=1, le=10_000)] = 30
    weight_opacity: _Weight = 1e-4
    noise: Annotated[float, Meta(ge=0, le=1e9)] = 4e4
    grow_grad: _Weight = 2e-4
    rasterize_mode: RasterizeMode = "classic"
    seed: Seed = 0

    def __post_init__(self) -> None:
        check_options(self)
