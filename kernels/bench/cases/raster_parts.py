"""Parts of the rasterizer alone, ours and those of gsplat's torch code that a CPU can run."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ...rasterize import Skip
from ...rasterize.constants import ALPHA_MIN, EPS2D, TILE
from ...rasterize.cpu.tuning import current
from ...rasterize.harmonics import colors_from_harmonics
from ...rasterize.ops import bin_op, project
from ...rasterize.project import LensOptions, Projected
from .. import peers
from ..core.case import Error, compare
from .raster_scene import Scene

_DEGREE = 3


class Parts:
    """Projection, tile lists and harmonics of a scene."""

    def __init__(self, scene: Scene) -> None:
        self.x, self.size = scene.gaussians, scene.size
        self.width, self.height = (scene.arguments()[side] for side in ("width", "height"))
        self.viewmats, self.Ks = scene.viewmats, scene.Ks
        count = len(self.x["means"])
        g = torch.Generator().manual_seed(5)
        self.coefficients = 0.3 * torch.randn(count, (_DEGREE + 1) ** 2, 3, generator=g)
        self.projected = self.project()

    @torch.no_grad()
    def project(self) -> Projected:
        """Our projection, which is timed."""
        lens = LensOptions(
            width=self.width,
            height=self.height,
            near_plane=0.01,
            far_plane=1e10,
            radius_clip=0.0,
            eps2d=EPS2D,
            alpha_min=ALPHA_MIN,
            antialiased=False,
            skip_unused=True,
        )
        each = [self.x[k][None] for k in ("means", "quats", "scales", "opacities", "colors")]
        return Projected(*project(*each, self.viewmats[None], self.Ks[None], lens.numbers()))

    def gsplat_project(self) -> Tensor:
        """The centres that gsplat finds in the picture, ``[V, N, 2]``; this is timed."""
        means, quats, scales = (self.x[k] for k in ("means", "quats", "scales"))
        return peers.gsplat_projection(means, quats, scales, self.viewmats, self.Ks, self.size)

    def front(self) -> tuple[Tensor, ...]:
        """Our projection and tile lists, which are timed."""
        return self.bin(self.project())

    def bin(self, projected: Projected | None = None) -> tuple[Tensor, ...]:
        """Our tile lists, which are timed; of the scene's own projection if none is given."""
        x = projected or self.projected
        parts = x.means2d, x.conics, x.depths, x.view_opacities, x.extents
        per_view = [part.flatten(0, 1) for part in parts]
        means2d, conics, depths, opacities, extents = per_view
        options = self.width, self.height, ALPHA_MIN, Skip().bits(), current().numbers()
        return bin_op(means2d, conics, depths, opacities, extents, *options)

    def gsplat_bin(self) -> object:
        """The lists that gsplat makes of the same boxes; this is timed."""
        tiles = -(-self.size // TILE)
        code = peers.load("gsplat.cuda._torch_impl", "gsplat")
        x = self.projected
        radii = x.extents[0].ceil().int()
        return code._isect_tiles(x.means2d[0], radii, x.depths[0], TILE, tiles, tiles)

    @torch.no_grad()
    def harmonics(self) -> Tensor:
        """Our colours ``[1, V, N, 3]``, which are timed."""
        means, coefficients = self.x["means"][None], self.coefficients[None]
        return colors_from_harmonics(_DEGREE, coefficients, means, self.viewmats[None])

    @torch.no_grad()
    def gsplat_harmonics(self) -> Tensor:
        """The colours of gsplat, with the clamp that its operator has; this is timed."""
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
                    {"centres": self.gsplat_project()}, {"centres": self.project().means2d[0]}
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
