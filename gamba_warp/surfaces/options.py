"""How Gaussians become a surface; imports nothing that is slow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..errors import UserError

Method = Literal["tsdf", "density", "centers"]


@dataclass(frozen=True)
class SurfaceOptions:
    """How Gaussians become a surface; lengths in units of the object's longest side.

    Attributes:
        method: tsdf (depth of many views, fused), density (marching cubes on 1 - prod(1 - alpha)),
            or centers (opacity-weighted centres; biased inwards, a diagnostic without volume).
        voxels: voxels a unit, of the TSDF and of the density; 8 to 1024.
        views: TSDF cameras, on a Fibonacci sphere; also those of the colours.
        pixels: side of a depth map.
        truncation: distance at which the TSDF is cut off, in voxels.
        transmittance: depth is where a ray's transmittance has fallen to this. Fitted and predicted
            Gaussians are half transparent, so the median (0.5) lies behind the surface.
        min_alpha: pixels with less have no depth.
        clear_alpha: pixels with less say that nothing is there.
        max_slope: pixels of a steeper surface, depth over width, have no depth.
        min_support: fused voxels that a smaller share of the views support are dropped.
        level: the density's value at the surface.
        min_component: smaller parts are removed, as a share of all faces.
        min_diameter: shorter parts are removed, as a share of the whole's diagonal.
        largest: only the largest part is kept.
        close_holes: holes with at most so many edges are closed.
        smooth: steps of Taubin smoothing.
        faces: at most so many, by decimation; 0: as many as there are.
        colors: give vertices the colour that the views show.
    """

    method: Method = "tsdf"
    voxels: int = 128
    views: int = 64
    pixels: int = 256
    truncation: float = 5.0
    transmittance: float = 0.92
    min_alpha: float = 0.3
    clear_alpha: float = 0.1
    max_slope: float = 1.5
    min_support: float = 0.03
    level: float = 0.5
    min_component: float = 0.01
    min_diameter: float = 0.0
    largest: bool = False
    close_holes: int = 30
    smooth: int = 0
    faces: int = 0
    colors: bool = False

    def check(self) -> None:
        """Checks the ranges of the numbers.

        Raises:
            UserError: a number is out of its range; the message names the option.
        """
        bounds = {
            "voxels": (8, 1024),
            "views": (8, 1000),
            "pixels": (8, 4096),
            "close_holes": (0, 10000),
            "smooth": (0, 1000),
            "faces": (0, 2**31 - 1),
        }
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise UserError(f"--{name.replace('_', '-')}: {low} to {high} are possible")
