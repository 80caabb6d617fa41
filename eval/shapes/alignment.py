"""The alignments of a prediction with the truth that a protocol may ask for."""

from __future__ import annotations

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.gaussians import Gaussians
from gamba_warp.versions import import_open3d

from .load import Evaluated, centers
from .metrics import surface_metrics
from .protocol import GeometryProtocol
from .sample import sample
from .shape import Points, Similarity

# How far correspondences reach in each round of ICP; the truth's longest side is 1.
ICP_DISTANCES = (0.2, 0.1, 0.05)

# Turns that files are mistaken by: half ones, and quarter ones about x between y-up and z-up.
TURNS = {
    "as it is": np.eye(3),
    "180 degrees about x": np.diag([1.0, -1, -1]),
    "180 degrees about y": np.diag([-1.0, 1, -1]),
    "180 degrees about z": np.diag([-1.0, -1, 1]),
    "90 degrees about x": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-90 degrees about x": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
_FEW = 20_000  # points that are enough to tell


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


def chamfer_by_turn(
    predicted: Evaluated, truth: Evaluated, protocol: GeometryProtocol
) -> dict[str, float]:
    """Measures how the Chamfer distance changes if the prediction's file has other axes.

    The turns are about the origin of the file. Of Gaussians the centres are compared, because their
    surface is looked for near the truth alone.

    Args:
        predicted: before any alignment.
        truth: the true shape.
        protocol: says the seed; where it aligns, centroids and sizes are matched first.

    Returns:
        Distances between few points, by the key of ``TURNS``.
    """
    true = Points(sample(truth.shape, _FEW, protocol.seed).positions)
    few = (_FEW, protocol.seed + 1)
    source, found = predicted.source, {}
    of = centers(source, *few) if isinstance(source, Gaussians) else sample(source, *few)
    points = of.positions
    for name, turn in TURNS.items():
        turned = Points(predicted.motion.after(turn).points(points))
        if protocol.align != "none":
            turned = match_moments(turned, true).apply(turned)
        found[name] = surface_metrics(turned, true, ())["chamfer"]
    return found
