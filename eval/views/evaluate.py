"""Objects of a dataset evaluated one after the other, and their report."""

from __future__ import annotations

import hashlib
import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gamba_warp.batch import progress_bar
from gamba_warp.files import output_folder, write_text
from gamba_warp.formats.ply import save_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import METRICS
from gamba_warp.images import save_image
from gamba_warp.versions import __version__, installed

from ..averages import mean_of
from ..report import OK, check_finite, failure, make_report, save_report
from .baselines import MEANING
from .compare import (
    NEARLY_EMPTY,
    Shown,
    Truth,
    add_lpips,
    choose_views,
    compare,
    load_truth,
    render_views,
    summary,
)
from .contact_sheet import RULE, Row, choose_ranks, contact_sheet
from .job import ERRORS, Job, open_job
from .options import ViewsOptions
from .pictures import Pictures, save_pictures
from .table import differences_of, page, table_of, without_nearly_empty

SHEET_VIEWS = 4  # novel views of an object in the contact sheet


def evaluate_views(options: ViewsOptions) -> dict[str, Any]:
    """Evaluates the objects that the options name, and writes the report's files.

    Returns:
        The report: what ``report_of`` returns, and ``interrupted``: whether Ctrl-C ended it.

    Raises:
        UserError: something cannot be opened or written.
    """
    job, folder = open_job(options), options.out
    objects, interrupted = evaluate(job, options)
    report = report_of(job, options.data, objects) | {"interrupted": interrupted}
    if folder:
        save_report(report, folder)
        write_text(folder / "table.md", page(report))
        wanted = options.sheet and report["num_ok"] and not interrupted
        if wanted and (rows := sheet_rows(job, objects, options.sheet)):
            contact_sheet(folder / "contact_sheet.png", rows)
        else:
            (folder / "contact_sheet.png").unlink(missing_ok=True)  # that of an earlier run
    return report


def save_strips(path: Path, rgb: Tensor, truth: Truth, count: int = 4) -> None:
    """Writes rows of input | prediction | truth: ``count`` views evenly spaced, the input first."""
    rows = choose_views(len(rgb), 0, count)
    strips = [torch.cat([truth.rgb[0], rgb[row], truth.rgb[row]], 1) for row in rows]
    output_folder(path.parent)
    save_image(path, torch.cat(strips, 0).cpu().numpy())


def pictures_of(predicted: Gaussians | Pictures, truth: Truth) -> Pictures:
    """What is under test as pictures of the true views: as it is, or rendered."""
    if isinstance(predicted, Pictures):
        return predicted
    return Pictures(render_views(predicted, truth.cameras))


@dataclass(frozen=True)
class Files:
    """Folders for what is written of an object, each None where it is not asked for.

    Attributes:
        strips: its comparison picture.
        gaussians: its Gaussians.
        retrieved: the retrieval's mesh.
        pictures: what was compared, a folder for the model and for each baseline.
    """

    strips: Path | None = None
    gaussians: Path | None = None
    retrieved: Path | None = None
    pictures: Path | None = None


def evaluate_object(job: Job, uid: str, files: Files = Files()) -> dict[str, Any]:
    """Evaluates one object and its baselines.

    Args:
        job: what to do.
        uid: the object.
        files: where what is written of it goes.

    Returns:
        The object's record, with those of its baselines in it.

    Raises:
        UserError: a file cannot be read or written, or a number is not finite.
        ValueError: pictures are too small for a metric.
    """
    marks = [time.perf_counter()]

    def mark(value: Any) -> Any:
        marks.append(time.perf_counter())
        return value

    truth = mark(load_truth(job.dataset, uid, job.protocol, job.device))
    predicted = mark(job.predict(truth))
    pictures = mark(pictures_of(predicted, truth))
    baselines = mark(job.shown(truth))
    candidates = {"": pictures.shown} | baselines
    by_view = mark(compare(candidates, truth))
    if job.network:
        add_lpips(by_view, candidates, truth, job.network)
    if not pictures.has_input:
        by_view[""][0] = dict.fromkeys(by_view[""][0])
    mark(None)
    _write(job, truth, predicted, pictures, baselines, files)
    found = job.retrieval.found.get(uid) if job.retrieval else None
    stages = ("load", "predict", "render", "baselines", "compare", "lpips")
    return {
        "name": uid,
        "status": OK,
        **check_finite(summary(by_view.pop(""), truth.coverage)),
        "baselines": {
            name: check_finite(summary(views, truth.coverage)) for name, views in by_view.items()
        },
        **({"retrieval": found._asdict()} if found else {}),
        "views": truth.views,
        "coverage": truth.coverage,
        "num_nearly_empty": sum(share < NEARLY_EMPTY for share in truth.coverage),
        **({"pictures": pictures.record} if pictures.record else {}),
        **({"gaussians": predicted.num} if isinstance(predicted, Gaussians) else {}),
        "truth_sha256": truth.digest,
        "seconds": {s: round(b - a, 4) for s, a, b in zip(stages, marks, marks[1:])},
    }


