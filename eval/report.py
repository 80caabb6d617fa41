"""The report of a batch: one JSON, one CSV, means over objects, failures listed by name."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

from gamba_warp import __version__
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_path, write_json

OK, FAILED = "ok", "failed"


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
    result: dict[str, Any] = {}
    for key in dict.fromkeys(key for record in records for key in record):
        values = [record.get(key) for record in records]
        some = [v for v in values if v is not None]
        if some and all(isinstance(v, dict) for v in some):
            result[key] = mean_of(some)
        elif all(isinstance(v, int | float) and not isinstance(v, bool) for v in some):
            result[key] = sum(some) / len(some) if some else None
    return result


def flat(record: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dicts to one level, keys joined by a dot; lists are left out."""
    result: dict[str, Any] = {}
    for key, value in record.items():
        if isinstance(value, dict):
            result |= flat(value, f"{prefix}{key}.")
        elif not isinstance(value, list):
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


def write_report(
    folder: Path,
    protocol: dict[str, Any],
    objects: list[dict[str, Any]],
    used: dict[str, str],
    left_out: tuple[str, ...] = (),
    **more: Any,
) -> dict[str, Any]:
    """Writes ``report.json`` and ``objects.csv`` into an existing folder.

    Args:
        folder: where.
        protocol: everything that decides what the numbers mean.
        objects: one record an object, with ``name`` and ``status``; failed ones have ``reason``.
        used: versions of packages.
        left_out: keys of the records that have no meaningful mean.
        more: further top-level entries.

    Returns:
        The report as written.
    """
    objects = sorted(objects, key=lambda record: record["name"])
    done = [record for record in objects if record["status"] == OK]
    numbers = [{k: v for k, v in record.items() if k not in left_out} for record in done]
    failures = [
        {"name": record["name"], "reason": record["reason"]}
        for record in objects
        if record["status"] == FAILED
    ]
    report = {
        "protocol": protocol,
        "versions": used,
        "objects": objects,
        "mean": mean_of(numbers),
        "num_ok": len(done),
        "num_failed": len(failures),
        "failures": failures,
        **more,
    }
    write_json(folder / "report.json", report)
    rows = [flat(record) for record in objects]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with atomic_path(folder / "objects.csv") as temporary:
        with open(temporary, "w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(rows)
    return report


def print_summary(report: dict[str, Any], folder: Path) -> int:
    """Prints means and failures; returns the exit code: 1 where any object failed."""
    for name, value in flat(report["mean"]).items():
        print(f"{name:<24} {'n/a' if value is None else f'{value:.5g}'}")
    for item in report["failures"]:
        print(f"failed: {item['name']}: {item['reason']}")
    print(f"{report['num_ok']} evaluated, {report['num_failed']} failed; {folder / 'report.json'}")
    return 1 if report["failures"] else 0
