"""A surface's colours as a picture: an atlas of its faces (xatlas), baked from the views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import UserError
from .colors import point_colors, vertex_normals
from .tsdf import Views

_PADDING = 4  # texels between the pieces of the atlas
# Many views blended blur what the surface is not exactly at; those straight in front blur least.
_POWER = 8


@dataclass
class Texture:
    """The colours of a surface as a picture.

    Attributes:
        uvs: ``[F, 3, 2]`` float64 in [0, 1], places in the picture of the corners of each face; v
            is up.
        image: ``[N, N, 3]`` float32 RGB in [0, 1] (display values), the first row on top.
    """

    uvs: np.ndarray
    image: np.ndarray


def bake_texture(
    vertices: np.ndarray, faces: np.ndarray, views: Views, voxels: int, side: int
) -> Texture:
    """Cuts a surface into an atlas and colours its texels by what the views see there.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]``.
        views: pictures and depth.
        voxels: number of voxels a unit; a view sees a texel if its depth there differs by less
            than four voxels.
        side: N of the picture, pixels.

    Raises:
        UserError: the picture is too small for the faces, or no view sees the surface.
    """
    uvs = unwrapped(vertices, faces, side)
    texels, owner, weights = covered_texels(uvs, side)
    if len(texels) == 0:
        raise UserError(f"--texture: {side} pixels are too few for {len(faces)} faces")
    normals = vertex_normals(vertices, faces)[faces[owner]]
    directions = (normals * weights[..., None]).sum(1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-12)
    positions = (vertices[faces[owner]] * weights[..., None]).sum(1)
    image = np.zeros((side * side, 3), np.float32)
    image[texels] = point_colors(positions, directions, views, voxels, _POWER)
    known = np.zeros(side * side, bool)
    known[texels] = True
    return Texture(uvs, _spread(image.reshape(side, side, 3), known.reshape(side, side)))


def unwrapped(vertices: np.ndarray, faces: np.ndarray, side: int) -> np.ndarray:
    """``[F, 3, 2]``, a place in one square for each corner; faces do not overlap there.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]``.
        side: of the picture that is to be made, pixels: by it the pieces are kept apart.
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
    """The texels whose centres lie in a face.

    Args:
        uvs: ``[F, 3, 2]``, v up.
        side: of the picture, pixels.

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
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    x = low[owner, 0] + place % size[owner, 0]
    y = low[owner, 1] + place // size[owner, 0]
    center = np.stack([x, y], 1) + 0.5
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    off = center - a[owner]
    with np.errstate(all="ignore"):  # a face without an area has no texels
        second = (off[:, 0] * ac[owner, 1] - off[:, 1] * ac[owner, 0]) / area[owner]
        third = (ab[owner, 0] * off[:, 1] - ab[owner, 1] * off[:, 0]) / area[owner]
    weights = np.stack([1 - second - third, second, third], 1)
    inside = (weights >= -1e-9).all(1)  # NaN is not
    return (y * side + x)[inside], owner[inside], weights[inside]


def _spread(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The picture with the nearest known colour at every texel, so that seams do not show."""
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return image[rows, columns]
