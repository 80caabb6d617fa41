"""Parts of a mesh that the readers yield, triangles of one material, and their common code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import UserError
from .materials import Material, SideFiles
from .ply_data import spread

STRAIGHT = 1e-6  # sine of the angle from which a corner is concave
MAX_WORK = 200_000_000  # sum of squared numbers of corners of concave polygons; some ten seconds


@dataclass
class Part:
    """F triangles of one material in the frame of the file.

    Attributes:
        vertices: ``[V, 3]`` float; some may be unused.
        faces: ``[F, 3]`` int64.
        material: of all faces; this and the following are None if the file has none.
        normals: ``[F, 3, 3]`` of any length.
        uvs: ``[F, 3, 2]``, v upwards.
        colors: ``[F, 3, 4]`` uint8 display RGBA.
    """

    vertices: np.ndarray
    faces: np.ndarray
    material: Material | None = None
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    colors: np.ndarray | None = None


def color_range(values: np.ndarray) -> int:
    """Return the number of full light in colours: 255, of 16 bits 65535.

    Of floats it is the smallest of 1, 255 and 65535 that they fit.
    """
    if values.dtype == np.uint8:
        return 255
    top = np.nan_to_num(values, posinf=0).max(initial=0)
    if values.dtype.kind == "f" and top <= 2:  # some programs go a little over 1
        return 1
    return 65535 if values.dtype == np.uint16 or top > 255 else 255


def to_rgba8(values: np.ndarray) -> np.ndarray:
    """Convert display colours ``[N, 3 or more]`` of any ``color_range`` to uint8 ``[N, 4]``."""
    out = np.full((len(values), 4), 255, np.uint8)
    values = np.asarray(values)[:, :4]
    if values.dtype != np.uint8:
        full = np.nan_to_num(values.astype(np.float64)) / color_range(values)
        values = np.clip(full, 0, 1) * 255 + 0.5
    out[:, : values.shape[1]] = values
    return out


def cut_polygons(
    sides: SideFiles, points: np.ndarray, corners: np.ndarray, lengths: np.ndarray
) -> np.ndarray:
    """Triangulate polygons, in their order: convex ones as fans, others by ear clipping.

    A polygon that is not flat is projected along its normal; one of fewer than three corners gives
    nothing.

    Args:
        sides: its path is named in errors; it is warned if ear clipping would take too long.
        points: ``[V, 3]``.
        corners: ``[M]`` indices of points, of all polygons one after the other.
        lengths: ``[P]``, number of corners of each polygon.

    Returns:
        ``[F, 3]`` int64 indices into ``corners``.

    Raises:
        UserError: a corner is not the index of a point.
    """
    fits = len(corners) == 0 or (corners.min() >= 0 and corners.max() < len(points))
    if not fits or (corners.dtype.kind == "f" and (corners != np.rint(corners)).any()):
        bad = ~((corners >= 0) & (corners < len(points)) & (corners == np.rint(corners)))
        raise UserError(f"{sides.path}: a face names vertex {corners[bad][0]} of {len(points)}")
    if (lengths == 3).all():
        return np.arange(len(corners)).reshape(-1, 3)
    corners, first = corners.astype(np.int64), np.cumsum(lengths) - lengths
    first, lengths = first[lengths >= 3], lengths[lengths >= 3]
    counts = lengths - 2
    step = spread(np.zeros_like(counts), counts)[:, None]
    triangles = np.repeat(first, counts)[:, None] + step + [0, 1, 2]
    triangles[:, 0] -= step[:, 0]
    if not len(lengths) or lengths.max() == 3:
        return triangles
    # Of every corner the next one in its polygon, and the turn between their edges.
    at, begins = spread(first, lengths), np.cumsum(lengths) - lengths
    owner = np.repeat(np.arange(len(lengths)), lengths)
    after = np.arange(1, len(at) + 1)
    after[begins + lengths - 1] = begins
    places = points[corners[at]] - points[corners[first]][owner]
    edges = places[after] - places
    with np.errstate(all="ignore"):  # of a polygon without area no corner turns
        normals = np.add.reduceat(np.cross(places, places[after]), begins)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        unit = edges / np.linalg.norm(edges, axis=1, keepdims=True)
        turns = (np.cross(unit, unit[after]) * normals[owner]).sum(1)
    work, ends = MAX_WORK, np.cumsum(counts)
    for index in np.flatnonzero(np.logical_or.reduceat(turns < -STRAIGHT, begins)):
        work -= (lengths[index] + 30) ** 2
        if work < 0:
            sides.omit("too many concave polygons: some are triangulated as if they were convex")
            break
        start, count = begins[index], lengths[index]
        ears = _ears(places[start : start + count], normals[index])
        if len(ears) == counts[index]:  # else the polygon intersects itself
            triangles[ends[index] - counts[index] : ends[index]] = first[index] + ears
    return triangles


def _ears(places: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return ``[F, 3]`` indices into a polygon ``[n, 3]``, projected along a unit normal."""
    from manifold3d import triangulate

    right = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    right /= np.linalg.norm(right)
    flat = places @ np.stack([right, np.cross(normal, right)], 1)
    return np.asarray(triangulate([flat]), np.int64)


def strip_faces(indices: np.ndarray) -> np.ndarray:
    """Return the triangles ``[F, 3]`` of strips of vertices, with one orientation.

    An index of -1 ends a strip. Triangles without area, which join strips, are left out.
    """
    at = np.arange(max(len(indices) - 2, 0))
    first = np.where(indices < 0, np.arange(1, len(indices) + 1), 0)
    odd = (at - np.maximum.accumulate(first)[: len(at)]) % 2
    faces = indices[np.stack([at, at + 1 + odd, at + 2 - odd], 1)]
    return faces[(faces != np.roll(faces, 1, 1)).all(1) & (faces >= 0).all(1)]


def merged(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct rows of ``[V, C]``, sorted, and each row's index ``[V]`` among them."""
    rows = np.asarray(vertices, np.float64) + 0.0  # -0.0 becomes 0.0
    order = np.lexsort(rows.T[::-1])  # four times as fast as np.unique of rows
    ordered = rows[order]
    new = np.ones(len(rows), bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(1)
    index = np.empty(len(rows), np.int64)
    index[order] = new.cumsum() - 1
    return ordered[new], index
