"""Colours from spherical harmonics alone: our kernels, the formula in torch, gsplat's torch."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from ...rasterize.harmonics import colors_seen_from
from ...rasterize.harmonics.formula import colors_by_formula
from .. import peers
from ..core.case import DIRECTIONS, Case, Settings, Variant, make_cases
from ..core.problem import Operator

LIMIT = 1e-5
_DEGREES = (0, 1, 2, 3, 4)
_DEGREE = 3  # where sizes change
_GSPLAT = 2.0  # times as fast as gsplat's torch function


def cases(settings: Settings) -> list[Case]:
    """The degrees at one size, and the sizes at one degree."""
    builders = [("harmonics by degree", degrees, "degree"), ("harmonics", sizes, "N")]
    return make_cases("raster", settings, builders)


def _gsplat(degree: int, coefficients: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    """The function of gsplat, with the half and the clamp that its rasterizer adds."""
    code = peers.load("gsplat.cuda._torch_impl", "gsplat")
    directions = means[:, None] - centers[:, :, None]
    wide = coefficients[:, None].expand(*directions.shape[:3], *coefficients.shape[2:])
    return (code._spherical_harmonics(degree, directions, wide) + 0.5).clamp_min(0)


def _variants(
    settings: Settings, degree: int, count: int, views: int, suffix: str
) -> list[Variant]:
    """N Gaussians seen from V centres: ours, the formula and gsplat's function."""
    g = torch.Generator().manual_seed(0)
    inputs = {
        "coefficients": 0.3 * torch.randn(1, count, (degree + 1) ** 2, 3, generator=g),
        "means": torch.randn(1, count, 3, generator=g),
        "centers": 3 * torch.randn(1, views, 3, generator=g),
    }
    problem = Operator(
        partial(colors_seen_from, degree),
        partial(colors_by_formula, degree),
        inputs,
        torch.randn(1, views, count, 3, generator=g),
        settings.device,
        "the formula in float64",
        {"N": count, "views": views, "degree": degree},
        dict.fromkeys(DIRECTIONS, LIMIT),
        fixed=() if degree else ("means", "centers"),
    )
    made = problem.pair(f"ours, {suffix}", default=True)
    formula = replace(problem, function=problem.reference)
    made += formula.pair(f"the formula in torch, {suffix}")
    if settings.peers:
        gsplat = replace(problem, function=partial(_gsplat, degree))
        made += gsplat.pair(f"gsplat's torch, {suffix}", peer=True)
    return made


def _counts(settings: Settings) -> tuple[tuple[int, int], ...]:
    """Numbers of Gaussians and views."""
    if settings.level == "quick":
        return ((2048, 1), (2048, 2))
    return ((16384, 1), (16384, 4), (262144, 1), (262144, 4))


def _suffix(count: int, views: int) -> str:
    return f"{count} Gaussians, {views} view{'s' * (views > 1)}"


def degrees(settings: Settings) -> list[Variant]:
    """Colours of 16,384 Gaussians in one view (2,048 in a quick run) from harmonics of each degree,
    alone and with the gradients of coefficients, means and centres.
    """
    count = _counts(settings)[0][0]
    made = []
    for degree in _DEGREES:
        made += _variants(settings, degree, count, 1, f"degree {degree}")
    return made


def sizes(settings: Settings) -> list[Variant]:
    """Degree 3 with more Gaussians and views, alone and with gradients."""
    made = []
    for count, views in _counts(settings):
        made += _variants(settings, _DEGREE, count, views, _suffix(count, views))
    return made
