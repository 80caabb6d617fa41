"""Evaluation of the objects of a dataset, and the report."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gamba_warp.batch import check_not_read, progress_bar
from gamba_warp.conventions import GREY, WHITE
from gamba_warp.data import gso
from gamba_warp.data.dataset import (
    ViewDataset,
    background_note,
    camera_note,
    evenly,
    open_dataset,
)
from gamba_warp.devices import pick_device
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder, write_text
from gamba_warp.formats.catalogue import find_meshes
from gamba_warp.formats.ply import save_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.versions import __version__, installed
from gamba_warp.vision.lpips import LPIPS, load_lpips
from gamba_warp.vision.weights import FETCH, lpips_available

from ..averages import mean_of
from ..report import OK, Stopwatch, check_finite, failure, make_report, save_report
from .baselines import (
    MEANING,
    Baseline,
    Retrieval,
    TrainingMeshes,
    background,
    billboard,
    input_copy,
)
from .compare import (
    NEARLY_EMPTY,
    GroundTruth,
    Shown,
    ViewsProtocol,
    add_lpips,
    choose_views,
    compare,
    load_gt,
    render_views,
    summary,
)
from .contact_sheet import RULE, Row, choose_ranks, contact_sheet, label, save_strips
from .images import MEANING as IMAGES
from .images import ImagePredictions, Images, save_images
from .options import ViewsOptions
from .predictions import Predictions, open_predictions
from .table import page, tables_of, without_nearly_empty

SHEET_VIEWS = 4  # novel views of an object in the contact sheet
# Errors that fail only one object.
ERRORS = (UserError, OSError, MemoryError, ValueError, RuntimeError, ArithmeticError)


@dataclass
class Job:
    """State shared by all objects.

    Attributes:
        predictions: under test.
        dataset: of the true views.
        uids: the objects.
        protocol: definition of the numbers.
        network: of LPIPS, or None.
        device: torch device.
        baselines: by name.
        left_out: reasons by name, of unavailable baselines.
        missing: failure records of the protocol's objects that the dataset lacks.
        failures: ``{name, reason}`` of failed baselines.
        retrieval: the baseline of this name, if used.
        meshes: of the training objects, for the retrieval's shapes; or None.
        retrieval_data: names of the datasets of the retrieval, if they are others.
    """

    predictions: Predictions
    dataset: ViewDataset
    uids: list[str]
    protocol: ViewsProtocol
    network: LPIPS | None
    device: str
    baselines: dict[str, Baseline] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    missing: list[dict[str, Any]] = field(default_factory=list)
    failures: list[dict[str, str]] = field(default_factory=list)
    retrieval: Retrieval | None = None
    meshes: TrainingMeshes | None = None
    retrieval_data: list[str] = field(default_factory=list)

    def predict(self, gt: GroundTruth) -> Gaussians | Images:
        """Return the Gaussians or images under test. Raises UserError if they are missing."""
        if isinstance(self.predictions, ImagePredictions):
            return self.predictions.images(self.dataset, gt)
        return self.predictions.gaussians(self.dataset, gt.uid, self.protocol.reference)

    def fail(self, name: str, error: Exception | str) -> None:
        """Record a failure of a baseline."""
        self.failures.append({"name": name, "reason": failure(name, error)["reason"]})

    def shown(self, gt: GroundTruth) -> dict[str, Shown]:
        """Return the images of each baseline; failures are recorded and stop no other."""
        result = {}
        for name, baseline in self.baselines.items():
            try:
                images = baseline(gt)
            except ERRORS as error:
                self.fail(f"{gt.uid} ({name})", error)
                continue
            if images is not None:
                result[name] = images
        return result


def open_job(options: ViewsOptions) -> Job:
    """Open everything that the options name, and make the folder of the report.

    Raises:
        UserError: something is missing, cannot be read, or cannot be written.
    """
    device = str(pick_device(options.device))
    dataset = open_dataset(options.data, options.split)
    uids = dataset.uids if options.limit is None else evenly(dataset.uids, options.limit)
    evaluation = None
    if options.protocol == "gso":
        names = gso.names_of(options.objects)
        evaluation, uids = gso.protocol_of(uids, names), [uid for uid in uids if uid in names]
        if not uids:
            raise UserError(f"{options.data}: contains none of the objects of --protocol gso")
    _check_outputs(options, uids)
    size = gso.SIZE if evaluation else options.size
    predictions = open_predictions(options, device, size)
    rendered: dict[str, Any] = {}
    if isinstance(predictions, ImagePredictions):
        if options.save_gaussians:
            raise UserError(f"--save-gaussians: {options.checkpoint} holds images")
        predictions.check(uids)
        rendered = {"rendering": "images of 8 bits", "images": IMAGES}
    elif options.resize_images:
        raise UserError(f"--resize-images: {options.checkpoint} holds no images")
    network, reason = None, "not asked for"
    if options.lpips == "auto" and not lpips_available():
        reason = f"no weights; fetch them with: {FETCH}"
    elif options.lpips != "off":
        network, reason = load_lpips().to(device), None
    protocol = ViewsProtocol(
        name=options.protocol,
        changed=options.changed(),
        split=options.split,
        split_version=dataset.split_version,
        reference=options.reference or 0,
        views=options.views,
        size=size,
        lpips="VGG16, version 0.1" if network else None,
        lpips_reason=reason,
        distance=predictions.distance,
        evaluation=evaluation,
        resize_images=options.resize_images,
        **rendered,
    )
    job = Job(predictions, dataset, uids, protocol, network, device)
    job.retrieval_data = [folder.resolve().name for folder in options.retrieval_data]
    reason = f"an object of --protocol gso that is not in {options.data}"
    if evaluation:
        job.missing = [failure(name, reason) for name in evaluation["missing"]]
    if options.out is not None:
        output_folder(options.out)
    if options.baselines:
        _add_baselines(job, options)
    for note in filter(None, (camera_note(dataset), background_note(dataset))):
        print(f"warning: {options.data}: {note}", file=sys.stderr)
    return job


def _check_outputs(options: ViewsOptions, uids: list[str]) -> None:
    """Raise UserError if an output of this evaluation would replace an input."""
    if options.out is None:
        return
    if options.save_images:
        folder = (options.out / "images").resolve()
        if folder in (options.checkpoint.resolve(), *options.checkpoint.resolve().parents):
            raise UserError(f"{options.checkpoint}: would be overwritten; give another --out")
    targets = [options.out / "strips" / f"{uid}.png" for uid in uids[: options.strips]]
    for name in ("gaussians", "retrieval"):
        if getattr(options, f"save_{name}"):
            targets += [options.out / name / f"{uid}.ply" for uid in uids]
    read = [options.checkpoint / f"{uid}.ply" for uid in uids]
    if options.save_retrieval:
        read += [mesh.path for mesh in find_meshes(options.save_retrieval)]
    check_not_read(targets, [*read, *(options.data / uid for uid in uids)])


def _add_baselines(job: Job, options: ViewsOptions) -> None:
    """Add the four baselines without a fit; the retrieval only with a training split.

    Raises:
        UserError: meshes of the training objects are requested but unavailable.
    """
    job.baselines |= {"background": background, "input_copy": input_copy, "billboard": billboard}
    try:
        first, *others = options.retrieval_data or (options.data,)
        training = open_dataset(first, "train")
        for folder in others:
            training = training.joined(folder.resolve().name, open_dataset(folder, "train"))
        if options.save_retrieval:
            job.meshes = TrainingMeshes(options.save_retrieval, training)
        job.baselines["retrieval"] = job.retrieval = Retrieval(training)
    except UserError as error:
        if options.retrieval_data:
            raise UserError(f"--retrieval-data: {error}") from error
        if options.save_retrieval:
            raise UserError(f"--save-retrieval: {error}") from error
        job.left_out["retrieval"] = str(error)
        return
    for uid, reason in job.retrieval.failures.items():
        job.fail(f"{uid} (retrieval)", reason)


def evaluate_views(options: ViewsOptions) -> dict[str, Any]:
    """Evaluate the objects that the options name, and write the report's files.

    Returns:
        The report of ``report_of``, and ``interrupted``: True after Ctrl-C.

    Raises:
        UserError: something cannot be opened or written.
        KeyboardInterrupt: Ctrl-C before the first record.
    """
    job, folder = open_job(options), options.out
    objects: list[dict[str, Any]] = []
    folders: dict[str, Path] = {}
    for name in ("gaussians", "retrieval", "images"):
        if folder and getattr(options, f"save_{name}"):
            folders[name] = output_folder(folder / name)
    interrupted = False
    try:
        for number, uid in enumerate(progress_bar(job.uids, unit="object")):
            strips = {"strips": folder / "strips"} if folder and number < options.strips else {}
            try:
                objects.append(evaluate_object(job, uid, folders | strips))
            except ERRORS as error:
                objects.append(failure(uid, error))
    except KeyboardInterrupt:
        if not objects:
            raise
        interrupted = True
    report = report_of(job, options.data, objects) | {"interrupted": interrupted}
    if folder:
        save_report(report, folder)
        write_text(folder / "table.md", page(report))
        wanted = options.sheet and report["num_ok"] and not interrupted
        if wanted and (rows := sheet_rows(job, objects, options.sheet)):
            contact_sheet(folder / "contact_sheet.png", rows)
        else:
            (folder / "contact_sheet.png").unlink(missing_ok=True)  # of an earlier run
    return report


def images_of(predicted: Gaussians | Images, gt: GroundTruth) -> Images:
    """Return the prediction as images of the true views; Gaussians are rendered."""
    if isinstance(predicted, Images):
        return predicted
    return Images(render_views(predicted, gt.cameras))


def evaluate_object(job: Job, uid: str, folders: Mapping[str, Path] = {}) -> dict[str, Any]:
    """Evaluate one object and its baselines.

    Args:
        job: shared state.
        uid: the object.
        folders: of its outputs: ``strips``, ``gaussians``, ``retrieval`` (its mesh) and
            ``images`` (the compared ones, in a folder for the model and for each baseline).

    Returns:
        The object's record, including its baselines' records.

    Raises:
        UserError: a file cannot be read or written, or a number is not finite.
        ValueError: images are too small for a metric.
    """
    stages = Stopwatch(4)
    with stages("load"):
        gt = load_gt(job.dataset, uid, job.protocol, job.device)
    with stages("predict"):
        predicted = job.predict(gt)
    with stages("render"):
        images = images_of(predicted, gt)
    with stages("baselines"):
        baselines = job.shown(gt)
    candidates = {"": images.shown} | baselines
    with stages("compare"):
        by_view = compare(candidates, gt)
    with stages("lpips"):
        if job.network:
            add_lpips(by_view, candidates, gt, job.network)
    if not images.has_input:
        by_view[""][0] = dict.fromkeys(by_view[""][0])
    nearest = job.retrieval.found.get(uid) if job.retrieval else None
    gaussians = predicted if isinstance(predicted, Gaussians) else None

    if "strips" in folders:
        save_strips(folders["strips"] / f"{uid}.png", images.shown.on(), gt)
    if "gaussians" in folders and gaussians is not None:
        path = folders["gaussians"] / f"{uid}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        save_ply(path, gaussians)
    if "images" in folders:
        model = {} if images.shown.alpha is None else {"model": images.shown}
        for name, candidate in (model | baselines).items():
            where = folders["images"] / name / uid
            save_images(where, job.dataset.files(uid), gt.views, candidate)
    if "retrieval" in folders and nearest and job.meshes:
        try:
            job.meshes.save(folders["retrieval"] / f"{uid}.ply", nearest, job.protocol.distance)
        except ERRORS as error:
            job.fail(f"{uid} (retrieval's mesh)", error)

    summaries = {n: check_finite(summary(v, gt.coverage)) for n, v in by_view.items()}
    return {
        "name": uid,
        "status": OK,
        **summaries.pop(""),
        "baselines": summaries,
        **({"retrieval": nearest._asdict()} if nearest else {}),
        "views": gt.views,
        "coverage": gt.coverage,
        "num_nearly_empty": sum(fraction < NEARLY_EMPTY for fraction in gt.coverage),
        **({"images": images.record} if images.record else {}),
        **({} if gaussians is None else {"gaussians": gaussians.num}),
        "truth_sha256": gt.digest,
        "seconds": stages.seconds,
    }


def sheet_rows(job: Job, records: list[dict[str, Any]], each: int) -> list[Row]:
    """Return rows of the contact sheet; the chosen objects are predicted again to save memory.

    Args:
        job: shared state.
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
            gt = load_gt(job.dataset, record["name"], job.protocol, job.device)
            shown = images_of(job.predict(gt), gt).shown
        except ERRORS:  # a file changed meanwhile; the report has its record
            continue
        views = choose_views(len(gt.rgb), 0, SHEET_VIEWS + 1)[1:]
        ground = WHITE if shown.alpha is None else GREY
        true, got = gt.shown.on(ground), shown.on(ground)
        lines = label(record, f"{group}: {rank + 1} of {len(done)}")
        rows.append(Row(lines, true[0], true[views], got[views]))
    return rows


