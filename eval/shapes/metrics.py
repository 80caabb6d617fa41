"""Comparison stage of an evaluation: alignment and metrics of two shapes in one frame and unit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from gamba_warp.cameras import intrinsics, orbit

from .align import aligned, symmetry
from .load import LoadedShape
from .occupancy import RULES, grid_around, syncdreamer_grid
from .options import ChamferForm
from .protocol import GeometryProtocol
from .shape import Mesh, Points, halves, nearest, sample, visible_points
from .table import AS_IS, MIRRORED

# Transforms by which files are often wrong: rotations by 180 degrees, between y-up and z-up, and
# the mirrors of left-handed axes.
TRANSFORMS = {
    AS_IS: np.eye(3),
    "turned by 180 degrees about x": np.diag([1.0, -1, -1]),
    "turned by 180 degrees about y": np.diag([-1.0, 1, -1]),
    "turned by 180 degrees about z": np.diag([-1.0, -1, 1]),
    "turned by 90 degrees about x": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "turned by -90 degrees about x": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    **{f"{MIRRORED} along {axis}": np.diag(1.0 - 2 * np.eye(3)[i]) for i, axis in enumerate("xyz")},
}
_FEW = 5_000  # points, enough for a warning


def compare(
    predicted: Mesh | Points, gt: Mesh | Points, protocol: GeometryProtocol
) -> dict[str, Any]:
    """Compute all metrics of one pair, after the protocol's alignment.

    Args:
        predicted: in the ground truth's unit frame.
        gt: in its unit frame.
        protocol: with the rules of points, voxels and alignment.

    Returns:
        The results of the three functions below.

    Raises:
        UserError: a shape cannot be sampled or aligned.
    """
    predicted, alignment = align_shape(predicted, gt, protocol)
    return {
        **point_metrics(predicted, gt, protocol),
        **shape_iou(predicted, gt, protocol),
        **alignment,
    }


def align_shape(
    predicted: Mesh | Points, gt: Mesh | Points, protocol: GeometryProtocol
) -> tuple[Mesh | Points, dict[str, Any]]:
    """Align a prediction by the protocol; arguments as for ``compare``.

    Returns:
        The prediction; ``alignment`` (the transform) if the protocol aligns; and ``gt_symmetry``
        (see ``align.symmetry``) if it searches for a rotation.

    Raises:
        UserError: it cannot be sampled or aligned.
    """
    if not protocol.align:
        return predicted, {}
    points, true_points = (take_points(s, protocol, protocol.seed) for s in (predicted, gt))
    transform, residual = aligned(points, true_points, protocol.align)
    record: dict[str, Any] = {"alignment": transform.record() | residual}
    if {"yaw", "turn"} & set(protocol.align):
        record["gt_symmetry"] = symmetry(true_points)
    return transform.apply(predicted), record


def point_metrics(
    predicted: Mesh | Points, gt: Mesh | Points, protocol: GeometryProtocol
) -> dict[str, Any]:
    """Compute ``surface_metrics`` of points of two shapes, and ``noise_floor``."""
    points, true_points = (take_points(s, protocol, protocol.seed) for s in (predicted, gt))
    metrics = surface_metrics(points, true_points, protocol)
    return metrics | {"noise_floor": noise_floor(gt, protocol, true_points)}


def take_points(shape: Mesh | Points, protocol: GeometryProtocol, seed: int) -> Points:
    """Sample points by the protocol's rule; from a point cloud always at random."""
    if protocol.points == "views" and isinstance(shape, Mesh):
        return syncdreamer_points(shape)
    return sample(shape, protocol.num_points, seed)


def syncdreamer_points(mesh: Mesh) -> Points:
    """Sample like SyncDreamer's ``eval_mesh.py``: the surface visible from 16 cameras."""
    viewmats = orbit(torch.arange(16) * 22.5, 30.0, 1.5).double().numpy()
    # From y-down, z-forward (the reference camera's world) to the ground truth's z-up.
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    fov = 2 * math.degrees(math.atan(128 / 280))
    K = intrinsics(256, 256, fov).double().numpy()
    return visible_points(mesh, viewmats @ turn, K, 256, 0.01)


def noise_floor(gt: Mesh | Points, protocol: GeometryProtocol, points: Points) -> float | None:
    """Return the Chamfer distance between two samples of the ground truth; None for a single point.

    Distances are computed one way only, because the two samples are exchangeable.

    Args:
        gt: the shape.
        protocol: with the sampling rule.
        points: its sample with the seed of the protocol.
    """
    if isinstance(gt, Points):
        if len(gt.positions) < 2:
            return None
        one, two = halves(gt, protocol.num_points, protocol.seed)
    else:
        one, two = points, take_points(gt, protocol, protocol.seed + 1)
    distances = protocol.unit * nearest(two, one)[0].astype(np.float64)
    return _chamfer(distances, distances, protocol.chamfer)


