"""The report of many objects: means with intervals, failures by name, as JSON and as CSV."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gamba_warp.errors import UserError, first_line
from gamba_warp.files import write_json, write_text

from .averages import BOOTSTRAP, intervals_of, mean_of, median_of

OK, FAILED = "ok", "failed"


class Stopwatch:
    """Times the stages of an evaluation: ``with stopwatch("load"): …``.

    Attributes:
        seconds: by stage, rounded.
    """

    def __init__(self, digits: int) -> None:
        self.seconds: dict[str, float] = {}
        self._digits = digits

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Times one stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, self._digits)


def flat(record: dict[str, Any], prefix: str = "", lists: bool = False) -> dict[str, Any]:
    """Nested dicts in one level, with keys joined by a dot; lists only where asked for."""
    result: dict[str, Any] = {}
    for key, value in record.items():
        if isinstance(value, dict):
            result |= flat(value, f"{prefix}{key}.", lists)
        elif lists or not isinstance(value, list):
            result[prefix + key] = value
    return result


def check_finite(record: dict[str, Any]) -> dict[str, Any]:
    """Returns the record as it is.

    Raises:
        UserError: one of its numbers, nested ones and those of lists too, is NaN or infinite; names
            it.
    """
    for key, value in flat(record, lists=True).items():
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, dict):
                check_finite({key: item})
            elif isinstance(item, float) and not math.isfinite(item):
                raise UserError(f"{key} is {item}")
    return record


def finite_or_none(value: Any) -> Any:
    """The value with None for each number, nested ones too, that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_or_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def failure(name: str, error: Exception | str) -> dict[str, str]:
    """The record of an object that could not be evaluated; its reason is one line."""
    return {"name": name, "status": FAILED, "reason": first_line(error)}


def make_report(
    protocol: dict[str, Any],
    objects: list[dict[str, Any]],
    used: dict[str, str],
    left_out: tuple[str, ...] = (),
    **more: Any,
) -> dict[str, Any]:
    """Makes the report of a batch.

    Args:
        protocol: everything that decides what the numbers mean.
        objects: one record for each object, with ``name`` and ``status``, and ``reason`` where it
            failed. One with a number that is not finite becomes a failure: an evaluation of
            hours must not be lost when its report is written.
        used: versions of packages by name.
        left_out: keys of the records that have no meaningful mean.
        more: further top-level entries.

    Returns:
        ``protocol, versions, bootstrap`` (how the intervals are made), what ``over_objects``
        returns, and ``more``.
    """
    report = {
        "protocol": protocol,
        "versions": used,
        **over_objects(objects, left_out),
        "bootstrap": BOOTSTRAP,
        **more,
    }
    return finite_or_none(report)


def over_objects(objects: list[dict[str, Any]], left_out: tuple[str, ...] = ()) -> dict[str, Any]:
    """The part of a report that the records decide; arguments as for ``make_report``.

    Returns:
        ``objects`` (by name), ``mean, interval`` (of the mean, over objects), ``median, num_ok,
        num_failed`` and ``failures``.
    """
    checked = []
    for record in sorted(objects, key=lambda record: record["name"]):
        try:
            checked.append(check_finite(record) if record["status"] == OK else record)
        except UserError as error:
            checked.append(failure(record["name"], error))
    done = [record for record in checked if record["status"] == OK]
    numbers = [{k: v for k, v in record.items() if k not in left_out} for record in done]
    failed = [record for record in checked if record["status"] == FAILED]
    failures = [{"name": record["name"], "reason": record["reason"]} for record in failed]
    return {
        "objects": checked,
        "mean": mean_of(numbers),
        "interval": intervals_of(numbers),
        "median": median_of(numbers),
        "num_ok": len(done),
        "num_failed": len(failures),
        "failures": failures,
    }


def json_of(report: dict[str, Any]) -> str:
    """The text of ``report.json``."""
    return json.dumps(report, indent=2, allow_nan=False) + "\n"


def csv_of(report: dict[str, Any]) -> str:
    """A line of CSV for each object; keys are ``outer.inner``, lists of words become one text."""

    def plain(value: Any) -> Any:
        words = isinstance(value, list) and all(isinstance(item, str) for item in value)
        return " ".join(value) if words else value

    rows = [flat({k: plain(v) for k, v in record.items()}) for record in report["objects"]]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def save_report(report: dict[str, Any], folder: Path) -> None:
    """Writes ``report.json`` and ``objects.csv`` into an existing folder, each whole or not at all.

    Raises:
        UserError: they cannot be written there; they are then in a temporary folder, if that can be
            written, which the message names.
    """

    def save(place: Path) -> None:
        write_json(place / "report.json", report)
        write_text(place / "objects.csv", csv_of(report))

    try:
        save(folder)
    except UserError as error:
        try:
            save(other := Path(tempfile.mkdtemp(prefix="gamba-report-")))
        except (OSError, UserError):
            raise error from None
        raise UserError(f"{error}; the report is in {other}") from error


def summary_lines(report: dict[str, Any]) -> list[str]:
    """One line ``name  mean [low, high]  median`` for each number, and one for each failure."""
    lines, intervals, medians = [], flat(report["interval"], lists=True), flat(report["median"])
    for name, value in flat(report["mean"]).items():
        shown, ends = "n/a" if value is None else f"{value:.5g}", intervals.get(name)
        if ends is not None:
            shown += f" [{ends[0]:.5g}, {ends[1]:.5g}]  median {medians[name]:.5g}"
        lines.append(f"{name:<24} {shown}")
    return lines + [f"failed: {item['name']}: {item['reason']}" for item in report["failures"]]


def count_line(report: dict[str, Any], folder: Path | None, beside: int) -> str:
    """Return the counts of evaluated and failed objects and the path of the report.

    Args:
        report: what ``make_report`` returns.
        folder: where it was written, or None.
        beside: the number of failures of baselines.
    """
    others = f", {beside} of baselines failed" if beside else ""
    file = f"; {folder / 'report.json'}" if folder else ""
    return f"{report['num_ok']} evaluated, {report['num_failed']} failed{others}{file}"


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Sends what is printed meanwhile, by libraries too, to stderr: stdout is for the report."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)
