"""The rasterizer's scene to be timed and checked: Gaussians on a shell, and the oracle."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ...rasterize import rasterization
from ...rasterize.reference import rasterization_reference
from ..core.case import BOTH, Error, Settings, Variant, compare
from ..core.problem import Problem

LEAVES = ("means", "quats", "scales", "opacities", "colors")
WORK = (
    "pairs_box",
    "pairs",
    "pairs_walked",
    "blocks_walked",
    "blocks_used",
    "tiles",
    "tiles_empty",
)
_HALF_FOV = math.radians(49.1) / 2
_FORWARD_CROP, _BACKWARD_CROP = (48, 40), (24, 20)  # width and height, pixels

# Allowed relative rms error to float64; a knob that trades accuracy is allowed the more it trades.
FORWARD_LIMIT, BACKWARD_LIMIT, TRADE_LIMIT = 1e-4, 1e-3, 10.0
COUNT = 16384
_SIZE = 512


def shell(count: int, scale: float = 1.0, seed: int = 0) -> dict[str, Tensor]:
    """Gaussians on a shell of radius 0.35, standard deviations 0.01·scale, log-normal.

    ``means, quats, scales [N, ·]``, ``opacities [N]`` in 0.3..1, ``colors [N, 3]``.
    """
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    means = direction * 0.35 * (0.9 + 0.1 * torch.rand(count, 1, generator=g))
    scales = torch.exp(0.4 * torch.randn(count, 3, generator=g) + math.log(0.010)) * scale
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1)
    opacities = 0.7 * torch.rand(count, 1, generator=g) + 0.3
    colors = torch.rand(count, 3, generator=g)
    return dict(means=means, quats=quats, scales=scales, opacities=opacities[:, 0], colors=colors)


def orbit_cameras(views: int, size: int) -> tuple[Tensor, Tensor]:
    """``viewmats [V, 4, 4]`` at distance 1.5 around the y axis, and ``Ks [V, 3, 3]``."""
    angle = torch.arange(views) * (2 * math.pi / views)
    viewmats = torch.eye(4).repeat(views, 1, 1)
    viewmats[:, 0, 0] = viewmats[:, 2, 2] = angle.cos()
    viewmats[:, 0, 2], viewmats[:, 2, 0] = angle.sin(), -angle.sin()
    viewmats[:, 2, 3] = 1.5
    focal = size / 2 / math.tan(_HALF_FOV)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return viewmats, K.repeat(views, 1, 1)


@dataclass(eq=False)
class Scene(Problem):
    """Gaussians and cameras, run and checked in several ways.

    The dense oracle sees all Gaussians in a small crop of the first view, as a separate camera
    with the principal point moved; the operator renders the same crop for the check.

    Attributes:
        gaussians: float32, ``[N, ·]`` or ``[B, N, ·]``.
        viewmats: ``[.., V, 4, 4]``.
        Ks: ``[.., V, 3, 3]``.
        size: side of the picture, pixels.
        device: of the operator.
        options: of ``rasterization``.
        wanted: names of the needed gradients.
        exact: options of the oracle where it shall not have ours, as ``alpha_min``.
        truth: Gaussians of the oracle, where ours are others; where fewer, without gradients.
        cotangent: of the picture, ``[.., V, H, W, 3]``; None: drawn at random, as for the alphas.
    """

    gaussians: dict[str, Tensor]
    viewmats: Tensor
    Ks: Tensor
    size: int
    device: torch.device
    options: dict = field(default_factory=dict)
    wanted: tuple[str, ...] = LEAVES
    exact: dict = field(default_factory=dict)
    truth: dict[str, Tensor] | None = None
    cotangent: Tensor | None = None

    def __post_init__(self) -> None:
        self.gaussians = {
            k: x if x is None else x.to(self.device) for k, x in self.gaussians.items()
        }
        self.viewmats, self.Ks = self.viewmats.to(self.device), self.Ks.to(self.device)
        if self.cotangent is None:
            g = torch.Generator().manual_seed(3)
            shape = (*self.viewmats.shape[:-2], self.size, self.size, 3)
            self.cotangent = torch.randn(shape, generator=g).to(self.device)
        count, views = self.gaussians["opacities"].shape[-1], self.viewmats.shape[:-2].numel()
        self.sizes = {"N": count, "side": self.size, "views": views}

    @property
    def upstream(self) -> Tensor:
        """The cotangent of the picture, given or drawn."""
        assert self.cotangent is not None  # ``__post_init__`` draws one
        return self.cotangent

    def changed(self, **changes) -> Scene:
        """A copy with other attributes."""
        return replace(self, **changes)

    def arguments(self) -> dict:
        """Arguments of the operator."""
        cameras = dict(viewmats=self.viewmats, Ks=self.Ks, width=self.size, height=self.size)
        return self.gaussians | cameras | self.options

    def forward(self, function=rasterization) -> tuple[Tensor, Tensor, dict]:
        """A call without gradient, which is timed."""
        with torch.no_grad():
            return function(**self.arguments())

    def leaves(self) -> dict[str, Tensor]:
        """The Gaussians' parameters for which a gradient is asked."""
        wanted = [k for k in self.wanted if self.gaussians[k] is not None]
        return {k: self.gaussians[k].detach().requires_grad_() for k in wanted}

    def backward(self, function=rasterization) -> tuple[Tensor, ...]:
        """A call and the gradients asked for, which is timed."""
        leaves = self.leaves()
        given: dict[str, Any] = {**self.arguments(), **leaves}
        image, _, _ = function(**given)
        return torch.autograd.grad(
            image, list(leaves.values()), self.upstream[..., : image.shape[-1]]
        )

    def work(self, backward: bool = False) -> dict[str, int]:
        """The operator's own counts."""
        leaves = self.leaves()
        given: dict[str, Any] = {**self.arguments(), **leaves}
        image, _, meta = rasterization(**given)
        if backward:
            cotangent = self.upstream[..., : image.shape[-1]]
            torch.autograd.grad(image, list(leaves.values()), cotangent)
        counts = {name: int(meta[name]) for name in (*WORK, *["tiles_skipped"] * backward)}
        return counts | {"gaussians": self.gaussians["opacities"].numel()}

    def oracle(self, direction: str) -> str:
        """Description of the reference."""
        width, height = self.crop(direction == BOTH)[2:]
        text = f"float64, all Gaussians dense, a crop of {width} x {height} pixels"
        return text + (" without thresholds" if "t_min" in self.exact else "")

    def crop(self, backward: bool) -> tuple[int, int, int, int]:
        """Left, top, width and height: within the object, off its centre."""
        width, height = _BACKWARD_CROP if backward else _FORWARD_CROP
        left, top = round(0.58 * self.size), round(0.39 * self.size)
        return left, top, min(width, self.size - left), min(height, self.size - top)

    def limit(self, direction: str, dtype: torch.dtype = torch.float32) -> float:
        """The largest error that is allowed."""
        return BACKWARD_LIMIT if direction == BOTH else FORWARD_LIMIT

    def variant(
        self, name: str, direction: str = "forward", options: dict | None = None, **changes
    ) -> Variant:
        """A variant that counts the operator's work, too."""
        work = partial(self.work, direction == BOTH)
        return super().variant(name, direction, options, **({"work": work} | changes))

    def check(self, direction: str) -> Error:
        """Error of picture and alpha, and of the gradients asked for, on the crop."""
        backward = direction == BOTH
        left, top, width, height = self.crop(backward)
        first = (0,) * (self.viewmats.dim() - 3)  # the first object
        Ks = self.Ks[first][:1].clone()
        Ks[:, 0, 2] -= left
        Ks[:, 1, 2] -= top
        g = torch.Generator().manual_seed(4)
        shape = (1, height, width)
        cotangents = [torch.randn(*shape, c, generator=g) for c in (3, 1)]
        gaussians, truth = (
            {k: None if x is None else x[first] for k, x in g.items()}
            for g in (self.gaussians, self.truth or self.gaussians)
        )
        rest = dict(viewmats=self.viewmats[first][:1], Ks=Ks, width=width, height=height)
        got = self._run(rasterization, gaussians, rest, self.options, cotangents, backward)
        exact = dict(self.options)
        if exact.pop("rasterize_mode", "classic") == "antialiased":
            exact["antialiased"] = True
        exact.pop("radius_clip", None)
        exact.pop("skip", None)
        truth = {k: None if x is None else x.double().cpu() for k, x in truth.items()}
        rest = {k: x.double().cpu() if isinstance(x, Tensor) else x for k, x in rest.items()}
        want = self._run(
            rasterization_reference, truth, rest, exact | self.exact, cotangents, backward
        )
        if not want["alpha"].any():
            raise ValueError("the crop of the check sees no Gaussian")
        return compare(got, want)

    def _run(self, function, gaussians, rest, options, cotangents, backward) -> dict[str, Tensor]:
        wanted = [k for k in self.wanted if gaussians[k] is not None] if backward else []
        leaves = {k: gaussians[k].detach().requires_grad_() for k in wanted}
        with torch.set_grad_enabled(backward):
            results = function(**(gaussians | leaves), **rest, **options)
        picture = results[0]
        alphas = results[2] if function is rasterization_reference else results[1]
        named = {"picture": picture.detach(), "alpha": alphas.detach()}
        if backward:
            pairs = [(x, c.to(x)) for x, c in zip((picture, alphas), cotangents) if x.requires_grad]
            outputs, cotangents = zip(*pairs)  # alpha does not depend on colours
            grads = torch.autograd.grad(outputs, list(leaves.values()), cotangents)
            named |= {f"gradient of {k}": v for k, v in zip(leaves, grads)}
        return named


def make_scene(
    settings: Settings,
    scale: float = 1.0,
    count: int | None = None,
    size: int | None = None,
    views: int = 1,
) -> Scene:
    """The shell; a quick run has an eighth of the Gaussians and a quarter of the pixels."""
    quick = settings.level == "quick"
    count = count or (COUNT // 8 if quick else COUNT)
    size = size or (_SIZE // 2 if quick else _SIZE)
    return Scene(shell(count, scale), *orbit_cameras(views, size), size, settings.device)
