"""Colours of a surface from rendered views, at points or as a texture atlas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from .tsdf import CLEAR, Views

_PADDING = 4  # texels between the pieces of the atlas


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals ``[V, 3]`` float64 that point outside."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return np.array(mesh.vertex_normals)


def point_colors(
    positions: np.ndarray, directions: np.ndarray, views: Views, voxels: int
) -> np.ndarray:
    """Return the mean colour of surface points over the views that see them, weighted by the angle.

    Args:
        positions: ``[P, 3]``.
        directions: ``[P, 3]``, unit normals of the surface there, outside.
        views: images and depth.
        voxels: number of voxels per unit; a view sees a point if its depth there differs by less
            than four voxels.

    Returns:
        ``[P, 3]`` float32 in [0, 1]; an unseen point has the nearest seen one's colour.

    Raises:
        UserError: no view sees any point.
    """
    from scipy.spatial import KDTree

    points, normals = torch.from_numpy(positions).float(), torch.from_numpy(directions).float()
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    cameras = views.cameras
    for depth, rgb, viewmat, K in zip(views.depth, views.rgb, cameras.viewmats, cameras.Ks):
        rays = points + viewmat[:3, :3].T @ viewmat[:3, 3]
        cosines = -(normals * rays).sum(-1) / rays.norm(dim=-1)
        facing = torch.nonzero(cosines > 0)[:, 0]
        visible, color = _seen(points[facing], depth, rgb, viewmat, K, 4.0 / voxels)
        fraction = (visible * cosines[facing] ** 2)[:, None]
        total.index_add_(0, facing, fraction * color)
        weight.index_add_(0, facing, fraction)
    known = weight[:, 0] > 0
    if not known.any():
        raise UserError("no view sees the surface")
    colors = (total / weight.clamp_min(1e-12)).clamp(0, 1).numpy()
    if not known.all():
        known = known.numpy()
        colors[~known] = colors[known][KDTree(positions[known]).query(positions[~known])[1]]
    return colors


def _seen(
    points: Tensor, depth: Tensor, rgb: Tensor, viewmat: Tensor, K: Tensor, near: float
) -> tuple[Tensor, Tensor]:
    """Return which points a view sees, ``[P]`` bool, and their colours ``[P, 3]``."""
    height, width = depth.shape
    seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    at = seen[:, :2] / seen[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    size = torch.tensor([width, height])
    pixel = at.floor().long()
    inside = ((pixel >= 0) & (pixel < size)).all(-1)
    x, y = torch.where(inside[:, None], pixel, 0).unbind(-1)
    view_depth = depth[y, x]
    visible = inside & ((view_depth - seen[:, 2]).abs() < near) & (view_depth < CLEAR)
    # Interpolated between the centres of pixels that hit the object.
    hit = ((depth > 0) & (depth < CLEAR)).to(rgb)[..., None]
    image = torch.cat([rgb * hit, hit], -1).permute(2, 0, 1)[None]
    grid = (at / size * 2 - 1)[None, None]
    sampled = torch.nn.functional.grid_sample(image, grid, align_corners=False)[0, :, 0].T
    color = sampled[:, :3] / sampled[:, 3:].clamp_min(1e-6)
    return visible, color


@dataclass
class Texture:
    """Colours of a surface as an image.

    Attributes:
        uvs: ``[F, 3, 2]`` float64 in [0, 1], positions of each face's corners in the image; v is
            up.
        image: ``[N, N, 3]`` float32 RGB in [0, 1] (display values), the first row on top.
    """

    uvs: np.ndarray
    image: np.ndarray


def bake_texture(
    vertices: np.ndarray, faces: np.ndarray, views: Views, voxels: int, side: int
) -> Texture:
    """Unwrap a surface into an atlas and colour its texels from the views.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]``.
        views: images and depth.
        voxels: number of voxels a unit; a view sees a texel if its depth there differs by less
            than four voxels.
        side: N of the image, pixels.

    Raises:
        UserError: the image is too small for the faces, or no view sees the surface.
    """
    from scipy.ndimage import distance_transform_edt

    uvs = unwrapped(vertices, faces, side)
    texels, owner, weights = covered_texels(uvs, side)
    if len(texels) == 0:
        raise UserError(f"--texture: {side} pixels are too few for {len(faces)} faces")
    normals = vertex_normals(vertices, faces)[faces[owner]]
    directions = (normals * weights[..., None]).sum(1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-12)
    positions = (vertices[faces[owner]] * weights[..., None]).sum(1)
    image = np.zeros((side * side, 3), np.float32)
    image[texels] = point_colors(positions, directions, views, voxels)
    known = np.zeros(side * side, bool)
    known[texels] = True
    # Empty texels get the nearest known colour, to hide seams.
    missing = ~known.reshape(side, side)
    indices = distance_transform_edt(missing, return_distances=False, return_indices=True)
    rows, columns = cast("tuple[np.ndarray, np.ndarray]", indices)
    return Texture(uvs, image.reshape(side, side, 3)[rows, columns])


def unwrapped(vertices: np.ndarray, faces: np.ndarray, side: int) -> np.ndarray:
    """Return texture coordinates ``[F, 3, 2]`` of each corner; faces do not overlap.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]``.
        side: of the texture, pixels, which sets the padding between charts.
    """
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.create_image = side, _PADDING, False
    atlas.generate(xatlas.ChartOptions(), options)
    _, corners, uvs = atlas[0]
    return np.clip(uvs[corners].astype(np.float64), 0, 1)


def covered_texels(uvs: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the texels whose centres are in a face.

    Args:
        uvs: ``[F, 3, 2]``, v up.
        side: of the image, pixels.

    Returns:
        ``[T]`` the texels, row by row from the top, ``[T]`` the face of each, and ``[T, 3]`` the
        weights of its corners.
    """
    corners = np.stack([uvs[..., 0], 1 - uvs[..., 1]], -1) * side
    low = np.floor(corners.min(1) - 0.5).astype(np.int64).clip(0, side - 1)
    high = np.ceil(corners.max(1) - 0.5).astype(np.int64).clip(0, side - 1)
    size = high - low + 1
    counts = size.prod(1)
    owner = np.repeat(np.arange(len(uvs)), counts)
    index = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    x = low[owner, 0] + index % size[owner, 0]
    y = low[owner, 1] + index // size[owner, 0]
    center = np.stack([x, y], 1) + 0.5
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    off = center - a[owner]
    with np.errstate(all="ignore"):  # a face without an area has no texels
        second = (off[:, 0] * ac[owner, 1] - off[:, 1] * ac[owner, 0]) / area[owner]
        third = (ab[owner, 0] * off[:, 1] - ab[owner, 1] * off[:, 0]) / area[owner]
    weights = np.stack([1 - second - third, second, third], 1)
    inside = (weights >= -1e-9).all(1)  # False for NaN
    return (y * side + x)[inside], owner[inside], weights[inside]
