"""Sheet of predictions next to their ground truths, in two views: the worst and the best of a
report.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gamba_warp.cameras import intrinsics, orbit
from gamba_warp.files import atomic_path

from ..report import OK
from .protocol import GeometryProtocol
from .shape import Mesh, Points, Similarity

EACH = 6  # worst and best pairs of a sheet
SIDE, FOV = 176, 40.0  # pixels; degrees
AZIMUTHS, ELEVATION, DISTANCE = (-35.0, 145.0), 20.0, 2.4  # degrees; sides of the ground truth
_LABEL, _GAP = 20, 6  # pixels
# From the reference camera's world (y down, z forward) to the ground truth's, which is z-up.
_TURN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def image_of(shape: Mesh | Points) -> np.ndarray:
    """Draw a shape in its ground truth's unit frame from two sides, ``[SIDE, 2 SIDE]`` uint8 grey.

    Faces are shaded by their angle to the camera, points by their depth.
    """
    import torch

    viewmats = orbit(torch.tensor(AZIMUTHS), ELEVATION, DISTANCE).double().numpy() @ _TURN
    K = intrinsics(SIDE, SIDE, FOV).double().numpy()
    draw = _draw_mesh if isinstance(shape, Mesh) else _draw_points
    return np.hstack([draw(shape, viewmat, K) for viewmat in viewmats])


def _draw_mesh(mesh: Any, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    x, y = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    directions = pixels @ np.linalg.inv(K).T @ viewmat[:3, :3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(-viewmat[:3, :3].T @ viewmat[:3, 3], directions.shape)
    hits = mesh.scene().cast_rays(np.hstack([origins, directions]).astype(np.float32))
    facing = np.abs((hits["primitive_normals"].numpy() * directions).sum(1))
    shade = np.where(np.isfinite(hits["t_hit"].numpy()), 40 + 170 * facing, 255)
    return shade.reshape(SIDE, SIDE).astype(np.uint8)


def _draw_points(points: Any, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    camera = points.positions @ viewmat[:3, :3].T + viewmat[:3, 3]
    camera = camera[camera[:, 2] > 0.1]
    camera = camera[np.argsort(-camera[:, 2])]  # the nearest last
    column, row, _ = np.floor(camera @ K.T / camera[:, 2:]).astype(int).T
    seen = (column >= 0) & (column < SIDE) & (row >= 0) & (row < SIDE)
    shade = np.full((SIDE, SIDE), 255, np.uint8)
    shade[row[seen], column[seen]] = np.clip(camera[seen, 2] - DISTANCE + 0.7, 0, 1) * 140 + 40
    return shade


def _draw_pair(
    pair: Any, protocol: GeometryProtocol, transform: Similarity | None = None
) -> dict[str, Any]:
    """Return a record with the images of a pair, as it was compared; runs in a child."""
    from .load import FRAME_AXES, load_gt, load_prediction
    from .metrics import align_shape

    gt = load_gt(pair.gt, protocol, pair.rotation, pair.placement)
    into, axes = transform or gt.transform, FRAME_AXES.get(protocol.frame, gt.axes)
    predicted = load_prediction(pair.pred, into, axes, protocol)
    shapes = align_shape(predicted.shape, gt.shape, protocol)[0], gt.shape
    return {"name": pair.name, "status": OK, "images": np.hstack([*map(image_of, shapes)])}


def save_sheet(
    path: Path,
    objects: list[dict[str, Any]],
    pairs: list[Any],
    evaluate_pairs: Any,
) -> None:
    """Write the sheet: the worst pairs by Chamfer distance, then the best.

    Args:
        path: the file, a PNG.
        objects: records of the report.
        pairs: of the evaluation.
        evaluate_pairs: makes records of some pairs with ``evaluate``, as ``pairs.evaluate_pairs``.

    Raises:
        UserError: the file cannot be written.
    """
    done = sorted((x for x in objects if x["status"] == OK), key=lambda x: -x["chamfer"])
    chosen = done[:EACH] + done[EACH:][-EACH:]
    by_name = {pair.name: pair for pair in pairs}
    wanted = [by_name[record["name"]] for record in chosen]
    drawn = evaluate_pairs(wanted, evaluate=_draw_pair)
    images = {record["name"]: record.get("images") for record in drawn}
    high = SIDE + _LABEL + _GAP
    sheet = Image.new("L", (4 * SIDE, _LABEL + high * len(chosen)), 255)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    draw.text((4, 3), "prediction", 0, font)
    draw.text((2 * SIDE + 4, 3), "ground truth", 0, font)
    for number, record in enumerate(chosen):
        top = _LABEL + number * high
        iou = "" if record["iou"] is None else f", Volume IoU {record['iou']:.3f}"
        text = f"{record['name'][:60]}: Chamfer {record['chamfer']:.4f}{iou}"
        draw.text((4, top + 3), text.encode(errors="replace").decode(), 60, font)
        if (image := images[record["name"]]) is not None:
            sheet.paste(Image.fromarray(image), (0, top + _LABEL))
    with atomic_path(path) as temporary:
        sheet.save(temporary, format="PNG")
