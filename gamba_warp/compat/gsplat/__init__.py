"""gsplat's names for the pinhole path of 3D Gaussians, over our rasterizer: change the import.

The strategies and the writers of files are gsplat's own and load it when they are used.
"""

from __future__ import annotations

from typing import Any

from .checks import RollingShutterType
from .pixels import rasterize_to_pixels
from .projection import fully_fused_projection
from .rendering import rasterization
from .shapes import (
    proj,
    quat_scale_to_covar_preci,
    spherical_harmonics,
    world_to_cam,
)
from .tiles import isect_offset_encode, isect_tiles

__all__ = [
    "RollingShutterType",
    "fully_fused_projection",
    "isect_offset_encode",
    "isect_tiles",
    "proj",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterize_to_pixels",
    "spherical_harmonics",
    "world_to_cam",
]

_OF_STRATEGY = ("DefaultStrategy", "MCMCStrategy", "Strategy")
_OF_GSPLAT = ("PngCompression", "export_splats")
_NOT_HERE = (
    "SelectiveAdam",
    "accumulate",
    "accumulate_2dgs",
    "fully_fused_projection_2dgs",
    "fully_fused_projection_with_ut",
    "rasterization_2dgs",
    "rasterization_2dgs_inria_wrapper",
    "rasterization_inria_wrapper",
    "rasterize_to_indices_in_range",
    "rasterize_to_indices_in_range_2dgs",
    "rasterize_to_pixels_2dgs",
    "rasterize_to_pixels_eval3d",
)


def __getattr__(name: str) -> Any:
    if name in _OF_STRATEGY:
        from . import strategy

        return getattr(strategy, name)
    if name in _OF_GSPLAT:
        import gsplat

        return getattr(gsplat, name)
    if name in _NOT_HERE:
        raise AttributeError(f"gsplat's {name} is not here: only its pinhole path of 3DGS is")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
