"""The colours of places on a surface, from the views that see them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from .tsdf import CLEAR, Views


def vertex_colors(vertices: np.ndarray, faces: np.ndarray, views: Views, voxels: int) -> np.ndarray:
    """The mean colour of each vertex in the views that see it; those in front count most.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]``.
        views: pictures and depth.
        voxels: number of voxels a unit; a view sees a vertex if its depth there differs by less
            than four voxels.

    Returns:
        ``[V, 3]`` float32 in [0, 1]; a vertex that no view sees has the nearest one's colour.

    Raises:
        UserError: no view sees any vertex.
    """
    return point_colors(vertices, vertex_normals(vertices, faces), views, voxels)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """``[V, 3]`` float64, unit, outside."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return np.array(mesh.vertex_normals)


def point_colors(
    positions: np.ndarray, directions: np.ndarray, views: Views, voxels: int, power: int = 2
) -> np.ndarray:
    """The mean colour of places on a surface in the views that see them.

    Args:
        positions: ``[P, 3]``.
        directions: ``[P, 3]``, unit normals of the surface there, outside.
        views: pictures and depth.
        voxels: number of voxels a unit; a view sees a place if its depth there differs by less
            than four voxels.
        power: a view counts as this power of the cosine at which it sees the surface.

    Returns:
        ``[P, 3]`` float32 in [0, 1]; a place that no view sees has the nearest one's colour.

    Raises:
        UserError: no view sees any.
    """
    from scipy.spatial import KDTree

    points, normals = torch.from_numpy(positions).float(), torch.from_numpy(directions).float()
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    cameras = views.cameras
    for depth, rgb, viewmat, K in zip(views.depth, views.rgb, cameras.viewmats, cameras.Ks):
        share, color = _seen(points, normals, depth, rgb, viewmat, K, 4.0 / voxels)
        total += share**power * color
        weight += share**power
    known = weight[:, 0] > 0
    if not known.any():
        raise UserError("no view sees the surface")
    colors = (total / weight.clamp_min(1e-12)).clamp(0, 1).numpy()
    if not known.all():
        known = known.numpy()
        colors[~known] = colors[known][KDTree(positions[known]).query(positions[~known])[1]]
    return colors


def _seen(
    points: Tensor,
    normals: Tensor,
    depth: Tensor,
    rgb: Tensor,
    viewmat: Tensor,
    K: Tensor,
    near: float,
) -> tuple[Tensor, Tensor]:
    """Cosines ``[P, 1]``, 0 where one view does not see the point, and the colours ``[P, 3]``."""
    height, width = depth.shape
    seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    facing = -(normals @ viewmat[:3, :3].T * seen).sum(-1) / seen.norm(dim=-1)
    at = seen[:, :2] / seen[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    size = torch.tensor([width, height])
    pixel = at.floor().long()
    inside = ((pixel >= 0) & (pixel < size)).all(-1)
    x, y = torch.where(inside[:, None], pixel, 0).unbind(-1)
    found = depth[y, x]
    visible = inside & ((found - seen[:, 2]).abs() < near) & (found < CLEAR)
    # Between pixels' centres, of the pixels that hit something.
    hit = ((depth > 0) & (depth < CLEAR)).to(rgb)[..., None]
    picture = torch.cat([rgb * hit, hit], -1).permute(2, 0, 1)[None]
    grid = (at / size * 2 - 1)[None, None]
    sampled = torch.nn.functional.grid_sample(picture, grid, align_corners=False)[0, :, 0].T
    color = sampled[:, :3] / sampled[:, 3:].clamp_min(1e-6)
    return torch.where(visible, facing.clamp_min(0), 0)[:, None], color
