"""Tables of a model and its baselines, with intervals, and the paired differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gamba_warp.image_metrics import METRICS, all_figures, on_grounds

from ..averages import LEVEL, bootstrap, minus, summary_of
from ..tables import Column, Row, columns_of, figures, markdown
from .compare import NEARLY_EMPTY

Record = dict[str, Any]
Records = dict[str, Record]  # uid -> result of summary()
Rows = list[dict[str, Any]]
Columns = dict[str, Column]
MEAN_ERROR = "psnr_of_mean_error"


def _decibels(errors: np.ndarray) -> np.ndarray:
    """Return the PSNR of the mean of squared errors ``[.., n]``."""
    return -10 * np.log10(errors.mean(-1))


def _rows(
    named: dict[str, list[tuple[Record, ...]]], statistic: Callable[[np.ndarray], np.ndarray]
) -> Rows:
    """Return a row for each kind of views and each name that has such views.

    Args:
        named: by name, a tuple per object: one record, or two to subtract.
        statistic: PSNR of mean squared errors ``[1 or 2, .., n]``.
    """
    rows = []
    for kind in ("novel", "input"):
        for name, tuples in named.items():
            parts = [[r["input"] if kind == "input" else r for r in some] for some in tuples]
            parts = [some for some in parts if all(values["psnr"] is not None for values in some)]
            if not parts:
                continue
            values = [some[0] if len(some) == 1 else minus(*some) for some in parts]
            errors = np.array([[record["mse"] for record in some] for some in parts]).T
            error = {"value": float(statistic(errors)), "interval": bootstrap(errors, statistic)}
            rows.append(
                {
                    **{"views": kind, "name": name, "objects": len(parts)},
                    **{key: summary_of([v[key] for v in values]) for key in all_figures()},
                    MEAN_ERROR: error,
                }
            )
    return rows


def table_of(candidates: dict[str, Records]) -> Rows:
    """Return rows of all candidates, novel views before the input.

    Returns:
        ``{views, name, objects}``, for each figure ``{mean, interval, median, median_interval}``,
        and ``psnr_of_mean_error`` ``{value, interval}``.
    """
    named = {name: [(r,) for r in records.values()] for name, records in candidates.items()}
    return _rows(named, lambda drawn: _decibels(drawn[0]))


def differences_of(model: Records, baselines: dict[str, Records]) -> Rows:
    """Return rows like ``table_of``: model minus baseline, over objects with both."""
    named = {
        f"model - {name}": [(model[uid], r) for uid, r in records.items() if uid in model]
        for name, records in baselines.items()
    }
    return _rows(named, lambda drawn: _decibels(drawn[0]) - _decibels(drawn[1]))


def tables_of(candidates: dict[str, Records]) -> dict[str, Rows]:
    """Return ``table`` of all candidates and ``differences`` of "model" to each other one."""
    others = {name: records for name, records in candidates.items() if name != "model"}
    gains = differences_of(candidates["model"], others)
    return {"table": table_of(candidates), "differences": gains}


def without_nearly_empty(candidates: dict[str, Records]) -> dict[str, Records]:
    """Return the records without nearly empty views."""
    return {
        name: {uid: record["without_nearly_empty"] for uid, record in records.items()}
        for name, records in candidates.items()
    }


def means(
    rows: Rows, signed: bool = False, columns: Columns | None = None, of: str = "mean"
) -> str:
    """Return a Markdown table of rows, with intervals.

    Args:
        rows: from ``table_of`` or ``differences_of``.
        signed: positive figures get a plus sign.
        columns: by figure; None: those on white.
        of: statistic shown, "mean" or "median".
    """
    shown = []
    for row in rows:
        error = row[MEAN_ERROR]  # neither mean nor median; shown next to the medians
        error = {"median": error["value"], "median_interval": error["interval"]}
        names = row["views"], row["name"], str(row["objects"])
        shown.append(Row(names, row | {MEAN_ERROR: error}, signed))
    return markdown(figures(["views", "", "objects"], columns or columns_of(METRICS), shown, of))


def page(report: dict[str, Any]) -> str:
    """Return the text of ``table.md`` from a report of ``eval-views``."""
    counts, lpips = report["nearly_empty"], report["protocol"]["lpips_reason"]
    few = f"nearly empty (the object covers under {100 * NEARLY_EMPTY:g} % of the true image)."
    note = f"None of the {counts['of_views']} views is {few}"
    if counts["views"]:
        note = (
            f"{counts['views']} of {counts['of_views']} views, of {counts['objects']} of "
            f"{counts['of_objects']} objects, are {few} They count in these tables."
        )
    parts = [means(report["table"])]
    if report["differences"]:
        parts += ["Differences, object by object:", means(report["differences"], signed=True)]
    parts += [
        f"Means over objects of means over views, with {100 * LEVEL:g} % bootstrap intervals over "
        f"objects. LPIPS: less is better.{f' LPIPS left out: {lpips}.' if lpips else ''} {note}"
    ]
    white = columns_of(METRICS)
    medians = {MEAN_ERROR: Column("PSNR of mean error [dB]", METRICS["psnr"].digits)}
    medians |= {key: Column(f"median {title}", digits) for key, (title, digits) in white.items()}
    more = [
        (
            "The same on black and on grey, both sides composited by their alpha; means:",
            *(report, columns_of(on_grounds()), "mean"),
        ),
        (
            "PSNR of the mean squared error over all views and objects; medians over objects:",
            *(report, medians, "median"),
        ),
    ]
    if counts["views"]:
        title = "Means as above, without the views that are nearly empty:"
        more.append((title, report["without_nearly_empty"], white, "mean"))
    for title, part, columns, of in more:
        # Rows of the novel views, or of the input without novel ones.
        rows, gains = (
            [row for row in part[key] if row["views"] == part[key][0]["views"]]
            for key in ("table", "differences")
        )
        parts += [title, means(rows, False, columns, of)] if rows else []
        parts += [means(gains, True, columns, of)] if gains else []
    return "\n\n".join(parts) + "\n"
