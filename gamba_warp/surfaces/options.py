"""Options of surfaces of Gaussians; without slow imports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from ..versions import require

Method = Literal["tsdf", "density", "centers"]
Voxels = Annotated[int, Meta(ge=8, le=1024)]
Views = Annotated[int, Meta(ge=8, le=1000)]
Pixels = Annotated[int, Meta(ge=8, le=4096)]
Faces = Annotated[int, Meta(ge=0, le=2**31 - 1)]
# Sizes that a browser loads and renders smoothly (docs/formats.md).
BROWSER_FACES, TEXTURED_FACES = 50_000, 10_000
TEXTURE = 1024  # pixels; enough for the models
Texels = Annotated[int, Meta(ge=0, le=8192)]
Holes = Annotated[int, Meta(ge=0, le=10_000)]
Smoothing = Annotated[int, Meta(ge=0, le=1000)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
PartFraction = Annotated[float, Meta(ge=0, lt=1)]


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of a surface of Gaussians; lengths in units of the object's longest side.

    Attributes:
        method: tsdf (depth of many views, fused), density (marching cubes on 1 - prod(1 - alpha)),
            or centers (opacity-weighted centres; biased inwards, a diagnostic without volume).
        voxels: voxels per unit, of the TSDF and of the density; 8 to 1024.
        views: TSDF cameras, on a Fibonacci sphere; also used for the colours.
        pixels: side of a depth map.
        truncation: of the TSDF, in voxels.
        transmittance: depth is where a ray's transmittance has fallen to this. Fitted and predicted
            Gaussians are half transparent, so the median (0.5) is behind the surface.
        min_alpha: pixels with less have no depth.
        clear_alpha: pixels with less are empty.
        max_slope: pixels of a steeper surface, depth over width, have no depth.
        min_support: fused voxels seen by a smaller fraction of the views are dropped.
        level: the density's value at the surface.
        min_component: smaller parts are removed, as a fraction of all faces.
        min_diameter: shorter parts are removed, as a fraction of the whole's diagonal.
        largest: keep only the largest part.
        close_holes: largest number of edges of holes that are closed.
        smooth: steps of Taubin smoothing.
        faces: largest number of faces, by decimation; 0: no limit.
        colors: colour vertices from the views.
        watertight: make it the closed surface of a solid, for printing.
    """

    method: Method = "tsdf"
    voxels: Voxels = 128
    views: Views = 64
    pixels: Pixels = 256
    truncation: Annotated[float, Meta(gt=0, le=1000)] = 5.0
    transmittance: Annotated[float, Meta(gt=0, lt=1)] = 0.92
    min_alpha: Fraction = 0.3
    clear_alpha: Fraction = 0.1
    max_slope: Annotated[float, Meta(gt=0, le=1e6)] = 1.5
    min_support: Fraction = 0.03
    level: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    min_component: PartFraction = 0.01
    min_diameter: Fraction = 0.0
    largest: bool = False
    close_holes: Holes = 30
    smooth: Smoothing = 0
    faces: Faces = 0
    colors: bool = False
    watertight: bool = False

    def require(self, texture: int = 0) -> None:
        """Check that the libraries are installed, before any work.

        Args:
            texture: side of its texture, pixels; 0: none.

        Raises:
            ModuleNotFoundError: as ``versions.require``.
        """
        require("trimesh", "scipy", "pymeshlab", "open3d" if self.method == "tsdf" else "skimage")
        require(*["xatlas"] * bool(texture))
        require(*["open3d", "manifold3d"] * self.watertight)
