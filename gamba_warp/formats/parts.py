"""Parts of a mesh, as its readers yield them: triangles of one material, with corner attributes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import UserError
from .materials import Material, SideFiles
from .ply_data import spread

STRAIGHT = 1e-6  # sine of the angle from which a corner turns inwards
MAX_WORK = 200_000_000  # squares of the corners of polygons with inward ones; some ten seconds


@dataclass
class Part:
    """F triangles of one material in the frame of the file.

    Attributes:
        vertices: ``[V, 3]`` float; some may be of no face.
        faces: ``[F, 3]`` int64.
        material: that of all faces; None: the file has none, like the others.
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
    """The number that is full light in colours of any type.

    Integers reach to 255, those of 16 bits to 65535; floats to 1, or to the smallest of these three
    that they fit.
    """
    if values.dtype == np.uint8:
        return 255
    top = np.nan_to_num(values, posinf=0).max(initial=0)
    if values.dtype.kind == "f" and top <= 2:  # some programs go a little over 1
        return 1
    return 65535 if values.dtype == np.uint16 or top > 255 else 255


def to_rgba8(values: np.ndarray) -> np.ndarray:
    """Makes uint8 RGBA ``[N, 4]`` of display colours ``[N, 3 or more]`` of any ``color_range``."""
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
    """Cuts polygons into triangles, in their order: convex ones as fans, others by their ears.

    A polygon that is not flat is cut as it looks along its normal; one of fewer than three corners
    gives nothing.

    Args:
        sides: whose path errors name; a warning says where ears would take too long.
        points: ``[V, 3]``.
        corners: ``[M]`` indices of points, those of all polygons one after the other.
        lengths: ``[P]``, the number of corners of each polygon.

    Returns:
        ``[F, 3]`` int64, places in ``corners``.

    Raises:
        UserError: a corner is not the number of a point.
    """
    bad = ~((corners >= 0) & (corners < len(points)) & (corners == np.rint(corners)))
    if bad.any():
        raise UserError(f"{sides.path}: a face names vertex {corners[bad][0]} of {len(points)}")
    corners, first = corners.astype(np.int64), np.cumsum(lengths) - lengths
    first, lengths = first[lengths >= 3], lengths[lengths >= 3]
    counts = lengths - 2
    step = spread(np.zeros_like(counts), counts)[:, None]
    found = np.repeat(first, counts)[:, None] + step + [0, 1, 2]
    found[:, 0] -= step[:, 0]
    if not len(lengths) or lengths.max() == 3:
        return found
    # Every corner beside those before and after it in its polygon.
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
            sides.omit("polygons that are not convex are too many: some are false")
            break
        start, count = begins[index], lengths[index]
        ears = _ears(places[start : start + count], normals[index])
        if len(ears) == counts[index]:  # else the polygon cuts itself
            found[ends[index] - counts[index] : ends[index]] = first[index] + ears
    return found


def _ears(places: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """``[F, 3]`` places in a polygon ``[n, 3]``, as it looks against a unit normal."""
    from manifold3d import triangulate

    right = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    right /= np.linalg.norm(right)
    flat = places @ np.stack([right, np.cross(normal, right)], 1)
    return np.asarray(triangulate([flat]), np.int64)


def merged(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows of ``[V, C]``, in order, and ``[V]`` the index of each row among them."""
    rows = np.asarray(vertices, np.float64) + 0.0  # -0.0 becomes 0.0
    order = np.lexsort(rows.T[::-1])  # four times as fast as np.unique of rows
    ordered = rows[order]
    new = np.ones(len(rows), bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(1)
    index = np.empty(len(rows), np.int64)
    index[order] = new.cumsum() - 1
    return ordered[new], index
