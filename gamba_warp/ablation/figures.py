"""The figures of rows, from the reports and logs that their commands wrote."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..conventions import GROUNDS, WHITE, over_background
from ..errors import UserError
from ..image_metrics import all_figures
from ..pages.run_log import read_lines
from ..untrusted.documents import read_document
from .jobs import Settings, gaussians_of, stages
from .plan import Plan, Row
from .record import Record, changed, new_record, read_record, row_folder

VIEW_METRICS = tuple(all_figures())
SHAPE_METRICS = ("chamfer", "iou")
Objects = dict[str, dict[str, float]]  # metrics by object


@dataclass
class Facts:
    """What the log of a run says.

    Attributes:
        steps: optimizer steps done.
        skipped: those that were not finite.
        step_seconds: median time of a step, seconds, or None.
        parameters: that were trained, or None.
        device: that trained, such as "cpu", or "".
        device_memory: most bytes of a GPU's memory that the run held, or None.
        last_loss: of the training; NaN where it was not finite, None where there is none.
        last_val_loss: of the validation, as ``last_loss``.
    """

    steps: int = 0
    skipped: int = 0
    step_seconds: float | None = None
    parameters: int | None = None
    device: str = ""
    device_memory: int | None = None
    last_loss: float | None = None
    last_val_loss: float | None = None


@dataclass
class SeedResult:
    """What a row has with one seed.

    Attributes:
        folder: of the row with this seed.
        record: its record.
        objects: metrics of the novel views, or of the views held out from a fit, and of shapes, by
            object. What was not evaluated lacks.
        views: indices of these views, by object.
        size: height of the pictures compared, or None for the files' own.
        facts: of the training.
        missing: objects that could not be evaluated.
    """

    folder: Path
    record: Record
    objects: Objects = field(default_factory=dict)
    views: dict[str, list[int]] = field(default_factory=dict)
    size: int | None = None
    facts: Facts = field(default_factory=Facts)
    missing: list[str] = field(default_factory=list)


@dataclass
class RowResult:
    """What a row has.

    Attributes:
        row: of the plan.
        gaussians: N.
        seeds: results of those that have ended well.
        failed: reasons, by the seed, of those that have not.
        absent: seeds that were not run, or not to the end, or with another plan.
    """

    row: Row
    gaussians: int
    seeds: dict[int, SeedResult] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)
    absent: list[int] = field(default_factory=list)

    def values(self, seeds: set[int] | None = None) -> Objects:
        """Metrics by object, means over seeds; of the objects and metrics that all seeds have.

        Args:
            seeds: only these; None for all.
        """
        chosen = [s.objects for n, s in self.seeds.items() if seeds is None or n in seeds]
        return mean_over(chosen)


def mean_over(parts: list[Objects]) -> Objects:
    """Means of metrics by object, over parts; of the objects and metrics that all parts have."""
    if not parts:
        return {}
    found: Objects = {}
    for name in parts[0]:
        if all(name in part for part in parts):
            records = [part[name] for part in parts]
            keys = [key for key in records[0] if all(key in record for record in records)]
            found[name] = {key: sum(r[key] for r in records) / len(records) for key in keys}
    return found


def collect(plan: Plan, settings: Settings) -> list[RowResult]:
    """Reads what the rows of a plan have, all seeds that are there.

    Raises:
        UserError: a report or a record is damaged.
    """
    found = []
    for row in plan.rows:
        result = RowResult(row, gaussians_of(plan, row, settings))
        for seed in _seeds_there(plan, row, settings.out):
            _add(result, plan, seed, settings)
        found.append(result)
    return found


def _seeds_there(plan: Plan, row: Row, out: Path) -> list[int]:
    """The plan's seeds, and all others that were run."""
    seeds = {*plan.seeds_of(row)}
    for path in (out / "rows" / row.name).glob("seed-*"):
        number = path.name.removeprefix("seed-")
        if number.isdecimal() and number.isascii() and len(number) < 11:
            seeds.add(int(number))
    return sorted(seeds)


def _add(result: RowResult, plan: Plan, seed: int, settings: Settings) -> None:
    row, folder = result.row, row_folder(settings.out, result.row.name, seed)
    record = read_record(folder)
    wanted = new_record(row.name, seed, stages(plan, row, seed, settings))
    if record is None or record.status == "begun" or changed(record, wanted):
        result.absent.append(seed)
    elif record.status == "failed":
        result.failed[seed] = record.reason
    else:
        result.seeds[seed] = read_result(row, folder, record)


