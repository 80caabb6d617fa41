"""Metrics of surfaces and of volumes, as pure functions of numpy arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gamba_warp.versions import import_open3d

from .shape import Points


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
