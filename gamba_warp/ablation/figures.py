"""Figures of rows, from the reports and logs of their commands."""

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
from ..untrusted.documents import read_document, read_lines
from .jobs import Settings, gaussians_of
from .plan import Row
from .tasks import Task, task_of

VIEW_METRICS = tuple(all_figures())
SHAPE_METRICS = ("chamfer", "iou")
METRICS = (*VIEW_METRICS, *SHAPE_METRICS)
Objects = dict[str, dict[str, float]]  # metrics by object


@dataclass
class TrainLog:
    """Figures of a training's ``log.jsonl``.

    Attributes:
        step: the last step.
        seconds: of the logged steps.
        losses: the last one of "train" and of each "val"; NaN if it was not finite.
        skipped: number of steps that were not finite.
        device: device of the training; empty if unknown.
        device_memory: peak memory on a GPU, bytes; 0 if unknown.
        parameters: number of the model's parameters.
    """

    step: int = 0
    seconds: list[float] = field(default_factory=list)
    losses: dict[str, float] = field(default_factory=dict)
    skipped: int = 0
    device: str = ""
    device_memory: int = 0
    parameters: int | None = None


@dataclass
class SeedResult:
    """Results of a row with one seed.

    Attributes:
        task: its state and folder.
        objects: metrics of the novel views, or of the views held out from a fit, and of shapes, by
            object; only those that were evaluated.
        views: indices of these views, by object.
        size: height of the pictures compared, or None for the files' own.
        log: of the training; empty for a fit.
        step_seconds: median time of a step, seconds, or None.
        missing: objects that failed.
    """

    task: Task
    objects: Objects = field(default_factory=dict)
    views: dict[str, list[int]] = field(default_factory=dict)
    size: int | None = None
    log: TrainLog = field(default_factory=TrainLog)
    step_seconds: float | None = None
    missing: list[str] = field(default_factory=list)


@dataclass
class RowResult:
    """Results of a row.

    Attributes:
        row: of the plan.
        gaussians: N.
        seeds: results of the seeds that succeeded.
        failed: reasons by seed, of those that failed.
        absent: seeds that were not run, not finished, or run with another plan.
    """

    row: Row
    gaussians: int
    seeds: dict[int, SeedResult] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)
    absent: list[int] = field(default_factory=list)

    def values(self, seeds: set[int] | None = None) -> Objects:
        """Return metrics by object, averaged over seeds; only those that all seeds have.

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
        """Result of the smallest seed."""
        return self.seeds[min(self.seeds)]


def collect(settings: Settings) -> list[RowResult]:
    """Read the results of a plan's rows: the plan's seeds, and all others that were run.

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
    """Fields used of a report of ``gamba eval-views``, ``eval-geometry`` or ``fit``."""

    objects: list[_Object]  # pyright: ignore[reportInvalidTypeForm] (made from the registry)
    failures: list[dict[str, Any]] = []
    protocol: _Protocol = _Protocol()

    def figures(self, keys: Iterable[str], end: str = "") -> Objects:
        """Return metrics of the evaluated objects, from the keys with suffix ``end``."""
        found = {}
        for record in self.objects:
            values = ((key, getattr(record, key + end)) for key in keys)
            if record.status == "ok":
                found[record.name] = {key: value for key, value in values if value is not None}
        return found


def read_result(task: Task) -> SeedResult:
    """Read the results of a row with one seed that succeeded.

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
        found.step_seconds = statistics.median(times) if times else None
    else:
        found.objects = report.figures(VIEW_METRICS)
        found.views = {record.name: record.views[1:] for record in report.objects}
        found.log = read_log(task.folder / "run" / "log.jsonl")
        seconds = found.log.seconds
        found.step_seconds = statistics.median(seconds) if seconds else None
    if "shapes" in task.record.ended:
        report = read_document(task.folder / "shapes" / "report.json", _Report)
        for name, values in report.figures(SHAPE_METRICS).items():
            found.objects.setdefault(name, {}).update(values)
    return found


def empty_psnr(data: Path, views: dict[str, list[int]], size: int | None) -> dict[str, float]:
    """Compute the PSNR of an empty (white) picture against the views of a row's evaluation.

    Args:
        data: the dataset.
        views: indices by object.
        size: height of the pictures; None: the files' own.

    Returns:
        dB, means over the views, by object; unreadable objects are left out.
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


class _Line(msgspec.Struct):
    event: str
    step: int
    loss: float | None | msgspec.UnsetType = msgspec.UNSET
    seconds: float | None = None
    skipped: int = 0
    device: str = ""
    device_memory: int = 0
    parameters: int | None = None


def read_log(path: Path) -> TrainLog:
    """Read a run's log; an empty one if it is missing."""
    log = TrainLog()
    with contextlib.suppress(UserError):
        for line in read_lines(path, _Line):
            log.step, log.skipped = line.step, max(log.skipped, line.skipped)
            log.device_memory = max(log.device_memory, line.device_memory)
            if line.event == "start":
                log.device, log.parameters = line.device, line.parameters
            if line.event == "train" and line.seconds is not None:
                log.seconds.append(line.seconds)
            if line.loss is not msgspec.UNSET:
                log.losses[line.event] = math.nan if line.loss is None else line.loss
    return log
