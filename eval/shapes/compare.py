"""The compare stage of an evaluation: all metrics of two shapes in one frame and unit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from gamba_warp.cameras import intrinsics, orbit

from .alignment import icp, match_moments
from .metrics import surface_metrics, volume_iou
from .occupancy import RULES, grid_around, syncdreamer_grid
from .protocol import GeometryProtocol
from .sample import halves, sample, visible_points
from .shape import Mesh, Points


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
