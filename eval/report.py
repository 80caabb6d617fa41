"""Report over many objects: means with intervals and failures by name, as JSON and CSV."""

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

from gamba_warp.errors import UserError, escaped, first_line
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
        """Time one stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, self._digits)


def flat(record: dict[str, Any], prefix: str = "", lists: bool = False) -> dict[str, Any]:
    """Flatten nested dicts, with keys joined by dots; lists are dropped unless ``lists``."""
    result: dict[str, Any] = {}
    for key, value in record.items():
        if isinstance(value, dict):
            result |= flat(value, f"{prefix}{key}.", lists)
        elif lists or not isinstance(value, list):
            result[prefix + key] = value
    return result


def check_finite(record: dict[str, Any]) -> dict[str, Any]:
    """Return the record unchanged.

    Raises:
        UserError: a number, nested or in a list, is NaN or infinite; the message names it.
    """
    for key, value in flat(record, lists=True).items():
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, dict):
                check_finite({key: item})
            elif isinstance(item, float) and not math.isfinite(item):
                raise UserError(f"{key} is {item}")
    return record


def finite_or_none(value: Any) -> Any:
    """Replace numbers that JSON cannot hold, nested ones too, by None."""
    if isinstance(value, dict):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_or_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def failure(name: str, error: Exception | str) -> dict[str, str]:
    """Return the record of an object that failed, with a reason of one line."""
    return {"name": name, "status": FAILED, "reason": first_line(error)}


def make_report(
    protocol: dict[str, Any],
    objects: list[dict[str, Any]],
    used: dict[str, str],
    left_out: tuple[str, ...] = (),
    **more: Any,
) -> dict[str, Any]:
    """Make the report of a batch.

    Args:
        protocol: everything that defines the numbers.
        objects: one record for each object, with ``name`` and ``status``, and ``reason`` if it
            failed. A record with a number that is not finite becomes a failure, so that it does not
            cost the whole report.
        used: versions of packages by name.
        left_out: keys of the records without a meaningful mean.
        more: further top-level entries.

    Returns:
        ``protocol, versions, bootstrap`` (parameters of the intervals), the entries of
        ``over_objects``, and ``more``.
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
    """Return the part of a report computed from the records; arguments as for ``make_report``.

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
    averaged = [{k: v for k, v in record.items() if k not in left_out} for record in done]
    failed = [record for record in checked if record["status"] == FAILED]
    failures = [{"name": record["name"], "reason": record["reason"]} for record in failed]
    return {
        "objects": checked,
        "mean": mean_of(averaged),
        "interval": intervals_of(averaged),
        "median": median_of(averaged),
        "num_ok": len(done),
        "num_failed": len(failures),
        "failures": failures,
    }


def json_of(report: dict[str, Any]) -> str:
    """Return the text of ``report.json``."""
    return json.dumps(report, indent=2, allow_nan=False) + "\n"


def csv_of(report: dict[str, Any]) -> str:
    """Return one CSV line per object; keys are ``outer.inner``, and lists of words are joined."""

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
    """Write ``report.json`` and ``objects.csv`` into an existing folder, each atomically.

    Raises:
        UserError: they cannot be written there. They are then written to a temporary folder, if
            possible, which the message names.
    """

    def save(target: Path) -> None:
        write_json(target / "report.json", report)
        write_text(target / "objects.csv", csv_of(report))

    try:
        save(folder)
    except UserError as error:
        try:
            save(other := Path(tempfile.mkdtemp(prefix="gamba-report-")))
        except (OSError, UserError):
            raise error from None
        raise UserError(f"{error}; the report is in {other}") from error


def summary_lines(report: dict[str, Any]) -> list[str]:
    """Return lines ``name  mean [low, high]  median`` of each number, and one of each failure."""
    lines, intervals, medians = [], flat(report["interval"], lists=True), flat(report["median"])
    for name, value in flat(report["mean"]).items():
        shown, ends = "n/a" if value is None else f"{value:.5g}", intervals.get(name)
        if ends is not None:
            shown += f" [{ends[0]:.5g}, {ends[1]:.5g}]  median {medians[name]:.5g}"
        lines.append(f"{name:<24} {shown}")
    failed = (f"failed: {item['name']}: {item['reason']}" for item in report["failures"])
    return lines + [escaped(line) for line in failed]


def count_line(report: dict[str, Any], folder: Path | None, beside: int = 0) -> str:
    """Return the counts of evaluated and failed objects and the path of the report.

    Args:
        report: the result of ``make_report``.
        folder: where it was written, or None.
        beside: number of failures of baselines, counted separately.
    """
    others = f", {beside} of baselines failed" if beside else ""
    file = f"; {folder / 'report.json'}" if folder else ""
    return f"{report['num_ok']} evaluated, {report['num_failed']} failed{others}{file}"


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Redirect stdout, of libraries too, to stderr: stdout is for the report."""
    sys.stdout.flush()
    saved = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(saved, 1)
        os.close(saved)
