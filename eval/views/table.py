"""One table of a model and its baselines, with intervals, and the paired differences."""

from __future__ import annotations

from typing import Any

from ..report import LEVEL, intervals_of, mean_of
from .compare import METRICS

Records = dict[str, dict[str, Any]]  # uid -> what summary() returns
KINDS = ("novel", "input")
_LABELS = {"psnr": "PSNR [dB]", "ssim": "SSIM", "lpips": "LPIPS", "mask_iou": "mask IoU"}
_DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3, "mask_iou": 3}


def _row(kind: str, name: str, records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The means and intervals of one candidate; None where no object has such views."""
    values = [record["input"] if kind == "input" else record for record in records]
    values = [{key: value[key] for key in METRICS} for value in values]
    values = [value for value in values if value["psnr"] is not None]
    if not values:
        return None
    means, intervals = mean_of(values), intervals_of(values)
    cells = {key: {"mean": means[key], "interval": intervals[key]} for key in METRICS}
    return {"views": kind, "name": name, "objects": len(values), **cells}


def table_of(candidates: dict[str, Records]) -> list[dict[str, Any]]:
    """Rows ``{views, name, objects, psnr: {mean, interval}, …}``, novel views before the input."""
    rows = [
        _row(kind, name, list(records.values()))
        for kind in KINDS
        for name, records in candidates.items()
    ]
    return [row for row in rows if row is not None]


def differences_of(model: Records, baselines: dict[str, Records]) -> list[dict[str, Any]]:
    """Rows like ``table_of``'s: the model's value minus the baseline's, over objects with both."""
    rows = []
    for kind in KINDS:
        for name, records in baselines.items():
            shared = [uid for uid in records if uid in model]
            pairs = [_minus(model[uid], records[uid]) for uid in shared]
            rows.append(_row(kind, f"model - {name}", pairs))
    return [row for row in rows if row is not None]


def _minus(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    result = {}
    for key in (*METRICS, *(("input",) if "input" in a else ())):
        if key == "input":
            result[key] = _minus(a[key], b[key])
        else:
            result[key] = None if a[key] is None or b[key] is None else a[key] - b[key]
    return result


def _cell(key: str, value: dict[str, Any], sign: str) -> str:
    mean, interval, digits = value["mean"], value["interval"], _DIGITS[key]
    if mean is None:
        return "absent"
    ends = "" if interval is None else " [" + ", ".join(f"{x:.{digits}f}" for x in interval) + "]"
    return f"{mean:{sign}.{digits}f}{ends}"


def markdown(rows: list[dict[str, Any]], signed: bool = False) -> str:
    """The rows as a Markdown table whose columns are aligned in plain text too.

    Args:
        rows: those of ``table_of`` or ``differences_of``.
        signed: whether positive means get a plus sign.
    """
    sign = "+" if signed else ""
    lines = [["views", "", "objects", *_LABELS.values()]]
    for row in rows:
        cells = [_cell(key, row[key], sign) for key in METRICS]
        lines.append([row["views"], row["name"], str(row["objects"]), *cells])
    widths = [max(map(len, column)) for column in zip(*lines)]
    texts = ["| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in lines]
    rule = "| " + " | ".join("-" * max(3, width) for width in widths) + " |"
    return "\n".join([texts[0], rule, *texts[1:]])


def page(report: dict[str, Any]) -> str:
    """The text of ``table.md``, from a report of ``eval-views``."""
    parts = [markdown(report["table"])]
    if report["differences"]:
        parts += ["Differences, object by object:", markdown(report["differences"], signed=True)]
    share = f"{100 * LEVEL:g} %"
    parts += [
        f"Means over objects of means over views, with {share} bootstrap intervals over objects. "
        "LPIPS: less is better."
    ]
    if report["protocol"]["lpips_reason"]:
        parts[-1] += f" LPIPS left out: {report['protocol']['lpips_reason']}."
    return "\n\n".join(parts) + "\n"
