"""The alignments of a prediction with the truth that a protocol may ask for."""

from __future__ import annotations

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.versions import import_open3d

from .shape import Points, Similarity

# How far correspondences reach in each round of ICP; the truth's longest side is 1.
ICP_DISTANCES = (0.2, 0.1, 0.05)


def match_moments(predicted: Points, truth: Points) -> Similarity:
    """Finds the translation and scale after which centroids and mean square radii are equal.

    Args:
        predicted: points to be moved.
        truth: points to be met.

    Raises:
        UserError: the prediction is a single point.
    """
    centers = [points.positions.mean(0) for points in (predicted, truth)]
    radii = [
        np.sqrt(((points.positions - center) ** 2).sum(1).mean())
        for points, center in zip((predicted, truth), centers, strict=True)
    ]
    if radii[0] <= 0:
        raise UserError("cannot be aligned: all points are one")
    scale = float(radii[1] / radii[0])
    return Similarity(np.eye(3), centers[1] - scale * centers[0], scale)


def icp(predicted: Points, truth: Points) -> tuple[Similarity, dict[str, float]]:
    """Finds rotation, translation and scale by Open3D's point-to-point ICP.

    It starts from ``match_moments`` and finds small rotations only.

    Args:
        predicted: points to be moved.
        truth: points to be met.

    Returns:
        The motion, and Open3D's ``fitness`` (share of points with a partner) and ``inlier_rmse``.

    Raises:
        UserError: the prediction is a single point.
    """
    o3d = import_open3d()
    clouds = [
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.positions))
        for points in (predicted, truth)
    ]
    start = match_moments(predicted, truth)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = start.scale * start.rotation, start.translation
    method = o3d.pipelines.registration.TransformationEstimationPointToPoint(with_scaling=True)
    criteria = o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=100)
    for distance in ICP_DISTANCES:
        result = o3d.pipelines.registration.registration_icp(
            *clouds, distance, matrix, method, criteria
        )
        matrix = result.transformation
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    motion = Similarity(matrix[:3, :3] / scale, np.array(matrix[:3, 3]), scale)
    return motion, {"fitness": result.fitness, "inlier_rmse": result.inlier_rmse}
