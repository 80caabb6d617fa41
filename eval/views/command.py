"""``gamba eval-views``: predicted views against true ones."""

from __future__ import annotations

import json as jsonlib
import math
import sys
from pathlib import Path
from typing import Any, Literal

from gamba_warp.conventions import DEFAULT_DISTANCE
from gamba_warp.data.dataset import open_dataset
from gamba_warp.devices import pick_device
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, output_folder
from gamba_warp.fitting.config import FitConfig
from gamba_warp.fitting.objects import choose_objects

from ..report import csv_of, save_report
from .ceiling import open_ceiling
from .compare import (
    ViewsProtocol,
)
from .contact_sheet import contact_sheet
from .evaluate import Job, add_baselines, evaluate, lpips_or_reason, report_of, sheet_rows
from .predictions import open_predictions
from .table import page


def _check(
    out: Path | None, distance: float, save_gaussians: bool, both: bool, **least: tuple
) -> None:
    """Raises UserError for the first option that is out of its range."""
    for name, (value, bound) in least.items():
        if value is not None and value < bound:
            option = name.replace("_", "-")
            raise UserError(f"--{option} {value}: must be at least {bound}")
    if not (math.isfinite(distance) and distance > 0):
        raise UserError(f"--distance {distance}: must be above 0")
    if save_gaussians and out is None:
        raise UserError("--save-gaussians: needs --out")
    if both:
        raise UserError("--json and --csv: give one of them")


def _tell(report: dict[str, Any], out: Path | None, json: bool, csv: bool) -> None:
    """Prints the table, or JSON or CSV alone; what is missing goes to the error output."""
    if json:
        print(jsonlib.dumps(report, indent=2, allow_nan=False))
    elif csv:
        print(csv_of(report), end="")
    else:
        print(page(report), end="")
    for name, reason in report["left_out_baselines"].items():
        print(f"left out: {name}: {reason}", file=sys.stderr)
    for item in report["failures"]:
        print(f"failed: {item['name']}: {item['reason']}", file=sys.stderr)
    where = f"; {out / 'report.json'}" if out else ""
    counts = f"{report['num_ok']} evaluated, {report['num_failed']} failed{where}"
    print(counts, file=sys.stderr if json or csv else sys.stdout)


def eval_views_command(
    checkpoint: Path,
    data: Path,
    out: Path | None = None,
    split: Literal["all", "train", "val", "test"] = "test",
    reference: int = 0,
    views: int | None = None,
    size: int | None = None,
    limit: int | None = None,
    baselines: bool = True,
    ceiling: str | None = None,
    ceiling_steps: int = FitConfig.steps,
    lpips: bool = True,
    strips: int = 8,
    sheet: int = 2,
    save_gaussians: bool = False,
    json: bool = False,
    csv: bool = False,
    distance: float = DEFAULT_DISTANCE,
    encoder_weights: Path | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> int:
    """PSNR, SSIM, LPIPS and mask IoU of predicted views; the input view and novel views apart.

    Args:
        checkpoint: a model, or a folder of .ply files named by object.
        data: dataset of posed views.
        out: folder for report.json, objects.csv, table.md, contact_sheet.png and strips/
            (input | prediction | truth); without it the table is printed and that is all.
        split: of the dataset.
        reference: index of the input view.
        views: views an object, input included, evenly spaced; all by default.
        size: height of the pictures compared; the files' own by default.
        limit: so many objects only, evenly spaced in the order of names.
        baselines: also score an empty picture, a copy of the input, the input as a billboard, and
            the nearest training object.
        ceiling: also score Gaussians fitted to all views: of so many objects (18 s each on two
            cores, kept in OUT/ceiling), or those in a folder that gamba fit wrote.
        ceiling_steps: of each fit.
        lpips: LPIPS where its weights are there (gamba weights lpips).
        strips: comparison pictures for the first so many objects.
        sheet: so many best, median and worst objects in the contact sheet; 0 for none.
        save_gaussians: also write OUT/gaussians/NAME.ply, in the input camera's world
            (eval-geometry --frame reference reads them).
        json: print the report, as report.json holds it, in place of the table.
        csv: print the objects, as objects.csv holds them, in place of the table.
        distance: of the input camera, for .ply files; a checkpoint states its own.
        encoder_weights: the image encoder's file, for a checkpoint that does not hold it.
        device: where to run.
    """
    least = dict(views=(views, 1), size=(size, 16), limit=(limit, 1), sheet=(sheet, 0))
    _check(out, distance, save_gaussians, json and csv, **least, ceiling_steps=(ceiling_steps, 1))
    place = str(pick_device(device))
    dataset = open_dataset(data, split)
    uids = choose_objects(dataset.uids, (), limit)
    predictions = open_predictions(checkpoint, distance, place, encoder_weights)
    network, reason = lpips_or_reason(lpips, place)
    name = "VGG16, version 0.1" if network else None
    protocol = ViewsProtocol(split, reference, views, size, name, reason, predictions.distance)
    job = Job(predictions, dataset, protocol, network, place)
    folder = None if out is None else output_folder(out)
    if ceiling is not None:
        fitted = open_ceiling(ceiling, dataset, uids, protocol, place, folder, ceiling_steps)
    if baselines:
        add_baselines(job, data)
    if ceiling is not None:
        job.baselines["ceiling"] = fitted
    if folder:
        (folder / "contact_sheet.png").unlink(missing_ok=True)  # that of an earlier run
    objects, interrupted = evaluate(job, uids, folder, strips, save_gaussians)
    report = report_of(job, data, uids, objects) | {"interrupted": interrupted}
    if folder:
        save_report(report, folder)
        with atomic_path(folder / "table.md") as temporary:
            temporary.write_text(page(report))
        if sheet and report["num_ok"] and not interrupted:
            contact_sheet(folder / "contact_sheet.png", sheet_rows(job, objects, sheet))
    _tell(report, folder, json, csv)
    if interrupted:
        print("gamba: interrupted; the report has what was evaluated before", file=sys.stderr)
        return 130
    return 1 if report["failures"] else 0
