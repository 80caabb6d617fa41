"""Gaussians to surfaces: fused depth (TSDF), a density's level set, or the bare centres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from gamba_warp.cameras import Cameras, intrinsics
from gamba_warp.errors import UserError
from gamba_warp.gaussians import Gaussians
from gamba_warp.open3d import import_open3d

from .metrics import Points
from .occupancy import fibonacci_sphere
from .shapes import Mesh

HAZE = 0.05  # opacity that still separates inside from outside, for filling
Method = Literal["tsdf", "density", "centers"]


@dataclass(frozen=True)
class SurfaceOptions:
    """How Gaussians become a surface; lengths in units of the object's longest side.

    Attributes:
        method: tsdf (depth of many views, fused), density (marching cubes on 1 - prod(1 - alpha)),
            or centers (opacity-weighted centres; biased inwards, a diagnostic without volume).
        voxels: voxels a unit, of the TSDF and of the density.
        views: TSDF cameras, on a Fibonacci sphere.
        pixels: side of a TSDF depth map.
        truncation: of the TSDF, in voxels.
        min_alpha: pixels with less have no depth.
        min_support: fused voxels that a smaller share of the views support are dropped.
        level: of the density.
        min_component: smaller parts are removed, as a share of all faces.
    """

    method: Method = "tsdf"
    voxels: int = 128
    views: int = 64
    pixels: int = 256
    truncation: float = 5.0
    min_alpha: float = 0.5
    min_support: float = 0.1
    level: float = 0.5
    min_component: float = 0.01


def to_surface(gaussians: Gaussians, options: SurfaceOptions, seed: int, count: int):
    """One object's Gaussians to a ``Mesh``, or to ``count`` ``Points`` for the method centers.

    Raises:
        UserError: there is no surface.
    """
    if options.method == "centers":
        return centers(gaussians, count, seed)
    mesh = (tsdf if options.method == "tsdf" else density)(gaussians, options)
    return cleaned(mesh, options.min_component)


def centers(gaussians: Gaussians, count: int, seed: int) -> Points:
    """Centres drawn with a chance proportional to opacity, ``count`` times, with repetition."""
    weights = gaussians.opacities.double().cpu().numpy()
    if weights.sum() <= 0:
        raise UserError("no Gaussian has any opacity")
    chosen = np.random.default_rng(seed).choice(len(weights), count, p=weights / weights.sum())
    return Points(gaussians.means.double().cpu().numpy()[chosen])


def sphere_cameras(count: int, radius: float, pixels: int) -> Cameras:
    """Cameras around the origin that each see the whole sphere of ``radius``, and little more."""
    forward = -fibonacci_sphere(count)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    distance = 3.0 * radius
    viewmats = np.tile(np.eye(4), (count, 1, 1))
    viewmats[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    viewmats[:, 2, 3] = distance
    fov = 2 * np.degrees(np.arcsin(radius / distance))
    K = intrinsics(pixels, pixels, float(fov)).expand(count, 3, 3)
    return Cameras(torch.from_numpy(viewmats).float(), K, pixels, pixels)


@torch.no_grad()
def depth_maps(gaussians: Gaussians, cameras: Cameras, min_alpha: float) -> Tensor:
    """Expected depth ``[V, H, W]`` float32, 0 where alpha is under ``min_alpha``."""
    from gamba_warp.render import render

    maps = []
    for start in range(0, len(cameras.viewmats), 16):  # bounds the memory of one launch
        out = render(gaussians, cameras[start : start + 16].to(gaussians.means.device), depth=True)
        maps.append(torch.where(out.alpha > min_alpha, out.depth, 0.0)[..., 0].cpu())
    return torch.cat(maps)


def tsdf(gaussians: Gaussians, options: SurfaceOptions) -> Mesh:
    """Fuses rendered depth in an Open3D voxel grid and extracts its zero level.

    Raises:
        UserError: no pixel of any view is covered.
    """
    o3d = import_open3d()
    solid = gaussians.opacities > 0.05
    if not solid.any():
        raise UserError("no Gaussian has an opacity above 0.05")
    radius = float(gaussians.means[solid].norm(dim=-1).max().clamp(0.5, 1.8)) + 0.05
    cameras = sphere_cameras(options.views, radius, options.pixels)
    maps = depth_maps(gaussians, cameras, options.min_alpha)
    if not (maps > 0).any():
        raise UserError(f"no pixel of {options.views} views has alpha above {options.min_alpha}")
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32),
        attr_channels=((1,), (1,)),
        voxel_size=1.0 / options.voxels,
        block_resolution=8,
        block_count=20000,
    )
    K = o3d.core.Tensor(cameras.Ks[0].double().numpy())
    scales = {"depth_scale": 1.0, "depth_max": 6.0 * radius}
    for depth, viewmat in zip(maps, cameras.viewmats, strict=True):
        if not (depth > 0).any():
            continue
        image = o3d.t.geometry.Image(o3d.core.Tensor(depth.numpy()[..., None]))
        pose = o3d.core.Tensor(viewmat.double().numpy())
        reach = {"trunc_voxel_multiplier": float(options.truncation)}
        blocks = grid.compute_unique_block_coordinates(image, K, pose, **scales, **reach)
        grid.integrate(blocks, image, K, pose, **scales, **reach)
    support = max(1.0, options.min_support * options.views)
    mesh = grid.extract_triangle_mesh(weight_threshold=support)
    if "indices" not in mesh.triangle or len(mesh.triangle["indices"]) == 0:
        raise UserError("the fused depth has no surface")
    return Mesh(
        mesh.vertex["positions"].numpy().astype(np.float64),
        mesh.triangle["indices"].numpy().astype(np.int64),
    )


def density(gaussians: Gaussians, options: SurfaceOptions) -> Mesh:
    """Marching cubes (scikit-image) on 1 - prod(1 - alpha), its closed cavities filled.

    It fattens thin parts by about the Gaussians' own width.

    Raises:
        UserError: the density nowhere reaches the level.
    """
    from skimage.measure import marching_cubes

    volume, origin = opacity_volume(gaussians, options.voxels)
    if volume.max() <= options.level:
        raise UserError(f"the density's maximum is {volume.max():.3g}, under {options.level}")
    volume[_cavities(volume)] = 1.0
    vertices, faces, _, _ = marching_cubes(volume, options.level)
    return Mesh(origin + vertices.astype(np.float64) / options.voxels, faces.astype(np.int64))


def _cavities(volume: np.ndarray) -> np.ndarray:
    """Voxels on the inner side of a shell, bool; the first voxel is outside.

    A shell of splats leaks at the level of its surface, so what lies inside is found where even a
    faint haze closes it, and grown up to the ridge of the shell.
    """
    from skimage.measure import label
    from skimage.segmentation import watershed

    parts, count = label(volume < HAZE, connectivity=1, return_num=True)
    if count < 2:
        return np.zeros(volume.shape, bool)
    seeds = np.where(parts == parts[0, 0, 0], 1, np.where(parts > 0, 2, 0))
    return watershed(volume, seeds) == 2


def opacity_volume(gaussians: Gaussians, voxels: int) -> tuple[np.ndarray, np.ndarray]:
    """1 - prod(1 - alpha) at grid points, alpha = opacity · exp(-d²/2), d the Mahalanobis distance.

    Args:
        gaussians: one object; those outside [-1, 1]^3 are left out, alpha under 0.005 too.
        voxels: grid points a unit.

    Returns:
        ``[X, Y, Z]`` float32 with an empty margin, and the first point ``[3]``.
    """
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    gaussians = gaussians.to("cpu").detach()
    gaussians = gaussians.select(
        (gaussians.opacities > 0.005) & (gaussians.means.abs() < 1).all(-1)
    )
    if gaussians.num == 0:
        raise UserError("no visible Gaussian within [-1, 1]^3")
    axes = torch.diag_embed(gaussians.scales)
    if gaussians.quats is not None:
        axes = quaternion_to_rotation_matrix(gaussians.quats) @ axes
    reach = (2 * torch.log(gaussians.opacities / 0.005)).sqrt()[:, None] * axes.norm(dim=-1)
    half = (reach.amax(-1) * voxels).ceil().long().clamp(1, voxels)
    margin = int(half.max()) + 2
    position = gaussians.means * voxels
    first = position.amin(0).floor().long() - margin
    shape = tuple((position.amax(0).ceil().long() + margin - first + 1).tolist())
    absorbed = torch.zeros(shape).flatten()
    to_unit = torch.linalg.inv(axes)
    least, size = 0, 1
    while least < int(half.max()):  # boxes of like size together
        members = torch.nonzero((half <= size) & (half > least))[:, 0]
        for part in members.split(max(1, 2_000_000 // (2 * size + 1) ** 3)):
            _splat(absorbed, shape, gaussians, to_unit, position - first, part, size, voxels)
        least, size = size, max(size + 1, size * 5 // 4)
    return 1 - torch.exp(-absorbed.reshape(shape)).numpy(), first.numpy() / voxels


def _splat(absorbed, shape, gaussians, to_unit, position, part, size, voxels) -> None:
    """Adds -log(1 - alpha) of the Gaussians ``part``, each in a box of ``2 · size + 1`` a side."""
    span = torch.arange(-size, size + 1)
    box = torch.stack(torch.meshgrid(span, span, span, indexing="ij"), -1).reshape(-1, 3)
    points = position[part].round().long()[:, None] + box
    offset = (points - position[part][:, None]) / voxels
    squared = (offset @ to_unit[part].mT).square().sum(-1)
    alpha = gaussians.opacities[part, None] * torch.exp(-0.5 * squared)
    inside = ((points >= 0) & (points < torch.tensor(shape))).all(-1)
    index = (points[..., 0] * shape[1] + points[..., 1]) * shape[2] + points[..., 2]
    absorbed.index_add_(0, index[inside], -torch.log1p(-alpha[inside].clamp(max=0.9999)))


def cleaned(mesh: Mesh, min_component: float) -> Mesh:
    """Without duplicate and null faces and without small parts (pymeshlab).

    Args:
        mesh: any.
        min_component: parts with a smaller share of all faces go.

    Raises:
        UserError: nothing is left.
    """
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces.astype(np.int32)))
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    least = int(min_component * meshes.current_mesh().face_number())
    meshes.meshing_remove_connected_component_by_face_number(
        mincomponentsize=least, removeunref=True
    )
    kept = meshes.current_mesh()
    if kept.face_number() == 0:
        raise UserError("no part of the surface is large enough")
    return Mesh(kept.vertex_matrix(), kept.face_matrix().astype(np.int64))
