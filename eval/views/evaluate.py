"""Objects of a dataset evaluated one after the other, and their report."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gamba_warp.batch import progress_bar
from gamba_warp.files import output_folder, write_text
from gamba_warp.formats.ply import save_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.versions import __version__, installed

from ..averages import mean_of
from ..report import OK, Stopwatch, check_finite, failure, make_report, save_report
from .baselines import MEANING
from .command import ViewsOptions
from .compare import (
    NEARLY_EMPTY,
    Truth,
    add_lpips,
    choose_views,
    compare,
    load_truth,
    render_views,
    summary,
)
from .contact_sheet import RULE, Row, choose_ranks, contact_sheet, label, save_strips
from .job import ERRORS, Job, open_job
from .pictures import Pictures, save_pictures
from .table import page, tables_of, without_nearly_empty

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


def pictures_of(predicted: Gaussians | Pictures, truth: Truth) -> Pictures:
    """What is under test as pictures of the true views: as it is, or rendered."""
    if isinstance(predicted, Pictures):
        return predicted
    return Pictures(render_views(predicted, truth.cameras))


def evaluate_object(job: Job, uid: str, folders: Mapping[str, Path] = {}) -> dict[str, Any]:
    """Evaluates one object and its baselines.

    Args:
        job: what to do.
        uid: the object.
        folders: of what is written of it: ``strips``, ``gaussians``, ``retrieval`` (its mesh) and
            ``pictures`` (what was compared, a folder for the model and for each baseline).

    Returns:
        The object's record, with those of its baselines in it.

    Raises:
        UserError: a file cannot be read or written, or a number is not finite.
        ValueError: pictures are too small for a metric.
    """
    stages = Stopwatch(4)
    with stages("load"):
        truth = load_truth(job.dataset, uid, job.protocol, job.device)
    with stages("predict"):
        predicted = job.predict(truth)
    with stages("render"):
        pictures = pictures_of(predicted, truth)
    with stages("baselines"):
        baselines = job.shown(truth)
    candidates = {"": pictures.shown} | baselines
    with stages("compare"):
        by_view = compare(candidates, truth)
    with stages("lpips"):
        if job.network:
            add_lpips(by_view, candidates, truth, job.network)
    if not pictures.has_input:
        by_view[""][0] = dict.fromkeys(by_view[""][0])
    found = job.retrieval.found.get(uid) if job.retrieval else None
    gaussians = predicted if isinstance(predicted, Gaussians) else None

    if "strips" in folders:
        save_strips(folders["strips"] / f"{uid}.png", pictures.shown.on(), truth)
    if "gaussians" in folders and gaussians is not None:
        path = folders["gaussians"] / f"{uid}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        save_ply(path, gaussians)
    if "pictures" in folders:
        model = {} if pictures.shown.alpha is None else {"model": pictures.shown}
        for name, candidate in (model | baselines).items():
            where = folders["pictures"] / name / uid
            save_pictures(where, job.dataset.files(uid), truth.views, candidate)
    if "retrieval" in folders and found and job.meshes:
        try:
            job.meshes.save(folders["retrieval"] / f"{uid}.ply", found, job.protocol.distance)
        except ERRORS as error:
            job.fail(f"{uid} (retrieval's mesh)", error)

    summaries = {n: check_finite(summary(v, truth.coverage)) for n, v in by_view.items()}
    return {
        "name": uid,
        "status": OK,
        **summaries.pop(""),
        "baselines": summaries,
        **({"retrieval": found._asdict()} if found else {}),
        "views": truth.views,
        "coverage": truth.coverage,
        "num_nearly_empty": sum(share < NEARLY_EMPTY for share in truth.coverage),
        **({"pictures": pictures.record} if pictures.record else {}),
        **({} if gaussians is None else {"gaussians": gaussians.num}),
        "truth_sha256": truth.digest,
        "seconds": stages.seconds,
    }


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
    folders: dict[str, Path] = {}
    if options.out:
        for name in ("gaussians", "retrieval", "pictures"):
            if getattr(options, f"save_{name}"):
                folders[name] = output_folder(options.out / name)
    try:
        for number, uid in enumerate(progress_bar(job.uids, unit="object")):
            more = {}
            if options.out and number < options.strips:
                more["strips"] = options.out / "strips"
            try:
                objects.append(evaluate_object(job, uid, folders | more))
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
        lines = label(record, f"{group}: {rank + 1} of {len(done)}")
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
    others = {
        name: {r["name"]: r["baselines"][name] for r in done if name in r["baselines"]}
        for name in job.baselines
    }
    candidates = {"model": {record["name"]: record for record in done}} | others
    empty = [name for name, records in others.items() if not records]
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
        left_out_baselines=job.left_out | dict.fromkeys(empty, "none of the objects has it"),
        **tables_of(candidates),
        nearly_empty=count_nearly_empty(done),
        without_nearly_empty=tables_of(without_nearly_empty(candidates)),
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