def read_result(row: Row, folder: Path, record: Record) -> SeedResult:
    """Reads what a row has with one seed, which has ended well.

    Raises:
        UserError: a report is missing or damaged.
    """
    found = SeedResult(folder, record)
    if row.kind == "fit":
        _read_fit(found, _report(folder / "fit" / "report.json"))
    else:
        found.facts = read_facts(folder / "run" / "log.jsonl")
        _read_views(found, _report(folder / "views" / "report.json"))
    if "shapes" in record.ended:
        for item in _records(_report(folder / "shapes" / "report.json")):
            found.objects.setdefault(item["name"], {}).update(_numbers(item, SHAPE_METRICS))
    return found


def _report(path: Path) -> dict[str, Any]:
    return read_document(path, dict[str, Any])


def _records(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The records of the objects that were evaluated."""
    found = report.get("objects")
    records = found if isinstance(found, list) else []
    records = [r for r in records if isinstance(r, dict) and isinstance(r.get("name"), str)]
    return [r for r in records if r.get("status", "ok") == "ok"]


def _numbers(record: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, float]:
    values = {name: record.get(name) for name in names}
    plain = (int, float)
    return {
        name: float(value)
        for name, value in values.items()
        if isinstance(value, plain) and not isinstance(value, bool)
    }


def _read_views(found: SeedResult, report: dict[str, Any]) -> None:
    protocol = report.get("protocol")
    found.size = protocol.get("size") if isinstance(protocol, dict) else None
    for record in _records(report):
        name = record["name"]
        found.objects[name] = _numbers(record, VIEW_METRICS)
        found.views[name] = [v for v in record.get("views", []) if type(v) is int][1:]
    _note_missing(found, report)


def _read_fit(found: SeedResult, report: dict[str, Any]) -> None:
    protocol = report.get("protocol")
    found.size = protocol.get("size") if isinstance(protocol, dict) else None
    times: list[float] = []
    for record in _records(report):
        names = ("psnr", "ssim", *(f"psnr_{ground}" for ground in GROUNDS))
        named = {name: record.get(f"{name}_held_out") for name in names}
        found.objects[record["name"]] = _numbers(named, names)
        steps = record.get("steps")
        if type(steps) is int and steps > 0:
            times += [value / steps for value in _numbers(record, ("seconds",)).values()]
        kept = record.get("views_held_out", [])
        found.views[record["name"]] = [v for v in kept if type(v) is int]
    found.facts.step_seconds = statistics.median(times) if times else None
    _note_missing(found, report)


def _note_missing(found: SeedResult, report: dict[str, Any]) -> None:
    failures = report.get("failures")
    for item in failures if isinstance(failures, list) else []:
        if isinstance(item, dict):
            found.missing.append(f"{item.get('name')}: {item.get('reason')}")


def empty_psnr(data: Path, result: SeedResult) -> dict[str, float]:
    """PSNR of an empty (white) picture against the views that a row was evaluated on.

    Args:
        data: the dataset.
        result: of the row; it says which views, and their size.

    Returns:
        dB, means over the views, by object. An object that cannot be read lacks.
    """
    import torch

    from ..data.dataset import open_dataset
    from ..image_metrics import psnr

    dataset, found = open_dataset(data), {}
    for name, views in result.views.items():
        if not views:
            continue
        try:
            images = dataset.load(name, views=views, size=result.size).images
        except UserError:
            continue
        truth = over_background(images, WHITE)
        found[name] = float(psnr(torch.ones_like(truth), truth).double().mean())
    return found


def read_facts(path: Path) -> Facts:
    """Reads a run's log; lines that are damaged are passed over, and so is a log that lacks."""
    facts, seconds = Facts(), []
    try:
        for line in read_lines(path):
            _add_line(facts, seconds, line)
    except UserError:
        return facts
    facts.step_seconds = statistics.median(seconds) if seconds else None
    return facts


def _add_line(facts: Facts, seconds: list[float], line: dict[str, Any]) -> None:
    event, facts.steps = line["event"], line["step"]
    memory = _whole(line.get("device_memory"))
    if memory is not None:
        facts.device_memory = max(memory, facts.device_memory or 0)
    skipped = _whole(line.get("skipped"))
    facts.skipped = facts.skipped if skipped is None else skipped
    if event == "start":
        facts.parameters = _whole(line.get("parameters"))
        facts.device = str(line.get("device", ""))[:100]
    elif event == "train" and "loss" in line:
        facts.last_loss = _loss(line["loss"])
        value = line.get("seconds")
        if isinstance(value, (int, float)) and 0 < value < 1e9:
            seconds.append(float(value))
    elif event == "val" and "loss" in line:
        facts.last_val_loss = _loss(line["loss"])


def _loss(value: object) -> float:
    """A loss; the log has null for one that is not finite."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    return float(value)


def _whole(value: object) -> int | None:
    return value if type(value) is int and 0 <= value < 10**18 else None
