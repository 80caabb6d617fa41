"""Reads a run's ``log.jsonl``: figures over steps and hours, and what was said on the way."""

from __future__ import annotations

import math
import re
from array import array
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..untrusted import documents

_MOST_WARNINGS = 1000
_MOST_STEPS = 10**12
# Of a training line; a validation's figures are all wanted.
_TRAIN = {"loss", "psnr", "lr", "grad_norm", "views_per_second", "seconds"}
_NAME = re.compile(r"[a-z][a-z_]{0,30}")
_MOST_SERIES = 60
_NO_FIGURES = {"step", "time", "minutes", "epoch"}


@dataclass
class Series:
    """One figure over a run.

    Attributes:
        steps: optimizer steps done, rising.
        minutes: training time, minutes.
        values: the figure, finite.
    """

    steps: array = field(default_factory=lambda: array("d"))
    minutes: array = field(default_factory=lambda: array("d"))
    values: array = field(default_factory=lambda: array("d"))

    def add(self, step: float, minutes: float, value: float) -> None:
        """Appends a point, if its step is later than that of the last one."""
        if not self.steps or step > self.steps[-1]:
            self.steps.append(step)
            self.minutes.append(minutes)
            self.values.append(value)

    def cut(self, step: float) -> None:
        """Takes away the points of later steps."""
        count = bisect_right(self.steps, step)
        for column in (self.steps, self.minutes, self.values):
            del column[count:]


@dataclass
class RunRecord:
    """What a log says.

    Attributes:
        series: figures by name, such as ``train.loss`` and ``val.psnr_novel``.
        step: the last step.
        minutes: training time, resumed parts included.
        start: the last line of the event ``start``, or empty.
        end: the line of the event ``end`` after it, or empty.
        warnings: steps and messages, the last thousand.
        losses: the last one of "train" and of "val"; NaN where it was not finite.
        most: the largest of "skipped" (steps) and "device_memory" (bytes), of all lines.
    """

    series: dict[str, Series] = field(default_factory=dict)
    step: int = 0
    minutes: float = 0.0
    start: dict[str, Any] = field(default_factory=dict)
    end: dict[str, Any] = field(default_factory=dict)
    warnings: list[tuple[int, str]] = field(default_factory=list)
    losses: dict[str, float] = field(default_factory=dict)
    most: dict[str, float] = field(default_factory=dict)

    def values(self, name: str) -> Sequence[float]:
        """The values of a figure by its name in ``series``; none where it lacks."""
        return self.series[name].values if name in self.series else ()


def read_run_log(path: Path) -> RunRecord:
    """Reads a log; lines that are damaged, cut off or of another kind are passed over.

    A run that was resumed wrote some steps twice: those of the last time count. Lines of older
    versions have no minutes, which then follow from the clock of the machine.

    Args:
        path: the ``log.jsonl``.

    Raises:
        UserError: there is no such file, or it cannot be read.
    """
    record = RunRecord()
    began, before = 0.0, 0.0  # the clock of this part, seconds, and the minutes of those before
    for line in read_lines(path):
        step, clock = line["step"], _number(line.get("time"))
        event = line["event"]
        for name in ("skipped", "device_memory"):
            if (number := _number(line.get(name))) is not None:
                record.most[name] = max(number, record.most.get(name, 0.0))
        if event == "start":
            for series in record.series.values():  # the run has gone back to this step
                series.cut(step)
            last = [series.minutes[-1] for series in record.series.values() if series.minutes]
            record.minutes = max(last, default=0.0)
            record.start, record.end = line, {}
            began, before = clock or 0.0, record.minutes
        elif event in ("train", "val"):
            minutes = _number(line.get("minutes"))
            if minutes is None:
                minutes = before + max(0.0, (clock or began) - began) / 60
            record.minutes = max(record.minutes, minutes)
            if "loss" in line:  # null for one that is not finite
                loss = _number(line["loss"])
                record.losses[event] = math.nan if loss is None else loss
            for name, number in ((name, _number(value)) for name, value in line.items()):
                wanted = event == "val" or name in _TRAIN or name.startswith("loss_")
                if number is None or not wanted or name in _NO_FIGURES or not _NAME.fullmatch(name):
                    continue
                name = f"{event}.{name}"
                if name in record.series or len(record.series) < _MOST_SERIES:
                    record.series.setdefault(name, Series()).add(step, record.minutes, number)
        elif event == "end":
            record.end = line
        elif event == "warning" and isinstance(line.get("message"), str):
            record.warnings = [*record.warnings, (step, line["message"])][-_MOST_WARNINGS:]
        record.step = step
    return record


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """The lines of a log that are whole, with their ``event`` and ``step``; others are passed over.

    Raises:
        UserError: as ``read_run_log``.
    """
    for line in documents.read_lines(path, dict[str, Any]):
        step = line.get("step")
        if type(step) is int and 0 <= step <= _MOST_STEPS and "event" in line:
            yield line


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return float(value) if abs(value) < 1e300 and math.isfinite(value) else None
