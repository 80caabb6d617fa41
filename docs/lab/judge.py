"""Prints the table by which weights are chosen: four sets of objects, views and shapes.

    PYTHONPATH=docs python -m lab.judge DATA MESHES MODEL...
    PYTHONPATH=docs python -m lab.judge DATA MESHES --hold-out

DATA has the views (``gamba data render``), MESHES the meshes of the sets: ``furniture128`` and
``furniture``, and so on. Of furniture the test objects count, of YCB and of the scans those of
``validation.json``, of GSO all. ``--hold-out`` keeps the objects of ``validation.json`` out of
trainings: it makes them ``val`` and all others of their sets ``train``.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch
import tyro

from gamba_warp import cli
from gamba_warp.data.dataset import SPLIT_VERSION, SPLITS, ViewDataset, open_dataset
from gamba_warp.errors import UserError
from gamba_warp.files import write_json
from gamba_warp.formats.ply import save_ply
from gamba_warp.kernels.runtime.tables import markdown
from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import posed_input
from gamba_warp.train.batches import FixedObjects, fixed_batches
from gamba_warp.train.step import Objective
from gamba_warp.train.validation import validate
from gamba_warp.untrusted.documents import read_document
from gamba_warp.vision.lpips import load_lpips

SETS = ("furniture", "ycb", "scans", "gso")
# Columns: figure of ``validate`` or of eval-geometry's mean, title, digits.
COLUMNS = (
    ("psnr_novel", "PSNR", 2),
    ("psnr_black_novel", "on black", 2),
    ("lpips_novel", "LPIPS", 3),
    ("mask_iou_novel", "mask IoU", 3),
    ("lpips_grey_far", "LPIPS > 60°", 3),
    ("lpips_black_far", "on black", 3),
    ("mask_iou_far", "mask IoU > 60°", 3),
    ("translucency_far", "translucency > 60°", 3),
    ("translucency_far_true", "true", 3),
    ("psnr_input", "input PSNR", 2),
    ("iou", "Volume IoU", 3),
    ("chamfer", "Chamfer", 4),
)


def main(
    data: tyro.conf.Positional[Path],
    meshes: tyro.conf.Positional[Path],
    models: tyro.conf.Positional[tuple[Path, ...]] = (),
    hold_out: bool = False,
    shapes: bool = True,
    sets: tuple[str, ...] = SETS,
    out: Path | None = None,
) -> None:
    """Print the table of some models, or make validation sets.

    Args:
        data: folder of the datasets.
        meshes: folder of their meshes.
        models: weights, checkpoints or run folders.
        hold_out: write ``split.json`` of the sets in ``validation.json``, and no table.
        shapes: also compare shapes, which takes most of the time.
        sets: which sets.
        out: file of all figures, JSON.
    """
    listed = read_document(Path(__file__).with_name("validation.json"), dict[str, list[str]])
    if hold_out:
        for name, uids in listed.items():
            _hold_out(data / f"{name}128", uids)
        return
    figures: dict[str, dict[str, Any]] = {}
    for path in models:
        model = load_model(path)
        for name in sets:
            begun, views = time.monotonic(), data / f"{name}128"
            dataset = open_dataset(views, "test" if name == "furniture" else "all")
            objects = [
                i for i, uid in enumerate(dataset.uids) if name not in listed or uid in listed[name]
            ]
            found = _views(model, dataset, objects)
            if shapes:
                found |= _shapes(model, dataset, objects, views, meshes / name)
            seconds = time.monotonic() - begun
            figures[f"{path.stem}, {len(objects)} of {name}"] = found | {"seconds": seconds}
    titles = [title for _, title, _ in COLUMNS]
    rows = [
        [row, *(f"{found[key]:.{digits}f}" if key in found else "" for key, _, digits in COLUMNS)]
        for row, found in figures.items()
    ]
    print(markdown(["model, objects", *titles], rows, aligned=True))
    if out is not None:
        out.write_text(json.dumps(figures, indent=1) + "\n")


def _hold_out(folder: Path, uids: list[str]) -> None:
    """Make the listed objects of a dataset ``val``, and all others ``train``."""
    known = open_dataset(folder, "all").uids
    if missing := {*uids} - {*known}:
        raise UserError(f"{folder}: lacks {', '.join(sorted(missing)[:3])}")
    parts = {split: list[str]() for split in SPLITS}
    for uid in known:
        parts["val" if uid in uids else "train"].append(uid)
    write_json(folder / "split.json", {"version": SPLIT_VERSION, **parts})
    print(f"{folder}: {len(known) - len(uids)} train, {len(uids)} val")


def _views(model: Gamba, dataset: ViewDataset, objects: list[int]) -> dict[str, float]:
    """Return the figures of a validation of these objects."""
    failures: dict[str, str] = {}
    batches = fixed_batches(FixedObjects(dataset, objects), model.config, 128, failures)
    objective = Objective(defaultdict(float), load_lpips())  # no loss, only figures
    found, _ = validate(model, batches, objective, torch.device("cpu"))
    if failures:
        raise UserError(f"unreadable: {failures}")
    return found


@torch.no_grad()
def _shapes(
    model: Gamba, dataset: ViewDataset, objects: list[int], views: Path, meshes: Path
) -> dict[str, float]:
    """Return the means of eval-geometry for these objects."""
    with tempfile.TemporaryDirectory() as folder:
        for uid in (dataset.uids[i] for i in objects):
            image, cameras = posed_input(dataset.load(uid, views=[0]), model.config)
            save_ply(Path(folder, f"{uid}.ply"), model(image, cameras)[0])
        words = [folder, meshes, "--frame", "reference", "--data", views, "--json", "--no-sheet"]
        with contextlib.redirect_stdout(io.StringIO()) as said:
            cli.run("eval-geometry", [*map(str, words), "--out", f"{folder}/report"])
    return json.loads(said.getvalue())["mean"]


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        sys.exit(f"lab.judge: {error}")
