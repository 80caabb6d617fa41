"""``gamba eval-geometry``: predicted shapes against true ones."""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

from gamba_warp.cameras import DEFAULT_DISTANCE, intrinsics, orbit, relative_to_reference
from gamba_warp.dataset import ViewDataset, open_dataset
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder
from gamba_warp.gaussians import Gaussians
from gamba_warp.meshes import default_up, load_mesh

from .alignment import icp, match_moments
from .metrics import Points, surface_metrics, volume_iou
from .occupancy import PARITY_RULE, SOLID_RULE, grid_around, parity, solid, syncdreamer_grid
from .report import OK, check_finite, failure, print_summary, versions, write_report
from .shapes import SUFFIXES, Mesh, Shape, Similarity, load_shape, sample, visible_points
from .surfaces import Method, SurfaceOptions, to_surface

Protocol = Literal["default", "syncdreamer"]
Align = Literal["none", "scale", "icp"]
Frame = Literal["gt", "unit", "reference"]
Up = Literal["auto", "y", "z"]


@dataclass(frozen=True)
class GeometryProtocol:
    """What the numbers of ``eval-geometry`` mean. Lengths: the truth's longest side is 1.

    Attributes:
        name: preset.
        points: how points are put on surfaces.
        num_points: a shape (for area-uniform points).
        seed: of the random points; predicted and true points have different seeds.
        thresholds: of the F-score.
        occupancy: rule of the Volume IoU.
        grid: of the Volume IoU.
        iou_voxels: its voxels a unit.
        align: of predictions with the truth; anything but none makes the numbers another protocol.
        frame: in which frame predictions are (see the command).
        up: axis of the truth's files.
        surface: how Gaussians become a surface.
        normalization: of the truth.
        chamfer: definition.
        noise_floor: definition.
        normal_consistency: definition.
    """

    name: Protocol
    points: str
    occupancy: str
    grid: str
    iou_voxels: int
    num_points: int = 100_000
    seed: int = 0
    thresholds: tuple[float, ...] = (0.01, 0.02, 0.05)
    align: Align = "none"
    frame: Frame = "gt"
    up: Up = "auto"
    surface: SurfaceOptions = field(default_factory=SurfaceOptions)
    normalization: str = "truth centred on its bounding box, longest side 1, turned to z-up"
    chamfer: str = "mean of the two mean nearest distances between points, not squared"
    noise_floor: str = "chamfer between two samples of the truth itself"
    normal_consistency: str = "mean absolute cosine at nearest points, mean of both ways"


PRESETS: dict[str, dict[str, Any]] = {
    "default": {
        "points": "area-uniform on the whole surface, inner faces included",
        "occupancy": SOLID_RULE,
        "grid": "voxels around both shapes, within [-1, 1]^3",
        "iou_voxels": 64,
    },
    "syncdreamer": {
        "points": "depth maps of 16 cameras (256 pixels, focal length 280, distance 1.5, elevation "
        "30 degrees, azimuths 22.5 apart) back-projected, one mean point a voxel of 0.01",
        "occupancy": PARITY_RULE,
        "grid": "64 points a side from -1 in steps of 1/32",
        "iou_voxels": 32,
    },
}


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
    if protocol.name == "syncdreamer" and isinstance(shape, Mesh):
        return syncdreamer_points(shape)
    return sample(shape, protocol.num_points, seed)


def compare(predicted: Mesh | Points, truth: Mesh, protocol: GeometryProtocol) -> dict[str, Any]:
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
    metrics = surface_metrics(points, true_points, protocol.thresholds)
    iou = None
    if isinstance(predicted, Mesh):
        if protocol.name == "syncdreamer":
            grid, rule = syncdreamer_grid(), parity
        else:
            grid = grid_around(predicted, truth, resolution=protocol.iou_voxels)
            rule = solid
        iou = volume_iou(rule(predicted, grid), rule(truth, grid))
    other = take_points(truth, protocol, seed + 1)
    floor = surface_metrics(other, true_points, ())["chamfer"]
    return {**metrics, "iou": iou, "noise_floor": floor, **result}


def load_truth(path: Path, up: Up) -> tuple[Mesh, Similarity]:
    """A true mesh, normalised, and the motion that did it. Raises UserError."""
    mesh = load_mesh(path)
    unit, transform, scale = mesh.normalized(default_up(path) if up == "auto" else up)
    motion = Similarity(transform[:, :3], scale * transform[:, 3], scale)
    return Mesh(unit.vertices, unit.faces), motion


def out_of_reference(dataset: ViewDataset, uid: str, reference: int, distance: float) -> Similarity:
    """From the input camera's world, where a model predicts, to the dataset's. Raises UserError."""
    viewmat = dataset.load(uid, views=[reference]).cameras.viewmats[0].double()
    _, scale = relative_to_reference(viewmat[None], viewmat, distance)
    return Similarity(viewmat[:3, :3].T.numpy(), np.zeros(3), float(1 / scale))


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
    shape: Shape = load_shape(pred)
    truth, motion = load_truth(gt, protocol.up)
    shape = (motion if to_world is None else to_world).apply(shape)
    kind = {Gaussians: "gaussians", Mesh: "mesh", Points: "points"}[type(shape)]
    if isinstance(shape, Gaussians):
        shape = to_surface(shape, protocol.surface, protocol.seed, protocol.num_points)
    extracted = time.perf_counter()
    metrics = check_finite(compare(shape, truth, protocol))
    return {
        "name": name,
        "status": OK,
        **metrics,
        "kind": kind,
        "pred_closed": shape.is_closed() if isinstance(shape, Mesh) else None,
        "gt_closed": truth.is_closed(),
        "gt_sha256": hashlib.sha256(gt.read_bytes()).hexdigest()[:16],
        "gt_normalization": motion.record(),
        "seconds": {
            "surface": round(extracted - start, 3),
            "compare": round(time.perf_counter() - extracted, 3),
        },
    }


