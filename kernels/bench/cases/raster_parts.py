"""Parts of the rasterizer alone, ours and those of gsplat's torch code that a CPU can run."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ...rasterize import Skip
from ...rasterize.harmonics import colors_from_harmonics
from ...rasterize.ops import bin_op, project
from .. import peers
from ..core.case import Error, compare
from .raster_scene import Scene

_DEGREE, _TILE = 3, 16


class Parts:
    """Projection, tile lists and harmonics of a scene."""

    def __init__(self, scene: Scene) -> None:
        self.x, self.size = scene.gaussians, scene.size
        self.viewmats, self.Ks = scene.viewmats, scene.Ks
        count = len(self.x["means"])
        g = torch.Generator().manual_seed(5)
        self.coefficients = 0.3 * torch.randn(count, (_DEGREE + 1) ** 2, 3, generator=g)
        self.projected = self.project()
        _, _, self.depths, _, self.extents, _ = self.projected

    @torch.no_grad()
    def project(self) -> tuple[Tensor, ...]:
        """Timed: ours."""
        lens = [float(self.size), float(self.size), 0.01, 1e10, 0.0, 0.3, 1 / 255, 0.0, 1.0]
        each = [self.x[k][None] for k in ("means", "quats", "scales", "opacities", "colors")]
        return project(*each, self.viewmats[None], self.Ks[None], lens)

    def gsplat_project(self) -> Tensor:
        """Timed: the centres in the picture, ``[V, N, 2]``."""
        gaussians = [self.x[k] for k in ("means", "quats", "scales")]
        return peers.gsplat_projection(*gaussians, self.viewmats, self.Ks, self.size)

    def bin(self) -> tuple[Tensor, ...]:
        """Timed: ours."""
        per_view = [x.flatten(0, 1) for x in self.projected[:5]]
        return bin_op(*per_view, self.size, self.size, 1 / 255, Skip().bits())

    def gsplat_bin(self) -> object:
        """Timed: its lists of the same boxes."""
        tiles = -(-self.size // _TILE)
        code = peers.load("gsplat.cuda._torch_impl", "gsplat")
        radii = self.extents[0].ceil().int()
        return code._isect_tiles(self.projected[0][0], radii, self.depths[0], _TILE, tiles, tiles)

    @torch.no_grad()
    def harmonics(self) -> Tensor:
        """Timed: ours, ``[1, V, N, 3]``."""
        means, coefficients = self.x["means"][None], self.coefficients[None]
        return colors_from_harmonics(_DEGREE, coefficients, means, self.viewmats[None])

    @torch.no_grad()
    def gsplat_harmonics(self) -> Tensor:
        """Timed: with the clamp that its operator puts behind them."""
        code = peers.load("gsplat.cuda._torch_impl", "gsplat")
        centre = torch.linalg.inv(self.viewmats)[0, :3, 3]
        colors = code._spherical_harmonics(_DEGREE, self.x["means"] - centre, self.coefficients)
        return (colors + 0.5).clamp_min(0)

    def pairs(self) -> dict[str, tuple[Callable, Callable, Callable[[], Error] | None]]:
        """By part: ours, gsplat's, and the check of gsplat's by ours; lists differ by design."""
        return {
            "projection": (
                self.project,
                self.gsplat_project,
                lambda: compare(
                    {"centres": self.gsplat_project()}, {"centres": self.project()[0][0]}
                ),
            ),
            "tile lists": (self.bin, self.gsplat_bin, None),
            "harmonics": (
                self.harmonics,
                self.gsplat_harmonics,
                lambda: compare(
                    {"colours": self.gsplat_harmonics()}, {"colours": self.harmonics()[0, 0]}
                ),
            ),
        }
