"""A predicted shape against a true one: all metrics, and one object's record."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from gamba_warp.cameras import intrinsics, orbit
from gamba_warp.files import sha256

from ..report import OK, check_finite
from .alignment import icp, match_moments
from .load import load_prediction, load_truth
from .metrics import surface_metrics, volume_iou
from .occupancy import RULES, grid_around, syncdreamer_grid
from .protocol import GeometryProtocol
from .sample import halves, sample, visible_points
from .shape import Mesh, Points, Similarity


def syncdreamer_points(mesh: Mesh) -> Points:
    """What SyncDreamer's ``eval_mesh.py`` samples: the surface that 16 cameras see."""
    viewmats = orbit(np.arange(16) * 22.5, 30.0, 1.5).double().numpy()
    # from y-down, z-forward (the reference camera's world) to the truth's z-up
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    fov = 2 * math.degrees(math.atan(128 / 280))
    K = intrinsics(256, 256, fov).double().numpy()
    return visible_points(mesh, viewmats @ turn, K, 256, 0.01)


def take_points(shape: Mesh | Points, protocol: GeometryProtocol, seed: int) -> Points:
    """Points by the protocol; of a point cloud always a random draw."""
    if protocol.points == "views" and isinstance(shape, Mesh):
        return syncdreamer_points(shape)
    return sample(shape, protocol.num_points, seed)


def noise_floor(truth: Mesh | Points, protocol: GeometryProtocol, points: Points) -> float | None:
    """Chamfer distance between two samples of the truth; None of a cloud of a single point.

    Args:
        truth: the shape.
        protocol: how it is sampled.
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
        ``iou`` (None without volume), ``iou_voxel`` (side, units) and, for None, ``iou_reason``.
    """
    clouds = [n for n, s in (("prediction", predicted), ("truth", truth)) if isinstance(s, Points)]
    if clouds:
        return {"iou": None, "iou_reason": f"the {clouds[0]} is a point cloud"}
    if protocol.grid == "lattice":
        grid = syncdreamer_grid()
    else:
        grid = grid_around(predicted, truth, resolution=protocol.iou_voxels)
    rule = RULES[protocol.occupancy][1]
    iou = volume_iou(rule(predicted, grid), rule(truth, grid))
    if iou is None and grid.step > 1 / protocol.iou_voxels:
        iou = 0.0  # far apart, or one is far larger: what they share is less than a voxel
    if iou is None:
        return {"iou": None, "iou_reason": "neither shape fills a voxel", "iou_voxel": grid.step}
    return {"iou": iou, "iou_voxel": grid.step}


def compare(
    predicted: Mesh | Points, truth: Mesh | Points, protocol: GeometryProtocol
) -> dict[str, Any]:
    """All metrics of one pair, in one frame and unit, after the protocol's alignment.

    Raises:
        UserError: a shape cannot be sampled.
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


def evaluate_pair(
    name: str, pred: Path, gt: Path, protocol: GeometryProtocol, to_world: Similarity | None
) -> dict[str, Any]:
    """One object's record.

    Args:
        name: of the object.
        pred: file.
        gt: file.
        protocol: what to do.
        to_world: motion of the prediction into the truth's unit frame; None: the truth's own.

    Raises:
        UserError: a file cannot be read, or has no surface.
    """
    start = time.perf_counter()
    truth, motion = load_truth(gt, protocol)
    predicted = load_prediction(pred, motion if to_world is None else to_world, protocol)
    loaded = time.perf_counter()
    metrics = check_finite(compare(predicted.shape, truth.shape, protocol))
    return {
        "name": name,
        "status": OK,
        **metrics,
        "kind": predicted.kind,
        "pred_closed": predicted.closed(),
        "gt_closed": truth.closed(),
        "pred_flags": predicted.flags,
        "gt_flags": truth.flags,
        "pred_sha256": sha256(pred),
        "gt_sha256": sha256(gt),
        "gt_normalization": motion.record(),
        "seconds": {
            "load": round(loaded - start, 3),
            "compare": round(time.perf_counter() - loaded, 3),
        },
    }