def _write(
    job: Job,
    truth: Truth,
    predicted: Gaussians | Pictures,
    pictures: Pictures,
    baselines: dict[str, Shown],
    files: Files,
) -> None:
    """Writes what is asked for of one object."""
    uid = truth.uid
    if files.strips is not None:
        save_strips(files.strips / f"{uid}.png", pictures.shown.on(), truth)
    if files.gaussians is not None and isinstance(predicted, Gaussians):
        path = files.gaussians / f"{uid}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        save_ply(path, predicted)
    if files.pictures is not None:
        model = {} if pictures.shown.alpha is None else {"model": pictures.shown}
        for name, candidate in (model | baselines).items():
            where = files.pictures / name / uid
            save_pictures(where, job.dataset.files(uid), truth.views, candidate)
    found = job.retrieval.found.get(uid) if job.retrieval else None
    if files.retrieved is not None and found and job.meshes:
        try:
            job.meshes.save(files.retrieved / f"{uid}.ply", found, job.protocol.distance)
        except ERRORS as error:
            job.fail(f"{uid} (retrieval's mesh)", error)


def evaluate(job: Job, options: ViewsOptions) -> tuple[list[dict[str, Any]], bool]:
    """Evaluates the job's objects.

    Args:
        job: what to do.
        options: say which files are written for each object.

    Returns:
        The records, and whether Ctrl-C ended it after the first object and before the last.

    Raises:
        KeyboardInterrupt: there is no record yet.
    """
    objects: list[dict[str, Any]] = []
    folder = options.out
    made = {
        name: output_folder(folder / place) if folder and wanted else None
        for name, place, wanted in (
            ("gaussians", "gaussians", options.save_gaussians),
            ("retrieved", "retrieval", options.save_retrieval),
            ("pictures", "pictures", options.save_pictures),
        )
    }
    try:
        for number, uid in enumerate(progress_bar(job.uids, unit="object")):
            strips = folder / "strips" if folder and number < options.strips else None
            try:
                objects.append(evaluate_object(job, uid, Files(strips=strips, **made)))
            except ERRORS as error:
                objects.append(failure(uid, error))
    except KeyboardInterrupt:
        if not objects:
            raise
        return objects, True
    return objects, False


def sheet_rows(job: Job, records: list[dict[str, Any]], each: int) -> list[Row]:
    """Rows of the contact sheet; the chosen objects are predicted again, so that none is kept.

    Args:
        job: what to do.
        records: of all objects.
        each: number of objects in each group (best, median, worst).
    """

    def score(record: dict[str, Any]) -> float:
        return record["input"]["psnr"] if record["psnr"] is None else record["psnr"]

    done = sorted((r for r in records if r["status"] == OK), key=score, reverse=True)
    rows = []
    for rank, group in choose_ranks(len(done), each).items():
        record = done[rank]
        try:
            truth = load_truth(job.dataset, record["name"], job.protocol, job.device)
            rgb = pictures_of(job.predict(truth), truth).shown.on()
        except ERRORS:  # a file that went bad meanwhile; the report has what it was
            continue
        views = choose_views(len(rgb), 0, SHEET_VIEWS + 1)[1:]
        lines = [record["name"], f"{group}: {rank + 1} of {len(done)}"]
        for kind, values in (("novel", record), ("input", record["input"])):
            if values["psnr"] is not None:
                known = [
                    f"{metric.title} {values[key]:.{metric.digits}f} {metric.unit}".strip()
                    for key, metric in METRICS.items()
                    if values[key] is not None
                ]
                lines.append(f"{kind}: {', '.join(known[:2])}")
                lines.append(f"    {', '.join(known[2:])}")
        rows.append(Row(lines, truth.rgb[0], truth.rgb[views], rgb[views]))
    return rows


def report_of(job: Job, data: Path, objects: list[dict[str, Any]]) -> dict[str, Any]:
    """The report: what ``make_report`` returns, and entries for the baselines.

    Args:
        job: what was done.
        data: the dataset, whose name the report holds.
        objects: the records.

    Returns:
        Besides, ``baselines`` (their means), ``left_out_baselines`` (reasons by name), the rows
        ``table`` and ``differences`` of ``table.md``, ``nearly_empty`` (how many views and objects
        are, of how many), and ``without_nearly_empty``: both sets of rows without these views.
    """
    done = [record for record in objects if record["status"] == OK]
    model = {record["name"]: record for record in done}
    others = {
        name: {r["name"]: r["baselines"][name] for r in done if name in r["baselines"]}
        for name in job.baselines
    }
    rest = without_nearly_empty({"model": model} | others)
    empty = [name for name, records in others.items() if not records]
    left_out = job.left_out | dict.fromkeys(empty, "none of the objects has it")
    protocol = asdict(job.protocol) | {
        "source": job.predictions.source,
        "data": data.name,
        "uids": job.uids,
        "uids_sha256": hashlib.sha256(os.fsencode("\n".join(job.uids))).hexdigest(),
        "baselines": {name: MEANING[name] for name in job.baselines},
        "contact_sheet": RULE,
    }
    report = make_report(
        protocol,
        objects,
        {"gamba_warp": __version__} | installed("torch", "kornia"),
        left_out=("baselines", "num_nearly_empty", "retrieval", "pictures"),
        baselines={n: mean_of(list(records.values())) for n, records in others.items() if records},
        left_out_baselines=left_out,
        table=table_of({"model": model} | others),
        differences=differences_of(model, others),
        nearly_empty=count_nearly_empty(done),
        without_nearly_empty={
            "table": table_of(rest),
            "differences": differences_of(rest["model"], {name: rest[name] for name in others}),
        },
    )
    report["failures"] += job.failures
    return report


def count_nearly_empty(done: list[dict[str, Any]]) -> dict[str, int]:
    """How many views are nearly empty, and of how many objects; of the records evaluated."""
    return {
        "views": sum(record["num_nearly_empty"] for record in done),
        "of_views": sum(len(record["views"]) for record in done),
        "objects": sum(record["num_nearly_empty"] > 0 for record in done),
        "of_objects": len(done),
    }
