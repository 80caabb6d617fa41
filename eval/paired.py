"""Predicted shapes beside those of baselines: paired differences, and the table of both."""

from __future__ import annotations

from typing import Any

from .averages import LEVEL, intervals_of, mean_of, median, median_of, minus
from .report import OK, flat
from .tables import cell, markdown

PREDICTED = "predicted"  # name of the row of what is under test
METRICS = (
    "iou",
    "chamfer",
    "chamfer_squared",
    "accuracy",
    "completeness",
    "hausdorff",
    "fscore",
    "normal_consistency",
)
_SHOWN = {"iou": "Volume IoU", "chamfer": "Chamfer", "normal_consistency": "normal consistency"}
_DIGITS = 4


def differences_of(objects: list[dict[str, Any]], others: list[dict[str, Any]]) -> dict[str, Any]:
    """The metrics of shapes minus those of other shapes, over the objects that both have.

    Args:
        objects: records as ``eval-geometry`` makes them.
        others: those of a baseline.

    Returns:
        ``objects`` (how many), ``mean``, ``interval``, ``median`` and ``median_interval``.
    """
    known = {record["name"]: record for record in others if record["status"] == OK}
    pairs = [
        minus({key: record.get(key) for key in METRICS}, known[record["name"]])
        for record in objects
        if record["status"] == OK and record["name"] in known
    ]
    return {
        "objects": len(pairs),
        "mean": mean_of(pairs),
        "interval": intervals_of(pairs),
        "median": median_of(pairs),
        "median_interval": intervals_of(pairs, statistic=median),
    }


def page(report: dict[str, Any]) -> str:
    """The text of ``table.md``, from a report of ``eval-geometry`` with baselines."""
    rows = {PREDICTED: report, **report["baselines"]}
    counts = {name: part["num_ok"] for name, part in rows.items()}
    for name, part in report["differences"].items():
        label = f"{PREDICTED} - {name}"
        rows[label], counts[label] = part, part["objects"]
    keys = _columns(report)
    lines = {kind: [["", "objects", *keys.values()]] for kind in ("mean", "median")}
    for name, part in rows.items():
        intervals = flat(part["interval"], lists=True)
        for kind, table in lines.items():
            values, signed = flat(part[kind]), " - " in name
            ends = intervals if kind == "mean" else {}
            cells = [cell(values.get(k), ends.get(k), _DIGITS, signed) for k in keys]
            table.append([name, str(counts[name]), *cells])
    texts = [
        markdown(lines["mean"]),
        f"Means over objects with {100 * LEVEL:g} % bootstrap intervals over objects; differences "
        "object by object, over the objects that both have. Lengths: the truth's longest side is "
        "1. Chamfer: less is better.",
        "Medians over objects:",
        markdown(lines["median"]),
    ]
    return "\n\n".join(texts) + "\n"


def _columns(report: dict[str, Any]) -> dict[str, str]:
    """What the table shows, by key: of the F-scores the one in the middle."""
    thresholds = sorted(report["protocol"]["thresholds"])
    middle = thresholds[len(thresholds) // 2]
    return _SHOWN | {f"fscore.{middle}": f"F-score at {middle:g}"}
