"""Polygons as triangles: fans where that is right, ear clipping where it is not."""

from __future__ import annotations

import numpy as np

from ..errors import UserError
from .materials import SideFiles

STRAIGHT = 1e-6  # sine of the angle from which a corner turns inwards
MAX_WORK = 2_000_000_000  # of a file: corners that ears are compared with; some 20 seconds
_TEST = 1000  # what one comparison costs by itself, in corners


def cut_polygons(
    sides: SideFiles, points: np.ndarray, corners: np.ndarray, lengths: np.ndarray
) -> np.ndarray:
    """``triangulated`` for a file's polygons.

    Args:
        sides: whose path errors name, and whose warnings say what is not right.
        points: as for ``triangulated``, like the others.

    Returns:
        ``[F, 3]`` int64 places in ``corners``.

    Raises:
        UserError: a corner is no point.
    """
    bad = ~((corners >= 0) & (corners < len(points)))
    if corners.dtype.kind == "f":
        bad |= corners != np.rint(corners)
    if bad.any():
        raise UserError(f"{sides.path}: a face names vertex {corners[bad][0]} of {len(points)}")
    found, exact = triangulated(points, corners, lengths)
    if not exact:
        sides.warnings.append("polygons that are not convex are too many: some are false")
    return found


def spread(starts: np.ndarray, lengths: np.ndarray, step: int = 1) -> np.ndarray:
    """``[M]`` the places of all items of lists that start at ``starts``, ``step`` apart."""
    ends = np.cumsum(lengths)
    within = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - lengths, lengths)
    return np.repeat(starts, lengths) + within * step


def triangulated(
    points: np.ndarray, corners: np.ndarray, lengths: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Cuts polygons into triangles, in their order; those of fewer than three corners give none.

    A polygon that is not flat is cut as it looks along its normal.

    Args:
        points: ``[V, 3]``.
        corners: ``[M]`` indices of points, those of all polygons one after the other.
        lengths: ``[P]``, the number of corners of each polygon.

    Returns:
        ``[F, 3]`` int64 places in ``corners``; and whether all polygons that are not convex were
        cut by ears: of very many or very long ones some may be fans.
    """
    lengths = lengths.astype(np.int64)
    first = np.cumsum(lengths) - lengths
    first, lengths = first[lengths >= 3], lengths[lengths >= 3]
    counts = lengths - 2
    start = np.zeros(len(lengths), np.int64)  # the corner around which the fan goes
    tangled = np.zeros(0, np.int64)
    inwards, axes = np.zeros(0, bool), np.zeros((0, 3))
    if len(lengths) and lengths.max() > 3:
        inwards, axes = _inward_corners(points, corners, first, lengths)
        begins = np.cumsum(lengths) - lengths
        number = np.add.reduceat(inwards, begins, dtype=np.int64)
        # From a single inward corner every other one is seen.
        owner = np.repeat(np.arange(len(lengths)), lengths)
        lone = inwards & (number == 1)[owner]
        start[owner[lone]] = np.flatnonzero(lone) - begins[owner[lone]]
        tangled = np.flatnonzero(number > 1)
    polygon = np.repeat(np.arange(len(lengths)), counts)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(counts) - counts, counts)
    fan = np.stack([np.zeros_like(step), step + 1, step + 2], 1) + start[polygon][:, None]
    found = first[polygon][:, None] + fan % lengths[polygon][:, None]
    work, ends = MAX_WORK, np.cumsum(counts)
    for index in tangled:
        places = first[index] + np.arange(lengths[index])
        ears, work = _ears(_flattened(points[corners[places]], axes[index]), work)
        found[ends[index] - counts[index] : ends[index]] = places[ears]
    return found, work > 0


def _inward_corners(
    points: np.ndarray, corners: np.ndarray, first: np.ndarray, lengths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether each corner of the polygons turns inwards, and each polygon's unit normal."""
    begins = np.cumsum(lengths) - lengths
    owner = np.repeat(np.arange(len(lengths)), lengths)
    at = np.arange(len(owner)) - begins[owner]
    after = first[owner] + (at + 1) % lengths[owner]
    here = points[corners[first[owner] + at]] - points[corners[first]][owner]
    edge = points[corners[after]] - points[corners[first]][owner] - here
    with np.errstate(all="ignore"):  # of a polygon without area no corner turns
        normals = np.add.reduceat(np.cross(here, here + edge), begins)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        edge /= np.linalg.norm(edge, axis=1, keepdims=True)
        before = np.empty_like(edge)
        before[begins[owner] + (at + 1) % lengths[owner]] = edge
        turn = (np.cross(before, edge) * normals[owner]).sum(1)
        return turn < -STRAIGHT, normals


def _flattened(places: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """``[n, 2]`` as seen against a unit normal: what runs counter-clockwise about it does so."""
    across = np.eye(3)[np.abs(normal).argmin()]
    right = np.cross(across, normal)
    right /= np.linalg.norm(right)
    return (places - places[0]) @ np.stack([right, np.cross(normal, right)], 1)


def _ears(flat: np.ndarray, work: int) -> tuple[np.ndarray, int]:
    """``[n - 2, 3]`` places in a polygon ``[n, 2]``, and what is left of the work."""
    left = list(range(len(flat)))
    x, y = flat.T.tolist()

    def turn(a: int, b: int, c: int) -> float:
        return (x[b] - x[a]) * (y[c] - y[b]) - (y[b] - y[a]) * (x[c] - x[b])

    # Only what does not turn outwards can lie in an ear.
    inner = np.array([turn(i - 1, i, (i + 1) % len(left)) <= 0 for i in left])
    found: list[tuple[int, ...]] = []
    at = tried = 0
    while len(left) > 3:
        a, b, c = left[at - 1], left[at], left[(at + 1) % len(left)]
        ear = tried >= len(left) or work <= 0  # of a polygon that cuts itself
        if not ear and turn(a, b, c) > 0:
            seen = flat[inner]
            work -= _TEST + len(seen)
            ear = not _within(seen, flat[[a, b, c]])
        if not ear:
            at, tried = (at + 1) % len(left), tried + 1
            continue
        found.append((a, b, c))
        del left[at]
        inner[b] = False
        at, tried = at % len(left), 0
        for place in (at - 1, at):
            before, here, after = left[place - 1], left[place], left[(place + 1) % len(left)]
            inner[here] = turn(before, here, after) <= 0
    return np.array([*found, left]), work


def _within(places: np.ndarray, ear: np.ndarray) -> bool:
    """Whether any of the places ``[n, 2]`` lies in a triangle, but for its corners."""
    edges = np.roll(ear, -1, 0) - ear
    off = places[:, None] - ear
    inside = (edges[:, 0] * off[..., 1] - edges[:, 1] * off[..., 0] >= 0).all(1)
    return bool((inside & (off != 0).any(2).all(1)).any())
