"""``gamba eval-views``: predicted views against true ones, beside baselines that need no model."""

from __future__ import annotations

import hashlib
import json as jsonlib
import math
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from tqdm import tqdm

from gamba_warp.cameras import DEFAULT_DISTANCE
from gamba_warp.dataset import ViewDataset, open_dataset
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, output_folder
from gamba_warp.fit import FitConfig
from gamba_warp.fit_command import choose_objects
from gamba_warp.gaussians import Gaussians
from gamba_warp.images import save_image
from gamba_warp.lpips import FETCH, LPIPS, load_lpips, lpips_available
from gamba_warp.ply import save_ply
from gamba_warp.reconstruct import pick_device

from .baselines import MEANING, Baseline, Retrieval, background, billboard, input_copy
from .ceiling import open_ceiling
from .compare_views import (
    Shown,
    Truth,
    ViewsProtocol,
    add_lpips,
    choose_views,
    compare,
    load_truth,
    render_views,
    summary,
)
from .contact_sheet import RULE, Row, choose_ranks, contact_sheet
from .predictions import Predictions, open_predictions
from .report import OK, check_finite, csv_of, failure, make_report, mean_of, save_report, versions
from .views_table import differences_of, page, table_of

SHEET_VIEWS = 4  # novel views of an object in the contact sheet
_ERRORS = (UserError, ValueError, RuntimeError, ArithmeticError)


@dataclass
class Job:
    """What is the same for every object.

    Attributes:
        predictions: what is under test.
        dataset: true views.
        protocol: what the numbers mean.
        network: of LPIPS, or None.
        device: torch device.
        baselines: by name.
        left_out: reasons by name, of baselines that cannot be had.
        failures: ``{name, reason}`` of what failed beside objects.
    """

    predictions: Predictions
    dataset: ViewDataset
    protocol: ViewsProtocol
    network: LPIPS | None
    device: str
    baselines: dict[str, Baseline] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    failures: list[dict[str, str]] = field(default_factory=list)

    def predict(self, truth: Truth) -> Gaussians:
        """What is under test. Raises UserError where there is nothing."""
        return self.predictions.gaussians(self.dataset, truth.uid, self.protocol.reference)

    def fail(self, name: str, error: Exception) -> None:
        """Notes a failure beside those of objects."""
        self.failures.append({k: v for k, v in failure(name, error).items() if k != "status"})

    def shown(self, truth: Truth) -> dict[str, Shown]:
        """What each baseline shows; one that fails is noted and does not stop the others."""
        result = {}
        for name, baseline in self.baselines.items():
            try:
                pictures = baseline(truth)
            except _ERRORS as error:
                self.fail(f"{truth.uid} ({name})", error)
                continue
            if pictures is not None:
                result[name] = pictures
        return result


