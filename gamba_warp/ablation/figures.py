"""The figures of rows, from the reports and logs that their commands wrote."""

from __future__ import annotations

import contextlib
import math
import statistics
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from ..conventions import WHITE, over_background
from ..errors import UserError
from ..image_metrics import all_figures
from ..pages.run_log import read_lines
from ..untrusted.documents import read_document
from .jobs import Settings, gaussians_of
from .plan import Row
from .tasks import Task, task_of

VIEW_METRICS = tuple(all_figures())
SHAPE_METRICS = ("chamfer", "iou")
METRICS = (*VIEW_METRICS, *SHAPE_METRICS)
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
        task: what of it is done, and where.
        objects: metrics of the novel views, or of the views held out from a fit, and of shapes, by
            object. What was not evaluated lacks.
        views: indices of these views, by object.
        size: height of the pictures compared, or None for the files' own.
        facts: of the training.
        missing: objects that could not be evaluated.
    """

    task: Task
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
        parts = [s.objects for n, s in self.seeds.items() if seeds is None or n in seeds]
        found: Objects = {}
        for name in parts[0] if parts else ():
            if all(name in part for part in parts):
                records = [part[name] for part in parts]
                keys = [key for key in records[0] if all(key in record for record in records)]
                found[name] = {key: sum(r[key] for r in records) / len(records) for key in keys}
        return found

    @property
    def first(self) -> SeedResult:
        """That of the smallest seed, of which there is one."""
        return self.seeds[min(self.seeds)]


def collect(settings: Settings) -> list[RowResult]:
    """Reads what the rows of a plan have: the plan's seeds, and all others that were run.

    Raises:
        UserError: a report or a record is damaged.
    """
    found = []
    for row in settings.plan.rows:
        result = RowResult(row, gaussians_of(settings, row))
        seeds = {*settings.plan.seeds_of(row)}
        for path in (settings.out / "rows" / row.name).glob("seed-*"):
            number = path.name.removeprefix("seed-")
            if number.isdecimal() and number.isascii() and len(number) < 11:
                seeds.add(int(number))
        for seed in sorted(seeds):
            task = task_of(settings, row, seed)
            if task.record.status == "begun" or task.changed:
                result.absent.append(seed)
            elif task.record.status == "failed":
                result.failed[seed] = task.record.reason
            else:
                result.seeds[seed] = read_result(task)
        found.append(result)
    return found


_NAMES = (*METRICS, *(f"{key}_held_out" for key in VIEW_METRICS))
_Object = msgspec.defstruct(
    "_Object",
    [
        *[("name", str), ("status", str, "ok"), ("views", list[int], [])],
        *[("views_held_out", list[int], []), ("seconds", Any, None)],
        *[("steps", Annotated[int, Meta(ge=1)], 1), *((n, float | None, None) for n in _NAMES)],
    ],
)


class _Protocol(msgspec.Struct, frozen=True):
    size: int | None = None


class _Report(msgspec.Struct):
    """What is read of a report of ``gamba eval-views``, ``eval-geometry`` or ``fit``."""

    objects: list[_Object]
    failures: list[dict[str, Any]] = []
    protocol: _Protocol = _Protocol()

    def figures(self, keys: Iterable[str], end: str = "") -> Objects:
        """Those of the objects that were evaluated; of keys with another end."""
        found = {}
        for record in self.objects:
            values = ((key, getattr(record, key + end)) for key in keys)
            if record.status == "ok":
                found[record.name] = {key: value for key, value in values if value is not None}
        return found


def read_result(task: Task) -> SeedResult:
    """Reads what a row has with one seed, which has ended well.

    Raises:
        UserError: a report is missing or damaged.
    """
    found, fit = SeedResult(task), task.row.kind == "fit"
    report = read_document(task.folder / ("fit" if fit else "views") / "report.json", _Report)
    found.size = report.protocol.size
    found.missing = [f"{item.get('name')}: {item.get('reason')}" for item in report.failures]
    if fit:
        found.objects = report.figures(VIEW_METRICS, "_held_out")
        found.views = {record.name: record.views_held_out for record in report.objects}
        fits = [record for record in report.objects if isinstance(record.seconds, float)]
        times = [record.seconds / record.steps for record in fits]
        found.facts.step_seconds = statistics.median(times) if times else None
    else:
        found.objects = report.figures(VIEW_METRICS)
        found.views = {record.name: record.views[1:] for record in report.objects}
        found.facts = read_facts(task.folder / "run" / "log.jsonl")
    if "shapes" in task.record.ended:
        report = read_document(task.folder / "shapes" / "report.json", _Report)
        for name, values in report.figures(SHAPE_METRICS).items():
            found.objects.setdefault(name, {}).update(values)
    return found


def empty_psnr(data: Path, views: dict[str, list[int]], size: int | None) -> dict[str, float]:
    """PSNR of an empty (white) picture against the views that a row was evaluated on.

    Args:
        data: the dataset.
        views: indices by object.
        size: height of the pictures; None: the files' own.

    Returns:
        dB, means over the views, by object. An object that cannot be read lacks.
    """
    import torch

    from ..data.dataset import open_dataset
    from ..image_metrics import psnr

    dataset, found = open_dataset(data), {}
    for name in (name for name, indices in views.items() if indices):
        with contextlib.suppress(UserError):
            truth = over_background(dataset.load(name, views=views[name], size=size).images, WHITE)
            found[name] = float(psnr(torch.ones_like(truth), truth).double().mean())
    return found


def read_facts(path: Path) -> Facts:
    """Reads a run's log; lines that are damaged are passed over, and so is a log that lacks."""
    facts, seconds = Facts(), []
    with contextlib.suppress(UserError):
        for line in read_lines(path):
            event, facts.steps = line["event"], line["step"]
            memory, skipped = _whole(line.get("device_memory")), _whole(line.get("skipped"))
            if memory is not None:
                facts.device_memory = max(memory, facts.device_memory or 0)
            facts.skipped = facts.skipped if skipped is None else skipped
            if event == "start":
                facts.parameters = _whole(line.get("parameters"))
                facts.device = str(line.get("device", ""))[:100]
            elif event in ("train", "val") and "loss" in line:
                # The log has null for a loss that is not finite.
                loss = line["loss"] if type(line["loss"]) in (int, float) else math.nan
                setattr(facts, "last_loss" if event == "train" else "last_val_loss", loss)
                taken = line.get("seconds")
                if event == "train" and type(taken) in (int, float) and 0 < taken < 1e9:
                    seconds.append(taken)
    facts.step_seconds = statistics.median(seconds) if seconds else None
    return facts


def _whole(value: object) -> int | None:
    return value if type(value) is int and 0 <= value < 10**18 else None
