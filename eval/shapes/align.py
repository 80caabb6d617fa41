"""Alignment of a prediction with the ground truth by the steps of a protocol, in order.

The search for a rotation needs no initial guess. It scores thousands of rotations by a lattice of
nearest points instead of a tree, and refines the best of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.versions import import_open3d

from .options import Step
from .shape import Points, Similarity, nearest

STEPS: dict[Step, str] = {
    "box": "the bounding boxes get one centre and one longest side",
    "scale": "the points get one centroid and one root mean square distance from it",
    "yaw": "of 360 rotations about the upward axis, a degree apart, through the centroids, "
    "which are brought together, the one with the lowest Chamfer distance of 1,024 points",
    "turn": "of 4,096 turns about any axis through the centroids, which are brought together, the "
    "32 with the lowest Chamfer distance of 256 points and 20 degrees or more apart, each followed "
    "by 20 rounds of ICP; of these the lowest Chamfer distance of 4,096 points",
    "rigid": "ICP of Open3D, point to point, of rotation and translation; correspondences within "
    "0.2, 0.1 and 0.05 of the ground truth's longest side in turn",
    "icp": "the same with scale",
}

# Largest distance of correspondences in each round of ICP; the ground truth's longest side is 1.
ICP_DISTANCES = (0.2, 0.1, 0.05)

TURNS, CANDIDATES, ROUNDS, APART = 4096, 32, 20, 20.0  # of the search, as STEPS has them
SCORED, FOLLOWED, JUDGED = 256, 1024, 4096  # points
LATTICE = 64  # cells per side
ALIKE = 1.2  # times the least Chamfer distance, below which a rotated shape counts as the same


def aligned(
    predicted: Points, gt: Points, steps: Sequence[Step]
) -> tuple[Similarity, dict[str, float]]:
    """Compute the transform of the prediction by all steps.

    Args:
        predicted: points on the prediction.
        gt: points on the ground truth; its longest side is 1.
        steps: of ``STEPS``.

    Returns:
        The transform; and Open3D's ``fitness`` (fraction of points with a partner) and
        ``inlier_rmse`` of the last ICP.

    Raises:
        UserError: the prediction is a single point.
    """
    if steps and not np.ptp(predicted.positions, axis=0).any():
        raise UserError("cannot be aligned: the prediction's points coincide")
    transform, residual = Similarity(np.eye(3), np.zeros(3)), {}
    for step in steps:
        moved = transform.apply(predicted)
        if step in ("rigid", "icp"):
            correction, residual = icp(moved, gt, with_scale=step == "icp")
        else:
            correction = _SEARCHES[step](moved, gt)
        transform = correction.of(transform)
    return transform, residual


def match_boxes(predicted: Points, gt: Points) -> Similarity:
    """Return the translation and scale that match centre and longest side of the boxes."""
    boxes = [(p.positions.min(0), p.positions.max(0)) for p in (predicted, gt)]
    centers, sides = zip(*(((low + high) / 2, (high - low).max()) for low, high in boxes))
    return _of_size(centers, sides)


def match_moments(predicted: Points, gt: Points) -> Similarity:
    """Return the translation and scale that match centroids and mean square radii."""
    centers = [points.positions.mean(0) for points in (predicted, gt)]
    radii = [
        np.sqrt(((points.positions - center) ** 2).sum(1).mean())
        for points, center in zip((predicted, gt), centers, strict=True)
    ]
    return _of_size(centers, radii)


def _of_size(centers: Sequence[np.ndarray], sizes: Sequence[float]) -> Similarity:
    scale = float(sizes[1] / sizes[0])
    return Similarity(np.eye(3), centers[1] - scale * centers[0], scale)


def icp(predicted: Points, gt: Points, with_scale: bool) -> tuple[Similarity, dict[str, float]]:
    """Find a small rotation, a translation and optionally a scale by Open3D's ICP.

    Args:
        predicted: points to move.
        gt: target points.
        with_scale: the scale is free.

    Returns:
        The transform, and Open3D's ``fitness`` (fraction of points with a partner) and
        ``inlier_rmse``.
    """
    o3d = import_open3d()
    clouds = [
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.positions))
        for points in (predicted, gt)
    ]
    matrix = np.eye(4)
    method = o3d.pipelines.registration.TransformationEstimationPointToPoint(with_scale)
    criteria = o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=100)
    for distance in ICP_DISTANCES:
        result = o3d.pipelines.registration.registration_icp(
            *clouds, distance, matrix, method, criteria
        )
        matrix = result.transformation
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    transform = Similarity(matrix[:3, :3] / scale, np.array(matrix[:3, 3]), scale)
    return transform, {"fitness": result.fitness, "inlier_rmse": result.inlier_rmse}


def search_yaw(predicted: Points, gt: Points) -> Similarity:
    """Find the rotation about z with the lowest Chamfer distance; see ``STEPS``."""
    angles = np.radians(np.arange(360.0))
    turns = np.zeros((360, 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0] = np.sin(angles)
    turns[:, 0, 1] = -turns[:, 1, 0]
    turns[:, 2, 2] = 1
    one, two = _Cloud.of(predicted), _Cloud.of(gt)
    best = turns[_chamfer(one, two, turns, FOLLOWED).argmin()]
    return Similarity(best, two.center - best @ one.center)


def search_rotations(predicted: Points, gt: Points) -> Similarity:
    """Find the rotation about any axis with the lowest Chamfer distance; see ``STEPS``."""
    turns, moves, chamfer = _candidates(_Cloud.of(predicted), _Cloud.of(gt))
    best = chamfer.argmin()
    return Similarity(turns[best], moves[best])


_SEARCHES = {
    "box": match_boxes,
    "scale": match_moments,
    "yaw": search_yaw,
    "turn": search_rotations,
}


def symmetry(gt: Points) -> list[list[float]]:
    """Find the rotational symmetries of a shape, within the noise of a few thousand points.

    Args:
        gt: points on the shape.

    Returns:
        ``[x, y, z, degrees]`` each: a unit axis and an angle of 20 to 180 degrees; at most 31, each
        20 degrees or more from the others, by increasing Chamfer distance. A continuous symmetry
        gives some samples.
    """
    from scipy.spatial.transform import Rotation

    order = np.random.default_rng(1).permutation(len(gt.positions))
    halves = [_Cloud.of(Points(gt.positions[part])) for part in (order[::2], order[1::2])]
    turns, _, chamfer = _candidates(*halves, also=np.eye(3)[None])
    symmetries: list[list[float]] = []
    rotations = np.eye(3)[None]
    for at in chamfer.argsort():
        # The minimum belongs to the identity, up to the points' noise.
        if chamfer[at] <= ALIKE * chamfer.min() and (_degrees(turns[at], rotations) >= APART).all():
            rotations = np.concatenate([rotations, turns[at][None]])
            vector = Rotation.from_matrix(turns[at]).as_rotvec(degrees=True)
            angle = float(np.linalg.norm(vector))
            symmetries.append([round(float(x), 3) for x in (*vector / angle, angle)])
    return symmetries


class _Cloud(NamedTuple):
    """Centred points with a lattice of their nearest ones.

    Attributes:
        center: ``[3]``, their centroid.
        points: ``[N, 3]`` in random order, minus the centre.
        reach: half of the lattice's side.
        index: ``[LATTICE, LATTICE, LATTICE]``, index of a point near each cell.
    """

    center: np.ndarray
    points: np.ndarray
    reach: float
    index: np.ndarray

    @classmethod
    def of(cls, cloud: Points) -> _Cloud:
        from scipy.ndimage import distance_transform_edt

        center = cloud.positions.mean(0)
        order = np.random.default_rng(0).permutation(len(cloud.positions))
        points = cloud.positions[order] - center
        reach = max(1.25 * float(np.abs(points).max()), 1e-12)
        cell = _cells(points, reach)
        index = np.full((LATTICE,) * 3, -1)
        index[tuple(cell.T)] = np.arange(len(points))
        nearest_cell = distance_transform_edt(
            index < 0, return_distances=False, return_indices=True
        )
        return cls(center, points, reach, index[tuple(np.asarray(nearest_cell))])

    def near(self, queries: np.ndarray) -> np.ndarray:
        """Return an approximate nearest point ``[.., 3]`` for each query ``[.., 3]``."""
        cell = _cells(queries, self.reach)
        return self.points[self.index[cell[..., 0], cell[..., 1], cell[..., 2]]]


def _cells(points: np.ndarray, reach: float) -> np.ndarray:
    cell = ((points / reach + 1) * (LATTICE / 2)).astype(np.int64)
    return cell.clip(0, LATTICE - 1)


def _chamfer(one: _Cloud, two: _Cloud, turns: np.ndarray, count: int) -> np.ndarray:
    """Return Chamfer distances ``[M]`` after each rotation ``[M, 3, 3]`` of the first cloud."""
    sums = np.empty(len(turns))
    for at in range(0, len(turns), 256):  # bounds the memory
        part = turns[at : at + 256]
        there = one.points[:count] @ part.transpose(0, 2, 1)
        back = two.points[:count] @ part
        sums[at : at + 256] = _lengths(there - two.near(there)) + _lengths(back - one.near(back))
    return sums / 2


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Return mean lengths ``[M]`` of vectors ``[M, n, 3]``."""
    return np.sqrt(np.einsum("mni,mni->mn", vectors, vectors)).mean(1)


