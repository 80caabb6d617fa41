"""One predicted shape against a true one: its record for the report of ``eval-geometry``."""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gamba_warp.cameras import intrinsics, orbit
from gamba_warp.errors import UserError
from gamba_warp.gaussians import Gaussians
from gamba_warp.meshes import Y_TO_Z_UP, default_up

from .alignment import icp, match_moments
from .flags import STRICT, tidied
from .metrics import Points, surface_metrics, volume_iou
from .occupancy import RULES, grid_around, syncdreamer_grid
from .protocol import GeometryProtocol
from .report import OK, check_finite
from .shapes import Mesh, Shape, Similarity, halves, load_shape, sample, visible_points
from .surfaces import to_surface

FAR = 1e6  # units of the truth's longest side; farther out float32 holds nothing of a shape
KINDS = {Gaussians: "gaussians", Mesh: "mesh", Points: "points"}


@dataclass
class Evaluated:
    """A shape as it is compared.

    Attributes:
        shape: in the truth's unit frame.
        kind: of the file: "gaussians", "mesh" or "points".
        flags: of the mesh (for Gaussians: of their surface), names from ``flags.FLAGS``.
    """

    shape: Mesh | Points
    kind: str
    flags: list[str]

    def closed(self) -> bool | None:
        """Whether it bounds a volume; None for points."""
        return "open" not in self.flags if isinstance(self.shape, Mesh) else None


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


def unit_motion(shape: Mesh | Points, up: str) -> Similarity:
    """To z-up, centred on the bounding box, longest side 1.

    Args:
        shape: at least two places.
        up: the axis that points up, "y" or "z".

    Raises:
        UserError: it has no extent, or is so far from the origin that its numbers cannot hold it.
    """
    turn = Y_TO_Z_UP if up == "y" else np.eye(3)
    points = (shape.vertices if isinstance(shape, Mesh) else shape.positions) @ turn.T
    low, high = points.min(0), points.max(0)
    extent = (high - low).max()
    if extent <= 1e-10 * max(abs(low).max(), abs(high).max()):
        raise UserError("all its points are one, or too near to each other to tell apart")
    return Similarity(turn, -(low + high) / 2 / extent, 1 / extent)


def load_truth(path: Path, protocol: GeometryProtocol) -> tuple[Evaluated, Similarity]:
    """A true mesh or cloud in its unit frame, and the motion that brought it there.

    Raises:
        UserError: it cannot be read, is made of Gaussians, or has no extent.
    """
    shape = load_shape(path)
    if isinstance(shape, Gaussians):
        raise UserError(f"{path}: Gaussians, the truth must be a mesh or a point cloud")
    try:
        motion = unit_motion(shape, default_up(path) if protocol.up == "auto" else protocol.up)
        return _evaluated(motion.apply(shape), KINDS[type(shape)], protocol), motion
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def load_prediction(path: Path, motion: Similarity, protocol: GeometryProtocol) -> Evaluated:
    """A predicted shape, moved, its Gaussians turned into a surface.

    Args:
        path: file.
        motion: into the truth's unit frame.
        protocol: how Gaussians become a surface.

    Raises:
        UserError: it cannot be read, has no surface, or lies far away.
    """
    shape = motion.apply(load_shape(path))
    kind = KINDS[type(shape)]
    reach = _reach(shape)
    if not reach <= FAR:
        raise UserError(f"{path}: reaches {reach:.3g} times the truth's longest side")
    try:
        if isinstance(shape, Gaussians):
            shape = to_surface(shape, protocol.surface, protocol.seed, protocol.num_points)
        return _evaluated(shape, kind, protocol)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _reach(shape: Shape) -> float:
    if isinstance(shape, Gaussians):
        return float(shape.means.abs().max())
    return float(np.abs(shape.vertices if isinstance(shape, Mesh) else shape.positions).max())


def _evaluated(shape: Mesh | Points, kind: str, protocol: GeometryProtocol) -> Evaluated:
    if isinstance(shape, Points):
        return Evaluated(shape, kind, [])
    shape, flags = tidied(shape)
    if len(shape.faces) == 0:
        raise UserError("the mesh has no area")
    refused = [flag for flag in flags if flag in STRICT]
    if protocol.strict and kind == "mesh" and refused:
        raise UserError(f"--strict: {', '.join(refused)}")
    return Evaluated(shape, kind, flags)


def sha256_of(path: Path) -> str:
    """Of a file's bytes, 64 hexadecimal digits."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()


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
        "pred_sha256": sha256_of(pred),
        "gt_sha256": sha256_of(gt),
        "gt_normalization": motion.record(),
        "seconds": {
            "load": round(loaded - start, 3),
            "compare": round(time.perf_counter() - loaded, 3),
        },
    }
