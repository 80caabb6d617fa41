"""Where the error lies: each surface painted by its distance to the other one, on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from gamba_warp.cameras import intrinsics, orbit
from gamba_warp.files import atomic_path, write_text
from gamba_warp.images import load_rgba, save_image
from gamba_warp.pages.page import Section, page_text

from ..report import OK
from .shape import Mesh, Points, nearest

FAR = 0.1  # distance of the last colour; the truth's longest side is 1
SIZE, GROUND = 160, 0.5  # of a picture, pixels; grey behind it
_FINE, _FACES = 1 / 48, 40_000  # longest edge of a painted mesh, while it has no more faces
# From dark blue by green to yellow, each lighter than the one before: also without colour.
_STOPS = np.array(
    [
        *((68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 145, 140)),
        *((40, 174, 128), (94, 201, 98), (173, 220, 48), (253, 231, 37)),
    ]
)


def paint(name: str, predicted: Mesh | Points, truth: Mesh | Points, folder: Path) -> None:
    """Paints a pair: FOLDER/painted/NAME.png and, of meshes, NAME.glb and NAME.truth.glb.

    Args:
        name: of the object; it may have slashes.
        predicted: in the truth's unit frame, aligned.
        truth: its longest side is 1.
        folder: of the report.

    Raises:
        UserError: a file cannot be written.
    """
    import trimesh

    rows = []
    for end, shape, other in (("", predicted, truth), (".truth", truth, predicted)):
        shape = refined(shape)
        colors = colors_of(distances(shape, other))
        rows.append(np.concatenate(list(pictures(shape, colors)), 1))
        path = folder / "painted" / f"{name}{end}.glb"
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(shape, Mesh):
            y_up = shape.vertices[:, [0, 2, 1]] * [1, 1, -1]
            made = trimesh.Trimesh(y_up, shape.faces, vertex_colors=colors, process=False)
            with atomic_path(path) as unfinished:
                made.export(unfinished, file_type="glb")
    save_image(folder / "painted" / f"{name}.png", np.concatenate(rows))


def refined(shape: Mesh | Points) -> Mesh | Points:
    """A mesh whose edges are short enough to show where on a large face the error lies."""
    from trimesh.remesh import subdivide

    while isinstance(shape, Mesh) and len(shape.faces) * 4 <= _FACES:
        corners = shape.corners()
        edges = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2)
        long = np.flatnonzero(edges.max(1) > _FINE)
        if len(long) == 0:
            break
        vertices, faces = subdivide(shape.vertices, shape.faces, long)[:2]
        shape = Mesh(np.asarray(vertices), np.asarray(faces))
    return shape


def distances(shape: Mesh | Points, other: Mesh | Points) -> np.ndarray:
    """How far each vertex or point is from the other surface, ``[N]``; from a cloud's points."""
    places = shape.vertices if isinstance(shape, Mesh) else shape.positions
    if isinstance(other, Mesh):
        return other.scene().compute_distance(places.astype(np.float32)).numpy()
    return nearest(Points(places), other)[0]


def colors_of(distance: np.ndarray) -> np.ndarray:
    """Colours ``[N, 3]`` uint8 of distances ``[N]``: the last one from ``FAR`` on."""
    place = np.clip(distance / FAR, 0, 1) * (len(_STOPS) - 1)
    steps = np.arange(len(_STOPS))
    return np.stack([np.interp(place, steps, part) for part in _STOPS.T], -1).round().astype("u1")


def pictures(shape: Mesh | Points, colors: np.ndarray) -> np.ndarray:
    """Four views around a coloured shape, ``[4, SIZE, SIZE, 3]`` floats on the grey ground."""
    viewmats = orbit(torch.tensor([30.0, 120.0, 210.0, 300.0]), 20.0, 2.2).double().numpy()
    # from y-down, z-forward (the reference camera's world) to the truth's z-up
    viewmats = viewmats @ np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    K = intrinsics(SIZE, SIZE, 34.0).double().numpy()
    if isinstance(shape, Mesh):
        return np.stack([_cast(shape, colors / 255, viewmat, K) for viewmat in viewmats])
    return np.stack([_splatted(shape, colors / 255, viewmat, K) for viewmat in viewmats])


def _cast(mesh: Mesh, colors: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    scene = mesh.scene()
    rays = scene.create_rays_pinhole(K, viewmat, SIZE, SIZE)
    found = {key: value.numpy() for key, value in scene.cast_rays(rays).items()}
    hit = np.isfinite(found["t_hit"])
    corners = mesh.faces[found["primitive_ids"][hit]]
    u, v = found["primitive_uvs"][hit].T
    weights = np.stack([1 - u - v, u, v], 1)
    directions, normals = rays.numpy()[hit][:, 3:], found["primitive_normals"][hit]
    facing = np.abs((directions * normals).sum(1)) / np.linalg.norm(directions, axis=1)
    picture = np.full((SIZE, SIZE, 3), GROUND)
    painted = (weights[..., None] * colors[corners]).sum(1)
    picture[hit] = painted * (0.45 + 0.55 * facing)[:, None]
    return picture


def _splatted(cloud: Points, colors: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    seen = cloud.positions @ viewmat[:3, :3].T + viewmat[:3, 3]
    seen, colors = seen[seen[:, 2] > 0.1], colors[seen[:, 2] > 0.1]
    order = np.argsort(-seen[:, 2])  # the nearest is drawn last
    pixels = (seen @ K.T)[order]
    at = (pixels[:, :2] / pixels[:, 2:]).astype(int).clip(0, SIZE - 1)
    picture = np.full((SIZE, SIZE, 3), GROUND)
    picture[at[:, 1], at[:, 0]] = colors[order]
    return picture


def painted_page(report: dict[str, Any], folder: Path, count: int) -> None:
    """Writes FOLDER/painted.html: objects from the best to the worst Chamfer distance.

    Args:
        report: of the evaluation.
        folder: where ``paint`` has put its files.
        count: so many objects, evenly spaced in that order.

    Raises:
        UserError: it cannot be written, or a picture is not there.
    """
    done = [record for record in report["objects"] if record["status"] == OK]
    done.sort(key=lambda record: record["chamfer"])
    places = np.unique(np.linspace(0, len(done) - 1, min(count, len(done))).round().astype(int))
    scale = np.broadcast_to(colors_of(np.linspace(0, FAR, 640)) / 255, (24, 640, 3))
    said = (
        f"Distances from 0 (dark) to {FAR:g} (yellow) and farther, in units of the truth's longest "
        "side. Upper row: the prediction by its distance to the truth; lower row: the truth by its "
        "distance to the prediction, so that what is missing shows there."
    )
    sections = [Section("", said, strip=scale)]
    for place in places:
        record, name = done[place], done[place]["name"]
        score = ", ".join(f"{k}: {v:.3f}" for k, v in record["fscore"].items())
        iou = "" if record["iou"] is None else f", Volume IoU {record['iou']:.3f}"
        files = [f"painted/{name}.glb", f"painted/{name}.truth.glb"]
        sections.append(
            Section(
                f"{place + 1} of {len(done)}: {name}",
                f"Chamfer {record['chamfer']:.4f}{iou}, F-score at {score}",
                strip=load_rgba(folder / "painted" / f"{name}.png")[..., :3],
                files=[file for file in files if (folder / file).is_file()],
            )
        )
    write_text(folder / "painted.html", page_text("Where the errors lie", "", sections))