def find_pairs(pred: Path, gt: Path) -> tuple[list[tuple[str, Path, Path]], list[dict[str, str]]]:
    """Pairs of files by their path within the folders, without suffix; and who has no partner.

    Returns:
        ``(name, pred, gt)`` sorted by name, and failure records.

    Raises:
        UserError: nothing there, or a file on one side and a folder on the other.
    """
    for path in (pred, gt):
        if not path.exists():
            raise UserError(f"{path}: no such file or folder")
    if pred.is_file() and gt.is_file():
        return [(pred.stem, pred, gt)], []
    if pred.is_file() or gt.is_file():
        raise UserError(f"{pred} and {gt}: give two files or two folders")
    sides, failures = [], []
    for folder in (pred, gt):
        found: dict[str, list[Path]] = {}
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.suffix.lower() in SUFFIXES:
                key = path.relative_to(folder).with_suffix("").as_posix()
                found.setdefault(key, []).append(path)
        if not found:
            raise UserError(f"{folder}: no files of {', '.join(SUFFIXES)} in it")
        sides.append(found)
    pairs = []
    for name in sorted(sides[0].keys() | sides[1].keys()):
        files = [side.get(name, []) for side in sides]
        if all(len(some) == 1 for some in files):
            pairs.append((name, files[0][0], files[1][0]))
            continue
        missing = [kind for kind, some in zip(("prediction", "ground truth"), files) if not some]
        double = [", ".join(path.name for path in some) for some in files if len(some) > 1]
        reason = f"no {missing[0]}" if missing else f"more than one file: {double[0]}"
        failures.append(failure(name, reason))
    return pairs, failures


def eval_geometry_command(
    pred: tyro.conf.Positional[Path],
    gt: tyro.conf.Positional[Path],
    out: Path,
    protocol: Protocol = "default",
    surface: Method = "tsdf",
    align: Align = "none",
    frame: Frame = "gt",
    up: Up = "auto",
    data: Path | None = None,
    reference: int = 0,
    distance: float = DEFAULT_DISTANCE,
    points: int = 100_000,
    voxels: int = 128,
    views: int = 64,
    pixels: int = 256,
    seed: int = 0,
) -> int:
    """Chamfer distance, F-score, normal consistency and Volume IoU of shapes.

    Args:
        pred: Gaussians (.ply), a mesh or a point cloud; or a folder of them.
        gt: a mesh; or a folder, paired with PRED by name.
        out: folder for report.json and objects.csv.
        protocol: default, or syncdreamer (points that 16 cameras see, parity on a 64^3 lattice).
        surface: how Gaussians become a surface; centers is a diagnostic.
        align: of predictions with the truth before comparing; scale also moves, icp also turns.
        frame: of predictions: that of the GT file, its unit frame (z-up, longest side 1, centred),
            or the reference camera's (needs --data).
        up: upward axis of GT files; auto goes by the suffix.
        data: dataset whose objects have the same names, for --frame reference.
        reference: index of the input view, for --frame reference.
        distance: of the input camera in the model's world, for --frame reference.
        points: on each surface.
        voxels: of a unit, for surfaces of Gaussians.
        views: of the TSDF.
        pixels: side of its depth maps.
        seed: of the random points.
    """
    limits = {"points": points, "voxels": voxels, "views": views, "pixels": pixels}
    for name, value in limits.items():
        if value < 8:
            raise UserError(f"--{name} {value}: must be at least 8")
    if (frame == "reference") != (data is not None):
        raise UserError("--frame reference and --data: give both or neither")
    chosen = GeometryProtocol(
        name=protocol,
        num_points=points,
        seed=seed,
        align=align,
        frame=frame,
        up=up,
        surface=SurfaceOptions(method=surface, voxels=voxels, views=views, pixels=pixels),
        **PRESETS[protocol],
    )
    pairs, objects = find_pairs(pred, gt)
    dataset = open_dataset(data) if data is not None else None
    folder = output_folder(out)
    for name, pred_file, gt_file in tqdm(pairs, unit="object"):
        try:
            motion = None
            if frame == "unit":
                motion = Similarity(np.eye(3), np.zeros(3))
            elif dataset is not None:
                motion = out_of_reference(dataset, name, reference, distance)
            objects.append(evaluate_pair(name, pred_file, gt_file, chosen, motion))
        except (UserError, ValueError, RuntimeError) as error:
            objects.append(failure(name, error))
    report = write_report(
        folder,
        asdict(chosen) | {"pred": pred.name, "gt": gt.name},
        objects,
        versions("open3d-cpu", "open3d", "pymeshlab", "scikit-image", "trimesh"),
        left_out=("alignment", "gt_normalization"),
    )
    return print_summary(report, folder)
