"""``gamba eval-geometry``: predicted shapes against true ones."""

from __future__ import annotations

import json as json_module
import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from tqdm import tqdm

from gamba_warp.cameras import relative_to_reference
from gamba_warp.data.dataset import ViewDataset, open_dataset
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder
from gamba_warp.surfaces.extract import Method

from ..report import OK, csv_of, failure, make_report, print_summary, save_report, versions
from .compare import evaluate_pair
from .load import SUFFIXES
from .protocol import Align, Frame, GeometryProtocol, Up, checked, read_protocol
from .shape import Similarity


def out_of_reference(dataset: ViewDataset, uid: str, reference: int, distance: float) -> Similarity:
    """From the input camera's world, where a model predicts, to the dataset's. Raises UserError."""
    viewmat = dataset.load(uid, views=[reference]).cameras.viewmats[0].double()
    _, scale = relative_to_reference(viewmat[None], viewmat, distance)
    return Similarity(viewmat[:3, :3].T.numpy(), np.zeros(3), float(1 / scale))


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


def evaluate_pairs(
    pairs: list[tuple[str, Path, Path]], protocol: GeometryProtocol, dataset: ViewDataset | None
) -> list[dict[str, Any]]:
    """One record a pair; what goes wrong with one is its failure and stops no other.

    Args:
        pairs: ``(name, pred, gt)``.
        protocol: what to do.
        dataset: for the frame "reference".
    """
    objects = []
    for name, pred, gt in tqdm(pairs, unit="object", disable=None):
        motion = None
        try:
            if protocol.frame == "unit":
                motion = Similarity(np.eye(3), np.zeros(3))
            elif dataset is not None:
                motion = out_of_reference(dataset, name, protocol.reference, protocol.distance)
            objects.append(evaluate_pair(name, pred, gt, protocol, motion))
        except UserError as error:
            objects.append(failure(name, error))
        except Exception as error:  # whatever a library runs into, the others are still evaluated
            objects.append(failure(name, f"{type(error).__name__}: {error}"))
    return objects


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """What is printed meanwhile, by libraries too, goes to stderr; stdout is for the report."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def flag_counts(objects: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """How many evaluated shapes of each side have which flag."""
    done = [record for record in objects if record["status"] == OK]
    return {
        side: dict(Counter(flag for record in done for flag in record[f"{side}_flags"]))
        for side in ("pred", "gt")
    }


def _show(report: dict[str, Any], protocol: GeometryProtocol, folder: Path | None) -> int:
    changes = f", changed: {', '.join(protocol.changes())}" if protocol.changes() else ""
    print(f"protocol {protocol.name}{changes}")
    for side, counts in report["flags"].items():
        if counts:
            text = ", ".join(f"{count} {flag}" for flag, count in counts.items())
            print(f"{side + ' flags':<24} {text} of {report['num_ok']}")
    return print_summary(report, folder)


def _chosen(
    protocol: str, points: int | None, surface: dict[str, Any], **options: Any
) -> GeometryProtocol:
    """The protocol with the options that were given. Raises UserError."""
    base = read_protocol(protocol)
    given = {name: value for name, value in options.items() if value is not None}
    if points is not None:
        given["num_points"] = points
    nested = {name: value for name, value in surface.items() if value is not None}
    for name, value in {"points": points, **nested}.items():
        if isinstance(value, int) and value < 8:
            raise UserError(f"--{name} {value}: must be at least 8")
    return checked(replace(base, **given, surface=replace(base.surface, **nested)), "options")


def eval_geometry_command(
    pred: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PRED")],
    gt: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="GT")],
    out: Path | None = None,
    protocol: str = "default",
    surface: Method | None = None,
    align: Align | None = None,
    frame: Frame | None = None,
    up: Up | None = None,
    data: Path | None = None,
    reference: int | None = None,
    distance: float | None = None,
    points: int | None = None,
    voxels: int | None = None,
    views: int | None = None,
    pixels: int | None = None,
    seed: int | None = None,
    strict: bool = False,
    json: bool = False,
    csv: bool = False,
) -> int:
    """Chamfer distance, F-score, normal consistency and Volume IoU of shapes.

    Prints the means with 95 % intervals over objects. Options that are not given are those of the
    protocol. Exit code 1 where an object failed (each is listed), 2 where nothing could start.

    Args:
        pred: Gaussians (.ply), a mesh or a point cloud; or a folder of them.
        gt: a mesh or a point cloud; or a folder, paired with PRED by name.
        out: folder for report.json and objects.csv.
        protocol: default, syncdreamer (points that 16 cameras see, parity on a 64^3 lattice), or a
            JSON file: a protocol, or the report.json of an evaluation to repeat.
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
        strict: meshes with a flag other than "open" (not manifold, self-intersecting, inverted, …)
            are failures; else they are evaluated and flagged.
        json: print the report, as report.json holds it, in place of the summary.
        csv: print the objects, as objects.csv holds them, in place of the summary.
    """
    if json and csv:
        raise UserError("--json and --csv: give one of them")
    extraction = {"method": surface, "voxels": voxels, "views": views, "pixels": pixels}
    options = {"align": align, "frame": frame, "up": up, "reference": reference, "seed": seed}
    chosen = _chosen(
        protocol, points, extraction, **options, distance=distance, strict=strict or None
    )
    if (chosen.frame == "reference") != (data is not None):
        raise UserError("--frame reference and --data: give both or neither")
    pairs, objects = find_pairs(pred, gt)
    dataset = open_dataset(data) if data is not None else None
    folder = output_folder(out) if out is not None else None
    with stdout_to_stderr():
        objects += evaluate_pairs(pairs, chosen, dataset)
    report = make_report(
        chosen.to_json(),
        objects,
        versions("open3d-cpu", "open3d", "pymeshlab", "scikit-image", "trimesh", "numpy", "torch"),
        left_out=("alignment", "gt_normalization", "iou_voxel", "pred_closed", "gt_closed"),
        inputs={"pred": pred.name, "gt": gt.name, "data": data.name if data else None},
        flags=flag_counts(objects),
    )
    if folder is not None:
        save_report(report, folder)
    if json or csv:
        text = (
            json_module.dumps(report, indent=2, allow_nan=False) + "\n" if json else csv_of(report)
        )
        print(text, end="")
        return 1 if report["failures"] else 0
    return _show(report, chosen, folder)
