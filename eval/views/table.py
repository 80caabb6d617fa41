"""Tables of a model and its baselines, with intervals, and the paired differences."""

from __future__ import annotations

from typing import Any

import numpy as np

from gamba_warp.conventions import ON_GROUNDS

from ..averages import LEVEL, bootstrap, minus, summary_of
from ..tables import cell, markdown
from .compare import METRICS, NEARLY_EMPTY

Record = dict[str, Any]
Records = dict[str, Record]  # uid -> what summary() returns
KINDS = ("novel", "input")
MEAN_ERROR = "psnr_of_mean_error"
_LABELS = {"psnr": "PSNR [dB]", "ssim": "SSIM", "lpips": "LPIPS", "mask_iou": "mask IoU"}
_GROUNDS = {key: f"{metric.upper()} on {ground}" for key, (metric, ground) in ON_GROUNDS.items()}
_DIGITS = {key: 2 if key.startswith("psnr") else 3 for key in (*METRICS, MEAN_ERROR)}


def _decibels(errors: np.ndarray) -> np.ndarray:
    """PSNR of the mean of squared errors ``[.., n]``."""
    return -10 * np.log10(errors.mean(-1))


def _row(kind: str, name: str, records: list[Record]) -> dict[str, Any] | None:
    """Means, medians and intervals of one candidate; None where no object has such views."""
    values = [record["input"] if kind == "input" else record for record in records]
    values = [value for value in values if value["psnr"] is not None]
    if not values:
        return None
    errors = np.array([value["mse"] for value in values])
    return {
        "views": kind,
        "name": name,
        "objects": len(values),
        **{key: summary_of([value[key] for value in values]) for key in METRICS},
        MEAN_ERROR: {"value": float(_decibels(errors)), "interval": bootstrap(errors, _decibels)},
    }


def _difference(kind: str, name: str, pairs: list[tuple[Record, Record]]) -> dict[str, Any] | None:
    """As ``_row``, of the first of each pair minus the second."""
    if kind == "input":
        pairs = [(a["input"], b["input"]) for a, b in pairs]
    pairs = [(a, b) for a, b in pairs if a["psnr"] is not None and b["psnr"] is not None]
    if not pairs:
        return None
    errors = np.array([[a["mse"] for a, _ in pairs], [b["mse"] for _, b in pairs]])

    gains = [minus(a, b) for a, b in pairs]

    def gain(drawn: np.ndarray) -> np.ndarray:
        return _decibels(drawn[0]) - _decibels(drawn[1])

    return {
        "views": kind,
        "name": name,
        "objects": len(pairs),
        **{key: summary_of([g[key] for g in gains]) for key in METRICS},
        MEAN_ERROR: {"value": float(gain(errors)), "interval": bootstrap(errors, gain)},
    }


def table_of(candidates: dict[str, Records]) -> list[dict[str, Any]]:
    """Rows of all candidates, novel views before the input.

    Returns:
        ``{views, name, objects}``, for each metric ``{mean, interval, median, median_interval}``,
        and ``psnr_of_mean_error`` ``{value, interval}``.
    """
    rows = [
        _row(kind, name, list(records.values()))
        for kind in KINDS
        for name, records in candidates.items()
    ]
    return [row for row in rows if row is not None]


def differences_of(model: Records, baselines: dict[str, Records]) -> list[dict[str, Any]]:
    """Rows like ``table_of``'s: the model's value minus the baseline's, over objects with both."""
    rows = [
        _difference(
            kind, f"model - {name}", [(model[uid], r) for uid, r in records.items() if uid in model]
        )
        for kind in KINDS
        for name, records in baselines.items()
    ]
    return [row for row in rows if row is not None]


def without_nearly_empty(candidates: dict[str, Records]) -> dict[str, Records]:
    """The same records without the views that are nearly empty."""
    return {
        name: {uid: record["without_nearly_empty"] for uid, record in records.items()}
        for name, records in candidates.items()
    }


def means(
    rows: list[dict[str, Any]], signed: bool = False, labels: dict[str, str] = _LABELS
) -> str:
    """A Markdown table of the rows' means, with their intervals.

    Args:
        rows: those of ``table_of`` or ``differences_of``.
        signed: whether positive means get a plus sign.
        labels: of the metrics shown; those on white unless told.
    """
    lines = [["views", "", "objects", *labels.values()]]
    for row in rows:
        cells = [cell(row[k]["mean"], row[k]["interval"], _DIGITS[k], signed) for k in labels]
        lines.append([row["views"], row["name"], str(row["objects"]), *cells])
    return markdown(lines)


def medians(rows: list[dict[str, Any]], signed: bool = False) -> str:
    """As ``means``: the PSNR of the mean error, and the medians over objects."""
    medians_of = [f"median {label}" for label in _LABELS.values()]
    lines = [["views", "", "objects", "PSNR of mean error [dB]", *medians_of]]
    for row in rows:
        error = row[MEAN_ERROR]
        cells = [cell(error["value"], error["interval"], _DIGITS[MEAN_ERROR], signed)]
        for key in _LABELS:
            value, ends = row[key]["median"], row[key]["median_interval"]
            cells.append(cell(value, ends, _DIGITS[key], signed))
        lines.append([row["views"], row["name"], str(row["objects"]), *cells])
    return markdown(lines)


def on_grounds(rows: list[dict[str, Any]], signed: bool = False) -> str:
    """As ``means``: of the figures on black and on grey."""
    return means(rows, signed, _GROUNDS)


def _first_kind(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of novel views; those of the input where there are no novel ones."""
    return [row for row in rows if row["views"] == rows[0]["views"]]


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
    counts, share = report["nearly_empty"], f"{100 * LEVEL:g} %"
    lpips = report["protocol"]["lpips_reason"]
    parts = [means(report["table"])]
    if report["differences"]:
        parts += ["Differences, object by object:", means(report["differences"], signed=True)]
    parts += [
        f"Means over objects of means over views, with {share} bootstrap intervals over objects. "
        "LPIPS: less is better." + (f" LPIPS left out: {lpips}." if lpips else "")
    ]
    tables = [(show, report["table"], report["differences"]) for show in (on_grounds, medians)]
    titles = [
        "The same on black and on grey, both sides composited by their alpha; means:",
        "PSNR of the mean squared error over all views and objects; medians over objects:",
    ]
    if counts["views"]:
        parts[-1] += f" {nearly_empty_line(counts)} They count in these tables."
        rest = report["without_nearly_empty"]
        tables.append((means, rest["table"], rest["differences"]))
        titles.append("Means as above, without the views that are nearly empty:")
    else:
        parts[-1] += f" {nearly_empty_line(counts)}"
    for title, (show, rows, differences) in zip(titles, tables):
        if rows:
            parts += [title, show(_first_kind(rows))]
        if differences:
            parts.append(show(_first_kind(differences), signed=True))
    return "\n\n".join(parts) + "\n"
