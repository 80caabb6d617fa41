"""Reading of a run's ``log.jsonl``: figures over steps and hours, and messages."""

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
# Figures read of a training line; of a validation all are.
_TRAIN = {"loss", "psnr", "lr", "grad_norm", "views_per_second", "seconds"}
_NAME = re.compile(r"[a-z][a-z_]{0,30}")
_EVENT = re.compile(r"train|best|val|val/[^/\x00-\x1f]{1,80}")  # the last of a further dataset
_MOST_SERIES = 200
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
        """Append a point, if its step is later than that of the last one."""
        if not self.steps or step > self.steps[-1]:
            self.steps.append(step)
            self.minutes.append(minutes)
            self.values.append(value)

    def cut(self, step: float) -> None:
        """Remove the points of later steps."""
        count = bisect_right(self.steps, step)
        for column in (self.steps, self.minutes, self.values):
            del column[count:]


@dataclass
class RunRecord:
    """Content of a log.

    Attributes:
        series: figures by name, such as ``train.loss``, ``val.psnr_novel`` and, for a further
            dataset NAME, ``val/NAME.psnr_novel``; ``best.psnr`` (or another
            figure of ``--best-by``) has a point for each validation that was the best so far.
        step: the last step.
        minutes: training time, resumed parts included.
        start: the last line of the event ``start``, or empty.
        end: the line of the event ``end`` after it, or empty.
        warnings: steps and messages, the last thousand.
        losses: the last one of "train" and of each "val"; NaN if it was not finite.
        most: maxima of "skipped" (steps) and "device_memory" (bytes) over all lines.
    """

    series: dict[str, Series] = field(default_factory=dict)
    step: int = 0
    minutes: float = 0.0
    start: dict[str, Any] = field(default_factory=dict)
    end: dict[str, Any] = field(default_factory=dict)
    warnings: list[tuple[int, str]] = field(default_factory=list)
    losses: dict[str, float] = field(default_factory=dict)
    most: dict[str, float] = field(default_factory=dict)

    @property
    def validated(self) -> list[str]:
        """Names of the further validation datasets, in the order of the log."""
        found = [name[4:].rpartition(".")[0] for name in self.series if name.startswith("val/")]
        return list(dict.fromkeys(found))

    def values(self, name: str) -> Sequence[float]:
        """Return the values of a figure by its name in ``series``; empty if missing."""
        return self.series[name].values if name in self.series else ()


def read_run_log(path: Path) -> RunRecord:
    """Read a log; damaged, truncated and unknown lines are skipped.

    A resumed run may have logged steps twice; the last ones count. Lines of older versions have no
    minutes, which are then derived from the clock.

    Args:
        path: the ``log.jsonl``.

    Raises:
        UserError: the file is missing or cannot be read.
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
            for series in record.series.values():  # the run was reset to this step
                series.cut(step)
            last = [series.minutes[-1] for series in record.series.values() if series.minutes]
            record.minutes = max(last, default=0.0)
            record.start, record.end = line, {}
            began, before = clock or 0.0, record.minutes
        elif isinstance(event, str) and _EVENT.fullmatch(event):
            minutes = _number(line.get("minutes"))
            if minutes is None:
                minutes = before + max(0.0, (clock or began) - began) / 60
            record.minutes = max(record.minutes, minutes)
            if "loss" in line:  # null if it was not finite
                loss = _number(line["loss"])
                record.losses[event] = math.nan if loss is None else loss
            for name, number in ((name, _number(value)) for name, value in line.items()):
                wanted = event != "train" or name in _TRAIN or name.startswith("loss_")
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
    """Yield the complete lines of a log with ``event`` and ``step``; others are skipped.

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
