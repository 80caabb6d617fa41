"""gsplat's names for the pinhole path of 3D Gaussians, over our rasterizer.

The strategies and exporters are gsplat's own, and load it when used.
"""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any

from ..absent import complete
from .pixels import isect_offset_encode, isect_tiles, rasterize_to_pixels
from .projection import (
    fully_fused_projection,
    num_sh_bases,
    proj,
    spherical_harmonics,
    world_to_cam,
)
from .relocation import SelectiveAdam, adam, quat_scale_to_covar_preci, quat_to_rotmat
from .rendering import CameraModel, RasterizeMode, RenderMode, RollingShutterType, rasterization

__all__ = [
    "CameraModel",
    "RasterizeMode",
    "RenderMode",
    "RollingShutterType",
    "SelectiveAdam",
    "adam",
    "fully_fused_projection",
    "isect_offset_encode",
    "isect_tiles",
    "num_sh_bases",
    "proj",
    "quat_scale_to_covar_preci",
    "quat_to_rotmat",
    "rasterization",
    "rasterize_to_pixels",
    "spherical_harmonics",
    "world_to_cam",
]

_OF_STRATEGY = ("DefaultStrategy", "MCMCStrategy", "Strategy")
_LOSSES = (
    "create_ssim_window depth_l1_loss gaussian_density_reg gaussian_scale_reg "
    "gaussian_z_scale_reg l1_loss lidar_background_loss lidar_distance_loss "
    "lidar_intensity_loss lidar_raydrop_loss mse_loss opacity_reg_loss out_of_bound_loss "
    "scale_reg_loss ssim_loss torch_ssim_loss total_variation_loss "
)
_OF_GSPLAT = {
    **{"PngCompression": "gsplat.compression", "export_splats": "gsplat.exporter"},
    **dict.fromkeys(_LOSSES.split(), "gsplat.losses"),
}
# Which parts gsplat was built with.
has_3dgs = has_adam = has_reloc = partial(bool, True)
has_2dgs = has_3dgut = has_camera_wrappers = has_losses = partial(bool, False)
# Names of gsplat 1.5.3; in the first entry later versions' names follow.
ABSENT = complete(
    __name__,
    "gsplat",
    "only its pinhole path of 3DGS is",
    {
        "": "accumulate accumulate_2dgs fully_fused_projection_2dgs "
        "fully_fused_projection_with_ut rasterization_2dgs rasterization_2dgs_inria_wrapper "
        "rasterization_inria_wrapper rasterize_to_indices_in_range "
        "rasterize_to_indices_in_range_2dgs rasterize_to_pixels_2dgs "
        "rasterize_to_pixels_eval3d ExternalDistortionModelMeta "
        "ExternalDistortionModelParameters FusedGaussianLosses LidarTiling RendererConfig "
        "RendererConfig_MixedBatch RendererConfig_ParallelBatch "
        "RowOffsetStructuredSpinningLidarModelParameters "
        "RowOffsetStructuredSpinningLidarModelParametersExt SpinningDirection "
        "build_sparse_tile_layout color_correct_affine color_correct_quadratic "
        "compute_lidar_angles_to_columns_map compute_lidar_tiling isect_tiles_lidar "
        "isect_tiles_sparse rasterize_contributing_gaussian_ids "
        "rasterize_contributing_gaussian_ids_sparse rasterize_num_contributing_gaussians "
        "rasterize_num_contributing_gaussians_sparse rasterize_to_pixels_sparse "
        "rasterize_top_contributing_gaussian_ids "
        "rasterize_top_contributing_gaussian_ids_sparse spherical_harmonics_l0 "
        "spherical_harmonics_l1_plus",
        "compression": "PngCompression",
        "compression.png_compression": "PngCompression",
        "compression.sort": "sort_splats",
        "cuda._torch_impl": "accumulate",
        "cuda._torch_impl_2dgs": "accumulate_2dgs",
        "cuda_legacy._torch_impl": "quat_to_rotmat",
        "cuda_legacy._wrapper": "num_sh_bases",
        "cuda._wrapper": "CameraModel FThetaCameraDistortionParameters FThetaPolynomialType "
        "RollingShutterType UnscentedTransformParameters adam fully_fused_projection "
        "fully_fused_projection_2dgs fully_fused_projection_with_ut isect_offset_encode "
        "isect_tiles persp_proj proj quat_scale_to_covar_preci rasterize_to_indices_in_range "
        "rasterize_to_indices_in_range_2dgs rasterize_to_pixels rasterize_to_pixels_2dgs "
        "rasterize_to_pixels_eval3d spherical_harmonics world_to_cam",
        "distributed": "all_gather_int32 all_gather_tensor_list all_to_all_int32 "
        "all_to_all_tensor_list cli",
        "exporter": "export_splats sh2rgb sort_centers splat2ply_bytes "
        "splat2ply_bytes_compressed splat2splat_bytes",
        "optimizers": "SelectiveAdam",
        "optimizers.selective_adam": "SelectiveAdam",
        "profile": "profiler timeit",
        "rendering": "rasterization_2dgs rasterization_2dgs_inria_wrapper "
        "rasterization_inria_wrapper",
        "utils": "depth_to_normal depth_to_points get_projection_matrix inverse_log_transform "
        "log_transform normalized_quat_to_rotmat save_ply",
    },
    (*_OF_STRATEGY, *_OF_GSPLAT),
)


def __getattr__(name: str) -> Any:
    if name in _OF_STRATEGY:
        from . import strategy

        return getattr(strategy, name)
    if name in _OF_GSPLAT:
        return getattr(importlib.import_module(_OF_GSPLAT[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
