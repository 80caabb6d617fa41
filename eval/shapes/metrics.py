"""The compare stage of an evaluation: metrics of two shapes, aligned, in one frame and unit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from gamba_warp.cameras import intrinsics, orbit
from gamba_warp.errors import UserError
from gamba_warp.gaussians import Gaussians
from gamba_warp.versions import import_open3d

from .load import Evaluated, centers
from .occupancy import RULES, grid_around, syncdreamer_grid
from .protocol import GeometryProtocol
from .shape import Mesh, Points, Similarity, halves, sample, visible_points

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


def compare(
    predicted: Mesh | Points, truth: Mesh | Points, protocol: GeometryProtocol
) -> dict[str, Any]:
    """Computes all metrics of one pair, after the protocol's alignment.

    Args:
        predicted: in the truth's unit frame.
        truth: in its unit frame.
        protocol: says how points and voxels are taken, and how the prediction is aligned.

    Returns:
        What ``surface_metrics`` and ``shape_iou`` return, ``noise_floor``, and, where the protocol
        aligns, ``alignment``.

    Raises:
        UserError: a shape cannot be sampled or aligned.
    """
    seed = 2 * protocol.seed
    true_points = take_points(truth, protocol, seed)
    points = take_points(predicted, protocol, seed + 1)
    result: dict[str, Any] = {}
    if protocol.align != "none":
        motion, residual = match_moments(points, true_points), {}
        if protocol.align == "icp":
            motion, residual = icp(points, true_points)
        predicted = motion.apply(predicted)
        points = take_points(predicted, protocol, seed + 1)
        result["alignment"] = motion.record() | residual
    return {
        **surface_metrics(points, true_points, protocol.thresholds),
        **shape_iou(predicted, truth, protocol),
        "noise_floor": noise_floor(truth, protocol, true_points),
        **result,
    }


def take_points(shape: Mesh | Points, protocol: GeometryProtocol, seed: int) -> Points:
    """Points by the protocol's rule; from a point cloud always a random draw."""
    if protocol.points == "views" and isinstance(shape, Mesh):
        return syncdreamer_points(shape)
    return sample(shape, protocol.num_points, seed)


def syncdreamer_points(mesh: Mesh) -> Points:
    """The points that SyncDreamer's ``eval_mesh.py`` takes: the surface that 16 cameras see."""
    viewmats = orbit(torch.arange(16) * 22.5, 30.0, 1.5).double().numpy()
    # from y-down, z-forward (the reference camera's world) to the truth's z-up
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    fov = 2 * math.degrees(math.atan(128 / 280))
    K = intrinsics(256, 256, fov).double().numpy()
    return visible_points(mesh, viewmats @ turn, K, 256, 0.01)


def noise_floor(truth: Mesh | Points, protocol: GeometryProtocol, points: Points) -> float | None:
    """Chamfer distance between two samples of the truth; None for a cloud of a single point.

    Args:
        truth: the shape.
        protocol: says how it is sampled.
        points: its sample with the seed ``2 * protocol.seed``.
    """
    if isinstance(truth, Points):
        if len(truth.positions) < 2:
            return None
        one, two = halves(truth, protocol.num_points, 2 * protocol.seed)
    else:
        one, two = points, take_points(truth, protocol, 2 * protocol.seed + 1)
    return surface_metrics(two, one, ())["chamfer"]


def shape_iou(
    predicted: Mesh | Points, truth: Mesh | Points, protocol: GeometryProtocol
) -> dict[str, Any]:
    """Volume IoU by the protocol's rule and grid.

    Returns:
        ``iou`` (None without volume), ``iou_voxel`` (the side of a voxel) and, where ``iou`` is
        None, ``iou_reason``.
    """
    if isinstance(predicted, Points):
        return {"iou": None, "iou_reason": "the prediction is a point cloud"}
    if isinstance(truth, Points):
        return {"iou": None, "iou_reason": "the truth is a point cloud"}
    if protocol.grid == "lattice":
        grid = syncdreamer_grid()
    else:
        grid = grid_around(predicted, truth, resolution=protocol.iou_voxels)
    fill = RULES[protocol.occupancy].fill
    iou = volume_iou(fill(predicted, grid), fill(truth, grid))
    if iou is None and grid.step > 1 / protocol.iou_voxels:
        iou = 0.0  # They are far apart, or one is far larger: they share less than a voxel.
    if iou is None:
        return {"iou": None, "iou_reason": "neither shape fills a voxel", "iou_voxel": grid.step}
    return {"iou": iou, "iou_voxel": grid.step}


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


def nearest(queries: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the nearest of ``points [M, 3]`` to each of ``queries [N, 3]``, in float32.

    Returns:
        Distances ``[N]`` float32 and indices ``[N]``.
    """
    o3d = import_open3d()
    search = o3d.core.nns.NearestNeighborSearch(np.ascontiguousarray(points, np.float32))
    search.knn_index()
    indices, squared = search.knn_search(np.ascontiguousarray(queries, np.float32), 1)
    return np.sqrt(squared.numpy()[:, 0]), indices.numpy()[:, 0]


def surface_metrics(
    predicted: Points, truth: Points, thresholds: Sequence[float] = (0.01, 0.02, 0.05)
) -> dict:
    """Measures how far two surfaces are apart, by points on them.

    Args:
        predicted: at least one point.
        truth: at least one point, in the same frame and unit.
        thresholds: distances for the F-score, in the same unit.

    Returns:
        ``accuracy`` (mean distance from predicted to true points), ``completeness`` (from true to
        predicted), ``chamfer`` (mean of the two, distances not squared), ``chamfer_squared`` (mean
        of the two mean squared distances), ``fscore`` ``{str(threshold): 0..1}`` (harmonic mean of
        precision and recall), ``hausdorff`` (the largest distance of either way) and
        ``normal_consistency`` (mean absolute cosine of nearest points' normals, both ways,
        averaged; None without normals).
    """
    there, there_at = nearest(predicted.positions, truth.positions)
    back, back_at = nearest(truth.positions, predicted.positions)
    fscore = {}
    for threshold in thresholds:
        precision, recall = np.mean(there <= threshold), np.mean(back <= threshold)
        total = precision + recall
        fscore[f"{threshold:g}"] = float(2 * precision * recall / total) if total else 0.0
    consistency = None
    if predicted.normals is not None and truth.normals is not None:
        one = np.abs((predicted.normals * truth.normals[there_at]).sum(1)).mean()
        two = np.abs((truth.normals * predicted.normals[back_at]).sum(1)).mean()
        consistency = float(one + two) / 2
    there, back = there.astype(np.float64), back.astype(np.float64)
    return {
        "chamfer": float(there.mean() + back.mean()) / 2,
        "chamfer_squared": float((there**2).mean() + (back**2).mean()) / 2,
        "accuracy": float(there.mean()),
        "completeness": float(back.mean()),
        "hausdorff": float(max(there.max(), back.max())),
        "fscore": fscore,
        "normal_consistency": consistency,
    }


def volume_iou(a: np.ndarray, b: np.ndarray) -> float | None:
    """Intersection over union of two bool arrays of one shape; None where both are empty."""
    either = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / either) if either else None