def shape_iou(
    predicted: Mesh | Points, gt: Mesh | Points, protocol: GeometryProtocol
) -> dict[str, Any]:
    """Compute the Volume IoU by the protocol's rule and grid.

    Returns:
        ``iou`` (None without volume), ``iou_error`` (the largest error that the voxels may cause:
        half the fraction of those at a surface of either shape), ``iou_voxel`` (the side of a
        voxel) and, if ``iou`` is None, ``iou_reason``.
    """
    if protocol.occupancy == "none":
        return {"iou": None, "iou_reason": "the protocol defines no occupancy"}
    if isinstance(predicted, Points):
        return {"iou": None, "iou_reason": "the prediction is a point cloud"}
    if isinstance(gt, Points):
        return {"iou": None, "iou_reason": "the ground truth is a point cloud"}
    if protocol.grid == "lattice":
        grid = syncdreamer_grid()
    else:
        grid = grid_around(predicted, gt, resolution=protocol.iou_voxels)
    fill = RULES[protocol.occupancy].fill
    filled = fill(predicted, grid), fill(gt, grid)
    iou = volume_iou(*filled)
    if iou is None and grid.step > 1 / protocol.iou_voxels:
        iou = 0.0  # Far apart, or of very different size: they share less than a voxel.
    if iou is None:
        return {"iou": None, "iou_reason": "neither shape fills a voxel", "iou_voxel": grid.step}
    from scipy.ndimage import binary_erosion

    edges = sum(np.count_nonzero(x & ~np.asarray(binary_erosion(x))) for x in filled)
    error = min(1.0, edges / max(1, np.count_nonzero(filled[0] | filled[1])) / 2)
    return {"iou": iou, "iou_error": error, "iou_voxel": grid.step}


def chamfer_by_transform(
    predicted: LoadedShape, gt: LoadedShape, protocol: GeometryProtocol
) -> dict[str, float]:
    """Compute the Chamfer distance with other axes for the prediction's file.

    The transforms are about the origin of the file. Gaussians are compared by their centres,
    because their surface is extracted near the ground truth only.

    Args:
        predicted: before any alignment.
        gt: the true shape.
        protocol: with the seed and the alignment, which follows each transform. If it searches all
            rotations, one mirror stands for the other transforms.

    Returns:
        Distances between few points, by the key of ``TRANSFORMS``.
    """
    true = Points(sample(gt.shape, _FEW, protocol.seed).positions)
    few = (_FEW, protocol.seed + 1)
    source, chamfers = predicted.source, {}
    of = sample(source, *few)
    points = of.positions
    searched = (AS_IS, f"{MIRRORED} along x")
    for name in searched if "turn" in protocol.align else TRANSFORMS:
        turned = Points(predicted.transform.after(TRANSFORMS[name]).points(points))
        turned = aligned(turned, true, protocol.align)[0].apply(turned)
        ways = nearest(turned, true), nearest(true, turned)
        chamfers[name] = float(np.mean([distances.mean() for distances, _ in ways]))
    return chamfers


def surface_metrics(predicted: Points, gt: Points, protocol: GeometryProtocol) -> dict:
    """Compute distances between two surfaces, by points on them.

    Args:
        predicted: at least one point.
        gt: at least one point, in the same frame; the ground truth's longest side is 1.
        protocol: with the unit, the form of the Chamfer distance and the thresholds.

    Returns:
        ``accuracy`` (mean distance from predicted to true points), ``completeness`` (true to
        predicted), ``chamfer`` (of both, in the protocol's form), ``chamfer_squared`` (mean of the
        two mean squared distances), ``fscore`` ``{str(threshold): 0..1}`` (harmonic mean of
        precision and recall), ``hausdorff`` (the largest distance of either way) and
        ``normal_consistency`` (mean absolute cosine of nearest points' normals, both ways,
        averaged; None without normals).
    """
    there, there_at = nearest(predicted, gt)
    back, back_at = nearest(gt, predicted)
    there, back = (protocol.unit * distances.astype(np.float64) for distances in (there, back))
    fscore = {}
    for threshold in protocol.thresholds:
        precision, recall = np.mean(there <= threshold), np.mean(back <= threshold)
        total = precision + recall
        fscore[f"{threshold:g}"] = float(2 * precision * recall / total) if total else 0.0
    consistency = None
    if predicted.normals is not None and gt.normals is not None:
        one = np.abs((predicted.normals * gt.normals[there_at]).sum(1)).mean()
        two = np.abs((gt.normals * predicted.normals[back_at]).sum(1)).mean()
        consistency = float(one + two) / 2
    return {
        "chamfer": _chamfer(there, back, protocol.chamfer),
        "chamfer_squared": _chamfer(there, back, "squared"),
        "accuracy": float(there.mean()),
        "completeness": float(back.mean()),
        "hausdorff": float(max(there.max(), back.max())),
        "fscore": fscore,
        "normal_consistency": consistency,
    }


def _chamfer(there: np.ndarray, back: np.ndarray, form: ChamferForm) -> float:
    if form in ("squared", "squared-sum"):
        there, back = there**2, back**2
    total = float(there.mean() + back.mean())
    return total if form in ("sum", "squared-sum") else total / 2


def volume_iou(a: np.ndarray, b: np.ndarray) -> float | None:
    """Return the intersection over union of two bool arrays; None if both are empty."""
    either = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / either) if either else None