def save_strips(path: Path, rgb: Tensor, truth: Truth, count: int = 4) -> None:
    """Rows of input | prediction | truth, ``count`` views evenly spaced, the input first."""
    rows = choose_views(len(rgb), 0, count)
    strips = [torch.cat([truth.rgb[0], rgb[row], truth.rgb[row]], 1) for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    save_image(path, torch.cat(strips, 0).cpu().numpy())


def evaluate_object(
    job: Job, uid: str, strips: Path | None = None, save: Path | None = None
) -> dict[str, Any]:
    """One object's record, with those of its baselines in it.

    Args:
        job: what to do.
        uid: the object.
        strips: folder for its comparison picture.
        save: folder for its Gaussians.

    Raises:
        UserError: a file cannot be read or written, or a number is not finite.
        ValueError: pictures are too small for a metric.
    """
    marks = [time.perf_counter()]

    def mark(value: Any) -> Any:
        marks.append(time.perf_counter())
        return value

    truth = mark(load_truth(job.dataset, uid, job.protocol, job.device))
    gaussians = mark(job.predict(truth))
    rgb, mask = mark(render_views(gaussians, truth.cameras))
    candidates = mark({"": (rgb, mask)} | job.shown(truth))
    by_view = mark(compare(candidates, truth))
    if job.network:
        add_lpips(by_view, candidates, truth, job.network)
    mark(None)
    if strips is not None:
        save_strips(strips / f"{uid}.png", rgb, truth)
    if save is not None:
        path = save / f"{uid}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        save_ply(path, gaussians)
    stages = ("load", "predict", "render", "baselines", "compare", "lpips")
    return {
        "name": uid,
        "status": OK,
        **check_finite(summary(by_view.pop(""))),
        "baselines": {name: check_finite(summary(views)) for name, views in by_view.items()},
        "views": truth.views,
        "gaussians": gaussians.num,
        "truth_sha256": truth.digest,
        "seconds": {s: round(b - a, 4) for s, a, b in zip(stages, marks, marks[1:])},
    }


def evaluate(
    job: Job, uids: list[str], folder: Path | None, strips: int, save: bool
) -> tuple[list[dict[str, Any]], bool]:
    """Records of the objects, and whether Ctrl-C ended it after the first and before the last."""
    objects: list[dict[str, Any]] = []
    kept = output_folder(folder / "gaussians") if folder and save else None
    try:
        for number, uid in enumerate(tqdm(uids, unit="object", disable=None)):
            where = folder / "strips" if folder and number < strips else None
            try:
                objects.append(evaluate_object(job, uid, where, kept))
            except _ERRORS as error:
                objects.append(failure(uid, error))
    except KeyboardInterrupt:
        if not objects:
            raise
        return objects, True
    return objects, False


def sheet_rows(job: Job, records: list[dict[str, Any]], each: int) -> list[Row]:
    """Rows of the contact sheet; predicts the chosen objects again, so that none is kept."""

    def score(record: dict[str, Any]) -> float:
        return record["input"]["psnr"] if record["psnr"] is None else record["psnr"]

    done = sorted((r for r in records if r["status"] == OK), key=score, reverse=True)
    rows = []
    for rank, group in choose_ranks(len(done), each).items():
        record = done[rank]
        truth = load_truth(job.dataset, record["name"], job.protocol, job.device)
        rgb, _ = render_views(job.predict(truth), truth.cameras)
        views = choose_views(len(rgb), 0, SHEET_VIEWS + 1)[1:]
        lines = [record["name"], f"{group}: {rank + 1} of {len(done)}"]
        for kind, values in (("novel", record), ("input", record["input"])):
            if values["psnr"] is not None:
                lines.append(f"{kind}: {values['psnr']:.2f} dB, SSIM {values['ssim']:.3f}")
                last = f"IoU {values['mask_iou']:.3f}"
                if values["lpips"] is not None:
                    last = f"LPIPS {values['lpips']:.3f}, {last}"
                lines.append(f"    {last}")
        rows.append(Row(lines, truth.rgb[0], truth.rgb[views], rgb[views]))
    return rows


def report_of(job: Job, data: Path, uids: list[str], objects: list[dict[str, Any]]) -> dict:
    """The report: of every report, and ``baselines, left_out, table`` and ``differences``."""
    done = [record for record in objects if record["status"] == OK]
    model = {record["name"]: record for record in done}
    others = {
        name: {r["name"]: r["baselines"][name] for r in done if name in r["baselines"]}
        for name in job.baselines
    }
    empty = [name for name, records in others.items() if not records]
    left_out = job.left_out | dict.fromkeys(empty, "none of the objects has it")
    protocol = asdict(job.protocol) | {
        "source": job.predictions.source,
        "data": data.name,
        "uids": uids,
        "uids_sha256": hashlib.sha256("\n".join(uids).encode()).hexdigest(),
        "baselines": {name: MEANING[name] for name in job.baselines},
        "contact_sheet": RULE,
    }
    report = make_report(
        protocol,
        objects,
        versions("torch", "kornia"),
        left_out=("baselines",),
        baselines={n: mean_of(list(records.values())) for n, records in others.items() if records},
        left_out_baselines=left_out,
        table=table_of({"model": model} | others),
        differences=differences_of(model, others),
    )
    report["failures"] += job.failures
    return report


def _lpips_or_reason(wanted: bool, device: str) -> tuple[LPIPS | None, str | None]:
    if not wanted:
        return None, "not asked for"
    if lpips_available():
        return load_lpips().to(device), None
    return None, f"no weights; fetch them with: {FETCH}"


def _add_baselines(job: Job, data: Path) -> None:
    """The four that need no fit; the retrieval where there is a training split."""
    job.baselines |= {"background": background, "input_copy": input_copy, "billboard": billboard}
    try:
        job.baselines["retrieval"] = retrieval = Retrieval(open_dataset(data, "train"))
    except UserError as error:
        job.left_out["retrieval"] = str(error)
        return
    for uid, reason in retrieval.failures.items():
        job.fail(f"{uid} (retrieval)", UserError(reason))


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
    network, reason = _lpips_or_reason(lpips, place)
    name = "VGG16, version 0.1" if network else None
    protocol = ViewsProtocol(split, reference, views, size, name, reason, predictions.distance)
    job = Job(predictions, dataset, protocol, network, place)
    folder = None if out is None else output_folder(out)
    if ceiling is not None:
        fitted = open_ceiling(ceiling, dataset, uids, protocol, place, folder, ceiling_steps)
    if baselines:
        _add_baselines(job, data)
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
