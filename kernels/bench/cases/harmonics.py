"""Colours from spherical harmonics alone: our kernels, the formula in torch, gsplat's torch."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from ...rasterize.harmonics import colors_seen_from
from ...rasterize.harmonics.formula import colors_by_formula
from .. import peers
from ..core.case import Case, Error, Key, Settings, Target, Variant, compare, make_cases
from .raster_scene import BOTH

LIMIT = 1e-5
_DEGREES = (0, 1, 2, 3, 4)
_DEGREE = 3  # where sizes change
_GSPLAT = 2.0  # times as fast as gsplat's torch function
_Function = Callable[[int, Tensor, Tensor, Tensor], Tensor]


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


class Problem:
    """N Gaussians seen from V centres, and the formula in float64."""

    def __init__(self, settings: Settings, degree: int, count: int, views: int) -> None:
        self.degree, self.sizes = degree, {"N": count, "views": views, "degree": degree}
        g = torch.Generator().manual_seed(0)
        inputs = {
            "coefficients": 0.3 * torch.randn(1, count, (degree + 1) ** 2, 3, generator=g),
            "means": torch.randn(1, count, 3, generator=g),
            "centers": 3 * torch.randn(1, views, 3, generator=g),
        }
        self.inputs = {k: x.to(settings.device) for k, x in inputs.items()}
        self.cotangent = torch.randn(1, views, count, 3, generator=g).to(settings.device)

    @torch.no_grad()
    def forward(self, function: _Function) -> Tensor:
        """The colours; this is timed."""
        return function(self.degree, *self.inputs.values())

    def backward(
        self, function: _Function, dtype: torch.dtype = torch.float32
    ) -> dict[str, Tensor]:
        """The colours and the gradients of all inputs that have one; this is timed."""
        leaves = [x.to(dtype, copy=True).requires_grad_() for x in self.inputs.values()]
        colors = function(self.degree, *leaves)
        wanted = leaves if self.degree else leaves[:1]
        grads = torch.autograd.grad(colors, wanted, self.cotangent.to(dtype))
        return {"colors": colors.detach(), **dict(zip(self.inputs, grads))}

    def check(self, function: _Function, direction: str) -> Error:
        """Against float64."""
        truth = self.backward(colors_by_formula, torch.float64)
        if direction == BOTH:
            return compare(self.backward(function), truth)
        return compare({"colors": self.forward(function)}, {"colors": truth["colors"]})

    def variants(self, settings: Settings, suffix: str) -> list[Variant]:
        """Ours, the formula, and gsplat's, forward and with gradients."""
        functions = {"ours": colors_seen_from, "the formula in torch": colors_by_formula}
        if settings.peers:
            functions["gsplat's torch"] = _gsplat
        return [
            Variant(
                name=f"{name}, {suffix}",
                run=partial(self.forward if direction == "forward" else self.backward, function),
                check=partial(self.check, function, direction),
                limit=LIMIT,
                oracle="the formula in float64",
                direction=direction,
                peer=function is _gsplat,
                default=function is colors_seen_from,
                parameters=dict(self.sizes),
            )
            for direction in ("forward", BOTH)
            for name, function in functions.items()
        ]


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
        made += Problem(settings, degree, count, 1).variants(settings, f"degree {degree}")
    return made


def sizes(settings: Settings) -> list[Variant]:
    """Degree 3 with more Gaussians and views, alone and with gradients."""
    made = []
    for count, views in _counts(settings):
        problem = Problem(settings, _DEGREE, count, views)
        made += problem.variants(settings, _suffix(count, views))
    return made


def targets(settings: Settings) -> list[Target]:
    """Faster than gsplat's torch function, where it is measured; nothing at a quick run's sizes."""
    if settings.level == "quick" or not settings.peers:
        return []
    named = [("harmonics by degree", f"degree {degree}") for degree in _DEGREES]
    named += [("harmonics", _suffix(*sizes)) for sizes in _counts(settings)]
    return [
        Target(
            f"harmonics, {suffix}, {direction}, gsplat's torch function's time over ours",
            (Key("raster", case, f"gsplat's torch, {suffix}", direction),),
            (Key("raster", case, f"ours, {suffix}", direction),),
            at_least=_GSPLAT,
        )
        for case, suffix in named
        for direction in ("forward", BOTH)
    ]
