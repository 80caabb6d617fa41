"""Tables of a model and its baselines, with intervals, and the paired differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gamba_warp.image_metrics import METRICS, Metric, all_figures, on_grounds

from ..averages import LEVEL, bootstrap, minus, summary_of
from ..tables import Column, Row, figures, markdown
from .compare import NEARLY_EMPTY

Record = dict[str, Any]
Records = dict[str, Record]  # uid -> what summary() returns
Rows = list[dict[str, Any]]
MEAN_ERROR = "psnr_of_mean_error"


def _decibels(errors: np.ndarray) -> np.ndarray:
    """PSNR of the mean of squared errors ``[.., n]``."""
    return -10 * np.log10(errors.mean(-1))


def _rows(
    named: dict[str, list[tuple[Record, ...]]], statistic: Callable[[np.ndarray], np.ndarray]
) -> Rows:
    """A row for each kind of views and each name that has objects with such views.

    Args:
        named: by name, of each object its record, or two, whose difference counts.
        statistic: makes a PSNR of their mean squared errors ``[1 or 2, .., n]``.
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
    """Rows of all candidates, novel views before the input.

    Returns:
        ``{views, name, objects}``, for each figure ``{mean, interval, median, median_interval}``,
        and ``psnr_of_mean_error`` ``{value, interval}``.
    """
    named = {name: [(r,) for r in records.values()] for name, records in candidates.items()}
    return _rows(named, lambda drawn: _decibels(drawn[0]))


def differences_of(model: Records, baselines: dict[str, Records]) -> Rows:
    """Rows like ``table_of``'s: the model's value minus the baseline's, over objects with both."""
    named = {
        f"model - {name}": [(model[uid], r) for uid, r in records.items() if uid in model]
        for name, records in baselines.items()
    }
    return _rows(named, lambda drawn: _decibels(drawn[0]) - _decibels(drawn[1]))


def tables_of(candidates: dict[str, Records]) -> dict[str, Rows]:
    """``table``, of all candidates, and ``differences``, of "model" to each other one."""
    others = {name: records for name, records in candidates.items() if name != "model"}
    gains = differences_of(candidates["model"], others)
    return {"table": table_of(candidates), "differences": gains}


def without_nearly_empty(candidates: dict[str, Records]) -> dict[str, Records]:
    """The same records without the views that are nearly empty."""
    return {
        name: {uid: record["without_nearly_empty"] for uid, record in records.items()}
        for name, records in candidates.items()
    }


def means(rows: Rows, signed: bool = False, shown: dict[str, Metric] = METRICS) -> str:
    """A Markdown table of the rows' means, with their intervals.

    Args:
        rows: those of ``table_of`` or ``differences_of``.
        signed: whether positive means get a plus sign.
        shown: the figures; those on white unless told.
    """
    return _markdown(rows, {key: Column(m.head, m.digits) for key, m in shown.items()}, signed)


def _on_grounds(rows: Rows, signed: bool = False) -> str:
    """As ``means``: of the figures on black and on grey."""
    return means(rows, signed, on_grounds())


def _medians(rows: Rows, signed: bool = False) -> str:
    """As ``means``: the PSNR of the mean error, and the medians over objects."""
    columns = {MEAN_ERROR: Column("PSNR of mean error [dB]", METRICS["psnr"].digits)}
    columns |= {key: Column(f"median {m.head}", m.digits) for key, m in METRICS.items()}
    errors = [row[MEAN_ERROR] for row in rows]
    rows = [
        row | {MEAN_ERROR: {"median": error["value"], "median_interval": error["interval"]}}
        for row, error in zip(rows, errors)
    ]
    return _markdown(rows, columns, signed, "median")


def _markdown(rows: Rows, columns: dict[str, Column], signed: bool, of: str = "mean") -> str:
    names = [[row["views"], row["name"], str(row["objects"])] for row in rows]
    shown = [Row(name, row, signed) for name, row in zip(names, rows)]
    return markdown(figures(["views", "", "objects"], columns, shown, of))


def nearly_empty_line(counts: dict[str, Any]) -> str:
    """Says how many views are nearly empty, and what counts as such."""
    few = f"the object covers under {100 * NEARLY_EMPTY:g} % of the true picture"
    if not counts["views"]:
        return f"None of the {counts['of_views']} views is nearly empty ({few})."
    return (
        f"{counts['views']} of {counts['of_views']} views, of {counts['objects']} of "
        f"{counts['of_objects']} objects, are nearly empty ({few})."
    )


def page(report: dict[str, Any]) -> str:
    """The text of ``table.md``, from a report of ``eval-views``."""
    counts, lpips = report["nearly_empty"], report["protocol"]["lpips_reason"]
    parts = [means(report["table"])]
    if report["differences"]:
        parts += ["Differences, object by object:", means(report["differences"], signed=True)]
    parts += [
        f"Means over objects of means over views, with {100 * LEVEL:g} % bootstrap intervals over "
        "objects. LPIPS: less is better."
        + (f" LPIPS left out: {lpips}." if lpips else "")
        + f" {nearly_empty_line(counts)}"
        + (" They count in these tables." if counts["views"] else "")
    ]
    more = {
        "The same on black and on grey, both sides composited by their alpha; means:": _on_grounds,
        "PSNR of the mean squared error over all views and objects; "
        "medians over objects:": _medians,
    }
    tables = [(title, show, report) for title, show in more.items()]
    if counts["views"]:
        title = "Means as above, without the views that are nearly empty:"
        tables.append((title, means, report["without_nearly_empty"]))
    for title, show, part in tables:
        # the rows of novel views; those of the input where there are no novel ones
        rows, gains = (
            [row for row in part[key] if row["views"] == part[key][0]["views"]]
            for key in ("table", "differences")
        )
        parts += [title, show(rows)] if rows else []
        parts += [show(gains, signed=True)] if gains else []
    return "\n\n".join(parts) + "\n"
