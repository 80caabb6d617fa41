"""Page of error maps: each surface painted by its distance to the other one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from gamba_warp.cameras import intrinsics, orbit
from gamba_warp.files import write_text
from gamba_warp.gaussians import Gaussians
from gamba_warp.images import load_rgba, save_image, to_uint8
from gamba_warp.pages.page import Section, page_text
from gamba_warp.surfaces.extract import Surface
from gamba_warp.surfaces.files import save_mesh
from gamba_warp.versions import import_open3d
from gamba_warp.viewer.page import write_viewer

from ..report import OK
from .shape import Mesh, Points, nearest, sample

FAR = 0.1  # distance of the last colour, in units of the truth's longest side
SIZE, GROUND = 160, 0.5  # side of a picture in pixels; grey background
_FINE, _FACES = 1 / 48, 40_000  # longest edge of a painted mesh; most faces after refinement
_DISCS = 6000  # of a surface in the viewer
# From the truth's z-up to y-down, z-forward: the reference camera's world and the viewer's.
_TO_CAMERA = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
# From dark blue over green to yellow, with increasing lightness, so also legible in grey.
_STOPS = np.array(
    [
        *((68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 145, 140)),
        *((40, 174, 128), (94, 201, 98), (173, 220, 48), (253, 231, 37)),
    ]
)


def paint(name: str, predicted: Mesh | Points, truth: Mesh | Points, folder: Path) -> None:
    """Paint a pair: NAME.png, and for both sides a viewer page and, for meshes, a ``.glb``.

    They are FOLDER/painted/NAME.html and .glb, and for the truth NAME.truth.html and .glb.

    Args:
        name: of the object; it may have slashes.
        predicted: in the truth's unit frame, aligned.
        truth: its longest side is 1.
        folder: of the report.

    Raises:
        UserError: a file cannot be written.
    """
    rows = []
    for end, shape, other in (("", predicted, truth), (".truth", truth, predicted)):
        path = folder / "painted" / f"{name}{end}.glb"
        path.parent.mkdir(parents=True, exist_ok=True)
        to = "prediction" if end else "truth"
        note = f"distance to the {to}: dark 0, yellow {FAR:g} and more of the longest side"
        view = (2.2, 34.0, 20.0)  # like the pictures
        page = path.with_suffix(".html")
        write_viewer(page, f"{name}{end}", as_discs(shape, other), view=view, note=note)
        shape = refined(shape)
        colors = colors_of(distances(shape, other))
        rows.append(np.concatenate(list(pictures(shape, colors)), 1))
        if isinstance(shape, Mesh):
            opencv = shape.vertices[:, [0, 2, 1]] * [1, -1, 1]
            save_mesh(path, Surface(opencv, shape.faces, colors / np.float32(255)))
    save_image(folder / "painted" / f"{name}.png", np.concatenate(rows))


def as_discs(shape: Mesh | Points, other: Mesh | Points) -> Gaussians:
    """Convert a surface to flat round Gaussians, painted by their distance to the other one.

    Args:
        shape: z up; a cloud without normals gives balls.
        other: z up.

    Returns:
        Gaussians ``[N]``, y down like the viewer; N is at most 6,000.
    """
    points = _evenly(shape)
    positions = points.positions
    odd = positions[min(1, len(positions) - 1) :: 2]
    gap = float(np.median(nearest(Points(odd), Points(positions[::2]))[0]))
    size = torch.full((len(positions), 3), max(0.6 * gap, 1e-3))
    quats = None
    if points.normals is not None:
        size[:, 2] /= 10
        x, y, z = (points.normals * np.where(points.normals[:, 2:] < 0, -1, 1)).T
        quats = torch.from_numpy(np.stack([1 + z, -y, x, 0 * z], 1)).float()  # z to the normal
    colors = colors_of(distances(Points(positions), other)) / 255
    discs = Gaussians(
        torch.from_numpy(positions).float(),
        quats,
        size,
        torch.full((len(positions),), 0.98),
        torch.from_numpy(colors).float(),
    )
    turn = torch.from_numpy(_TO_CAMERA).float()
    return discs.transformed(turn, torch.zeros(3))


def _evenly(shape: Mesh | Points) -> Points:
    """Sample at most ``_DISCS`` points of a shape, about equally spaced."""
    o3d = import_open3d()
    many = sample(shape, 4 * _DISCS, 0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(many.positions))
    if many.normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(many.normals)
    few = cloud.farthest_point_down_sample(min(_DISCS, len(many.positions)))
    return Points(np.asarray(few.points), None if many.normals is None else np.asarray(few.normals))


def refined(shape: Mesh | Points) -> Mesh | Points:
    """Subdivide a mesh until its edges are short enough to show errors within large faces."""
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
    """Return the distance ``[N]`` of each vertex or point to the other surface or cloud."""
    positions = shape.vertices if isinstance(shape, Mesh) else shape.positions
    if isinstance(other, Mesh):
        return other.scene().compute_distance(positions.astype(np.float32)).numpy()
    return nearest(Points(positions), other)[0]


def colors_of(distance: np.ndarray) -> np.ndarray:
    """Return colours ``[N, 3]`` uint8 of distances ``[N]``, clipped at ``FAR``."""
    level = np.clip(distance / FAR, 0, 1) * (len(_STOPS) - 1)
    steps = np.arange(len(_STOPS))
    return np.stack([np.interp(level, steps, part) for part in _STOPS.T], -1).round().astype("u1")


def pictures(shape: Mesh | Points, colors: np.ndarray) -> np.ndarray:
    """Render four views around a coloured shape, ``[4, SIZE, SIZE, 3]`` floats on grey."""
    viewmats = orbit(torch.tensor([30.0, 120.0, 210.0, 300.0]), 20.0, 2.2).double().numpy()
    viewmats[:, :3, :3] = viewmats[:, :3, :3] @ _TO_CAMERA
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
    """Write FOLDER/painted.html: objects from the best to the worst Chamfer distance.

    Args:
        report: of the evaluation.
        folder: of the files from ``paint``.
        count: number of objects, evenly spaced in that order.

    Raises:
        UserError: it cannot be written, or a picture is missing.
    """
    done = [record for record in report["objects"] if record["status"] == OK]
    done.sort(key=lambda record: record["chamfer"])
    ranks = np.unique(np.linspace(0, len(done) - 1, min(count, len(done))).round().astype(int))
    scale = np.broadcast_to(colors_of(np.linspace(0, FAR, 640)) / 255, (24, 640, 3))
    text = (
        f"Distances from 0 (dark) to {FAR:g} (yellow) and farther, in units of the truth's longest "
        "side. First the prediction by its distance to the truth, then the truth by its "
        "distance to the prediction, which shows missing parts. Each links to the surface in "
        "the viewer."
    )
    sections = [Section("", text, strip=scale)]
    for rank in ranks:
        record, name = done[rank], done[rank]["name"]
        score = ", ".join(f"{k}: {v:.3f}" for k, v in record["fscore"].items())
        iou = "" if record["iou"] is None else f", Volume IoU {record['iou']:.3f}"
        sides = [f"painted/{name}", f"painted/{name}.truth"]
        picture = to_uint8(load_rgba(folder / "painted" / f"{name}.png")[..., :3])
        rows = [np.concatenate(np.split(row, 2, axis=1)) for row in np.split(picture, 2)]
        sections.append(
            Section(
                f"{rank + 1} of {len(done)}: {name}",
                f"Chamfer {record['chamfer']:.4f}{iou}, F-score at {score}",
                links=dict(zip(sides, rows)),
                files=[f"{side}.glb" for side in sides if (folder / f"{side}.glb").is_file()],
            )
        )
    write_text(folder / "painted.html", page_text("Error maps", "", sections))
