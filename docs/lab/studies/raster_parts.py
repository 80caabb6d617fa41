"""Parts of the rasterizer, and those of gsplat's torch code that run on a CPU."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from gamba_warp.kernels.bench import peers
from gamba_warp.kernels.bench.cases.raster_scene import COUNT, Scene, make_scene
from gamba_warp.kernels.bench.core.case import Error, Settings, Variant, compare
from gamba_warp.kernels.rasterize import Skip
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, EPS2D, TILE
from gamba_warp.kernels.rasterize.ops import bin_op, project
from gamba_warp.kernels.rasterize.project import LensOptions, Projected


class Parts:
    """Projection and tile lists of a scene, ours and gsplat's; each of them is timed."""

    def __init__(self, scene: Scene) -> None:
        self.x, self.size = scene.gaussians, scene.size
        self.width, self.height = (scene.arguments()[side] for side in ("width", "height"))
        self.viewmats, self.Ks = scene.viewmats, scene.Ks
        self.projected = self.project()

    @torch.no_grad()
    def project(self) -> Projected:
        """Our projection."""
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
        """Centres projected by gsplat, ``[V, N, 2]``."""
        code = peers.load("gsplat.cuda._torch_impl", "gsplat")
        means, quats, scales = (self.x[k] for k in ("means", "quats", "scales"))
        covariances, _ = code._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        lens = self.viewmats, self.Ks, self.size, self.size
        return code._fully_fused_projection(means, covariances, *lens)[1]

    def check(self) -> Error:
        """The error of gsplat's centres to ours."""
        return compare({"centres": self.gsplat_project()}, {"centres": self.project().means2d[0]})

    def front(self) -> tuple[Tensor, ...]:
        """Our projection and tile lists."""
        return self.bin(self.project())

    def bin(self, projected: Projected | None = None) -> tuple[Tensor, ...]:
        """Our tile lists; of the scene's own projection if none is given."""
        x = projected or self.projected
        parts = x.means2d, x.conics, x.depths, x.view_opacities, x.extents
        options = self.width, self.height, ALPHA_MIN, Skip().bits()
        return bin_op(*(part.flatten(0, 1) for part in parts), *options)

    def gsplat_bin(self) -> object:
        """Tile lists of gsplat for the same boxes."""
        code = peers.load("gsplat.cuda._torch_impl", "gsplat")
        x, tiles = self.projected, -(-self.size // TILE)
        radii = x.extents[0].ceil().int()
        return code._isect_tiles(x.means2d[0], radii, x.depths[0], TILE, tiles, tiles)


def gsplat_parts(settings: Settings) -> list[Variant]:
    """The torch functions of gsplat that run on a CPU, beside the same part of ours: projection and
    tile lists (theirs of boxes, ours of ellipses). Its compositing needs CUDA. More Gaussians are
    smaller, so that they cover the same area.
    """
    more = {"quick": (), "normal": (262144,), "full": (262144, 1048576)}[settings.level]
    made = []
    for count in (None, *more):
        scene = make_scene(settings, math.sqrt(COUNT / (count or COUNT)), count)
        parts = Parts(scene)
        runs: dict[str, tuple[Callable, Callable]] = {
            "projection": (parts.project, parts.gsplat_project)
        }
        if count != 1048576:  # gsplat's lists take too long: a loop in Python
            runs["tile lists"] = (parts.bin, parts.gsplat_bin)
        for part, (ours, theirs) in runs.items():
            end = f", {count} Gaussians" if count else ""
            exact = part == "projection"  # lists differ by design
            variant = partial(Variant, direction=part, parameters=scene.sizes)
            made.append(variant(f"ours{end}", ours, None, default=True))
            peer = variant(f"gsplat{end}", theirs, parts.check if exact else None, peer=True)
            peer.limit, peer.rounds = 1e-4, None if exact else 3
            peer.oracle = "our float32 result" if exact else ""
            made.append(peer)
    return made