def report_of(job: Job, data: Path, objects: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the report of ``make_report`` with entries for the baselines.

    Args:
        job: shared state.
        data: the dataset, whose name the report holds.
        objects: the records; the missing ones of ``job.missing`` are added.

    Returns:
        The report, with ``baselines`` (their means), ``left_out_baselines`` (reasons by name), the
        rows ``table`` and ``differences`` of ``table.md``, ``nearly_empty`` (counts of views and
        objects), and ``without_nearly_empty``: both sets of rows without these views.
    """
    uids = sorted(job.uids)
    protocol = asdict(job.protocol) | {
        "source": job.predictions.source,
        "data": data.name,
        "uids": uids,
        "uids_sha256": hashlib.sha256(os.fsencode("\n".join(uids))).hexdigest(),
        "baselines": {name: MEANING[name] for name in job.baselines},
        "contact_sheet": RULE,
        **({"retrieval_data": job.retrieval_data} if job.retrieval_data else {}),
    }
    objects = sorted(objects + job.missing, key=lambda record: record["name"])
    done = [record for record in objects if record["status"] == OK]
    others = {
        name: {r["name"]: r["baselines"][name] for r in done if name in r["baselines"]}
        for name in job.baselines
    }
    candidates = {"model": {record["name"]: record for record in done}} | others
    absent = {name: "none of the objects has it" for name in others if not others[name]}
    report = make_report(
        protocol,
        objects,
        {"gamba_warp": __version__} | installed("torch", "kornia"),
        left_out=("baselines", "num_nearly_empty", "retrieval", "images"),
        baselines={n: mean_of(list(records.values())) for n, records in others.items() if records},
        left_out_baselines=job.left_out | absent,
        **tables_of(candidates),
        nearly_empty=count_nearly_empty(done),
        without_nearly_empty=tables_of(without_nearly_empty(candidates)),
    )
    unique = {(failure["name"], failure["reason"]) for failure in job.failures}
    report["failures"] += [{"name": name, "reason": reason} for name, reason in sorted(unique)]
    return report


def count_nearly_empty(done: list[dict[str, Any]]) -> dict[str, int]:
    """Count the nearly empty views and their objects among the evaluated records."""
    return {
        "views": sum(record["num_nearly_empty"] for record in done),
        "of_views": sum(len(record["views"]) for record in done),
        "objects": sum(record["num_nearly_empty"] > 0 for record in done),
        "of_objects": len(done),
    }
