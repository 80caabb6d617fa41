"""The report of a batch: one JSON, one CSV, means over objects, failures listed by name."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gamba_warp import __version__
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, write_json

OK, FAILED = "ok", "failed"
LEVEL = 0.95  # of the intervals
RESAMPLES = 10_000


def versions(*packages: str) -> dict[str, str]:
    """Installed versions of gamba_warp and of the packages named, where they are installed."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"gamba_warp": __version__}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def mean_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Means of the numbers of like records, nested ones too.

    A number that is None in some records is averaged over the others; None where none has it.
    Texts, lists and booleans are left out.
    """
    return _over_objects(records, lambda values: sum(values) / len(values))


def intervals_of(
    records: list[dict[str, Any]],
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> dict[str, Any]:
    """Bootstrap intervals of the means of ``mean_of``: percentiles over objects drawn anew.

    Objects are drawn with repetition, as many as there are, and averaged (Efron 1979). The interval
    tells how far the mean depends on the choice of objects, nothing else; of a handful of objects
    it is too narrow.

    Args:
        records: like records, one an object.
        level: share of the resampled means within the interval.
        resamples: how often objects are drawn.
        seed: of the draws; the same for every number.

    Returns:
        The keys of ``mean_of``, each ``[low, high]``; None with fewer than 2 objects.
    """

    def interval(values: list[float]) -> list[float] | None:
        if len(values) < 2:
            return None
        random, x = np.random.default_rng(seed), np.asarray(values, np.float64)
        batch = max(1, 1_000_000 // len(x))  # draws at once: bounds the memory
        means = [
            x[random.integers(0, len(x), (min(batch, resamples - start), len(x)))].mean(1)
            for start in range(0, resamples, batch)
        ]
        ends = [(1 - level) / 2, (1 + level) / 2]
        return [float(value) for value in np.quantile(np.concatenate(means), ends)]

    return _over_objects(records, interval)


def _over_objects(records: list[dict[str, Any]], summary: Callable) -> dict[str, Any]:
    """``summary`` of the values that each number has in the records, or None where it has none."""
    result: dict[str, Any] = {}
    for key in dict.fromkeys(key for record in records for key in record):
        values = [record.get(key) for record in records]
        some = [v for v in values if v is not None]
        if some and all(isinstance(v, dict) for v in some):
            result[key] = _over_objects(some, summary)
        elif all(isinstance(v, int | float) and not isinstance(v, bool) for v in some):
            result[key] = summary(some) if some else None
    return result


def flat(record: dict[str, Any], prefix: str = "", lists: bool = False) -> dict[str, Any]:
    """Nested dicts to one level, keys joined by a dot; lists are left out unless asked for."""
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
        UserError: one of its numbers, nested ones too, is NaN or infinite; names it.
    """
    for key, value in flat(record).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise UserError(f"{key} is {value}")
    return record


def failure(name: str, error: Exception | str) -> dict[str, str]:
    """The record of an object that could not be evaluated; the reason is one line."""
    lines = str(error).strip().splitlines()
    reason = lines[0] if lines else type(error).__name__
    return {"name": name, "status": FAILED, "reason": reason}


def make_report(
    protocol: dict[str, Any],
    objects: list[dict[str, Any]],
    used: dict[str, str],
    left_out: tuple[str, ...] = (),
    **more: Any,
) -> dict[str, Any]:
    """The report of a batch.

    Args:
        protocol: everything that decides what the numbers mean.
        objects: one record an object, with ``name`` and ``status``; failed ones have ``reason``.
        used: versions of packages.
        left_out: keys of the records that have no meaningful mean.
        more: further top-level entries.

    Returns:
        ``protocol, versions, objects`` (by name), ``mean, interval`` (of the mean, over objects),
        ``bootstrap`` (how the intervals are made), ``num_ok, num_failed, failures`` and ``more``.
    """
    objects = sorted(objects, key=lambda record: record["name"])
    done = [record for record in objects if record["status"] == OK]
    numbers = [{k: v for k, v in record.items() if k not in left_out} for record in done]
    failures = [
        {"name": record["name"], "reason": record["reason"]}
        for record in objects
        if record["status"] == FAILED
    ]
    return {
        "protocol": protocol,
        "versions": used,
        "objects": objects,
        "mean": mean_of(numbers),
        "interval": intervals_of(numbers),
        "bootstrap": {"level": LEVEL, "resamples": RESAMPLES, "seed": 0, "method": "percentile"},
        "num_ok": len(done),
        "num_failed": len(failures),
        "failures": failures,
        **more,
    }


def csv_of(report: dict[str, Any]) -> str:
    """One line an object, failed ones too; nested numbers as ``outer.inner``, words by a blank."""
    rows = [
        flat({key: " ".join(value) if _is_words(value) else value for key, value in record.items()})
        for record in report["objects"]
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _is_words(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def save_report(report: dict[str, Any], folder: Path) -> None:
    """Writes ``report.json`` and ``objects.csv`` into an existing folder. Raises UserError."""
    write_json(folder / "report.json", report)
    with atomic_path(folder / "objects.csv") as temporary:
        temporary.write_bytes(csv_of(report).encode())


def write_report(folder: Path, *args: Any, **kwargs: Any) -> dict[str, Any]:
    """``make_report`` of the other arguments, written into an existing folder; returns it."""
    report = make_report(*args, **kwargs)
    save_report(report, folder)
    return report


def summary_lines(report: dict[str, Any]) -> list[str]:
    """Means with their intervals, ``name  mean [low, high]``, and failures."""
    lines, intervals = [], flat(report["interval"], lists=True)
    for name, value in flat(report["mean"]).items():
        shown, ends = "n/a" if value is None else f"{value:.5g}", intervals.get(name)
        if ends is not None:
            shown += f" [{ends[0]:.5g}, {ends[1]:.5g}]"
        lines.append(f"{name:<24} {shown}")
    return lines + [f"failed: {item['name']}: {item['reason']}" for item in report["failures"]]


def print_summary(report: dict[str, Any], folder: Path | None = None) -> int:
    """Prints ``summary_lines`` and counts; returns the exit code: 1 where any object failed."""
    print("\n".join(summary_lines(report)))
    where = f"; {folder / 'report.json'}" if folder else ""
    print(f"{report['num_ok']} evaluated, {report['num_failed']} failed{where}")
    return 1 if report["failures"] else 0