def _candidates(
    one: _Cloud, two: _Cloud, also: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the best rotations ``[C, 3, 3]``, translations ``[C, 3]``, Chamfer distances ``[C]``.

    Args:
        one: cloud to rotate.
        two: target.
        also: further initial rotations ``[.., 3, 3]``.
    """
    every = spread_rotations(TURNS)
    starts = np.empty((0, 3, 3)) if also is None else also
    for turn in every[_chamfer(one, two, every, SCORED).argsort()]:
        if len(starts) == CANDIDATES:
            break
        if (_degrees(turn, starts) >= APART).all():
            starts = np.concatenate([starts, turn[None]])
    turns, moves = starts, np.zeros((len(starts), 3))
    points = one.points[:FOLLOWED]
    for _ in range(ROUNDS):
        moved = points @ turns.transpose(0, 2, 1) + moves[:, None]
        turns, moves = _kabsch(points, two.near(moved))
    few, chamfer = Points(two.points[:JUDGED]), []
    for turn, move in zip(turns, moves):
        moved = Points(one.points[:JUDGED] @ turn.T + move)
        chamfer.append((nearest(moved, few)[0].mean() + nearest(few, moved)[0].mean()) / 2)
    return turns, moves + two.center - turns @ one.center, np.array(chamfer)


def _kabsch(points: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations ``[M, 3, 3]`` and translations ``[M, 3]`` of ``[n, 3]`` to ``[M, n, 3]``.

    Least squares by singular values (Kabsch 1976), without reflections.
    """
    middle, middles = points.mean(0), targets.mean(1)
    u, _, v = np.linalg.svd((targets - middles[:, None]).transpose(0, 2, 1) @ (points - middle))
    v[:, 2] *= np.sign(np.linalg.det(u @ v))[:, None]
    turns = u @ v
    return turns, middles - turns @ middle


def spread_rotations(count: int) -> np.ndarray:
    """Return evenly spread rotations ``[count, 3, 3]``: super-Fibonacci spirals (Alexa 2022)."""
    from scipy.spatial.transform import Rotation

    index = np.arange(count) + 0.5
    inner, outer = np.sqrt(index / count), np.sqrt(1 - index / count)
    a, b = (2 * np.pi * index / step for step in (np.sqrt(2), 1.533751168755204288118041))
    quats = [inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)]
    return Rotation.from_quat(np.stack(quats, 1)).as_matrix()


def _degrees(turn: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return angles ``[..]`` in degrees between a rotation and each of ``[.., 3, 3]``."""
    return np.degrees(np.arccos(((np.einsum("ij,mij->m", turn, others) - 1) / 2).clip(-1, 1)))
