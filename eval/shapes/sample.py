"""Points on shapes, drawn at random or seen by cameras."""

from __future__ import annotations

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.versions import import_open3d

from .shape import Mesh, Points


def sample(shape: Mesh | Points, count: int, seed: int) -> Points:
    """Draws points on a shape: uniformly by area on a mesh, at most ``count`` from a cloud.

    Args:
        shape: a mesh or a cloud; a cloud of no more than ``count`` points comes back as it is.
        count: number of points.
        seed: of the draw.

    Raises:
        UserError: the mesh has no area.
    """
    if isinstance(shape, Points):
        if len(shape.positions) <= count:
            return shape
        keep = np.random.default_rng(seed).choice(len(shape.positions), count, replace=False)
        normals = None if shape.normals is None else shape.normals[keep]
        return Points(shape.positions[keep], normals)
    o3d = import_open3d()
    has_area = np.linalg.norm(shape.normals(), axis=1) > 0
    if not has_area.any():
        raise UserError("the mesh has no area")
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(shape.vertices),
        o3d.utility.Vector3iVector(shape.faces[has_area].astype(np.int32)),
    )
    o3d.utility.random.seed(seed)
    cloud = mesh.sample_points_uniformly(count, use_triangle_normal=True)
    return Points(np.asarray(cloud.points), np.asarray(cloud.normals))


def halves(points: Points, count: int, seed: int) -> tuple[Points, Points]:
    """Draws two parts of a cloud that share no point, each of at most ``count`` points.

    Args:
        points: at least two points.
        count: at least one.
        seed: of the draw.

    Returns:
        Two clouds of one size, without normals.
    """
    order = np.random.default_rng(seed).permutation(len(points.positions))
    size = min(count, len(order) // 2)
    return Points(points.positions[order[:size]]), Points(points.positions[order[-size:]])


def visible_points(
    mesh: Mesh, viewmats: np.ndarray, K: np.ndarray, size: int, voxel: float
) -> Points:
    """Back-projects depth maps of a mesh and thins the points to one mean point in each voxel.

    Args:
        mesh: what the cameras see.
        viewmats: ``[V, 4, 4]`` world to camera, OpenCV.
        K: ``[3, 3]`` intrinsics in pixels, of every camera.
        size: side of the square depth maps, pixels.
        voxel: side of a voxel, object units.

    Returns:
        Points without normals.

    Raises:
        UserError: no camera sees the mesh.
    """
    o3d = import_open3d()
    scene = mesh.scene()
    seen = []
    for viewmat in viewmats.astype(np.float64):
        rays = scene.create_rays_pinhole(K.astype(np.float64), viewmat, size, size)
        depth = scene.cast_rays(rays)["t_hit"].numpy()
        rays, hit = rays.numpy(), np.isfinite(depth)
        seen.append(rays[hit][:, :3] + depth[hit][:, None] * rays[hit][:, 3:])
    points = np.concatenate(seen)
    if len(points) == 0:
        raise UserError("no camera sees the mesh")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return Points(np.asarray(cloud.voxel_down_sample(voxel).points))
