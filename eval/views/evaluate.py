"""Objects of a dataset evaluated one after the other, and their report."""

from __future__ import annotations

import hashlib
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gamba_warp.data.dataset import ViewDataset, open_dataset
from gamba_warp.data.vgg_weights import FETCH, lpips_available
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder
from gamba_warp.formats.ply import save_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.images import save_image
from gamba_warp.model.lpips import LPIPS, load_lpips

from ..report import OK, check_finite, failure, make_report, mean_of, versions
from .baselines import MEANING, Baseline, Retrieval, background, billboard, input_copy
from .compare import (
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
from .contact_sheet import RULE, Row, choose_ranks
from .predictions import Predictions
from .table import differences_of, table_of

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


def lpips_or_reason(wanted: bool, device: str) -> tuple[LPIPS | None, str | None]:
    """LPIPS on a device, or None and why there is none."""
    if not wanted:
        return None, "not asked for"
    if lpips_available():
        return load_lpips().to(device), None
    return None, f"no weights; fetch them with: {FETCH}"


def add_baselines(job: Job, data: Path) -> None:
    """The four that need no fit; the retrieval where there is a training split."""
    job.baselines |= {"background": background, "input_copy": input_copy, "billboard": billboard}
    try:
        job.baselines["retrieval"] = retrieval = Retrieval(open_dataset(data, "train"))
    except UserError as error:
        job.left_out["retrieval"] = str(error)
        return
    for uid, reason in retrieval.failures.items():
        job.fail(f"{uid} (retrieval)", UserError(reason))
