"""Table of an ablation: means over objects and seeds, and paired differences."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import msgspec
from msgspec import to_builtins

from ..image_metrics import METRICS
from ..untrusted.documents import read_document, read_lines
from ..versions import used_versions
from .plan import Plan, Row

Objects = dict[str, dict[str, float]]  # metrics by object


class _Report(msgspec.Struct):
    objects: list[dict[str, Any]]


class _Line(msgspec.Struct):
    event: str
    seconds: float | None = None


def _seeds(out: Path, row: Row) -> dict[str, Objects]:
    """Return the metrics of novel views by seed and object, of the evaluations that are there."""
    found = {}
    for path in sorted((out / "rows" / row.name).glob("seed-*/views/report.json")):
        records = read_document(path, _Report).objects
        found[path.parents[1].name.removeprefix("seed-")] = {
            str(record["name"]): {
                key: record[key] for key in METRICS if record.get(key) is not None
            }
            for record in records
            if record.get("status") == "ok"
        }
    return found


def _over_seeds(seeds: dict[str, Objects]) -> Objects:
    """Average over seeds the metrics that all seeds have."""
    first, *_ = parts = [*seeds.values()] or [{}]
    names = [name for name in first if all(name in part for part in parts)]
    return {
        name: {
            key: sum(part[name][key] for part in parts) / len(parts)
            for key in first[name]
            if all(key in part[name] for part in parts)
        }
        for name in names
    }


def make_table(plan: Plan, out: Path) -> dict[str, Any]:
    """Make the content of ``table.json``.

    Args:
        plan: the plan.
        out: folder of the ablation.

    Returns:
        ``plan``, ``versions`` and ``rows``: each with ``seeds``, ``objects``, ``step_seconds`` (a
        median), and by metric the mean over objects of the means over seeds, its bootstrap interval
        over objects, the seeds' standard deviation, and the paired difference to the reference row.
    """
    results = {row.name: _seeds(out, row) for row in plan.rows}
    rows = [
        _row(out, row, results[row.name], results.get(row.compare_with or plan.compare_with or ""))
        for row in plan.rows
    ]
    return {"plan": to_builtins(plan), "versions": used_versions(), "rows": rows}


def _row(
    out: Path, row: Row, seeds: dict[str, Objects], others: dict[str, Objects] | None
) -> dict[str, Any]:
    from gamba_warp.eval.averages import summary_of

    values, figures = _over_seeds(seeds), {}
    common = seeds.keys() & (others or {}).keys()  # the same seeds see the same samples
    ours, theirs = (
        _over_seeds({seed: part for seed, part in (some or {}).items() if seed in common})
        for some in (seeds, others)
    )
    for key in METRICS:
        known = [record[key] for record in values.values() if key in record]
        if not known:
            continue
        means = [
            statistics.fmean(record[key] for record in part.values() if key in record)
            for part in seeds.values()
        ]
        both = [n for n in ours if key in ours[n] and key in theirs.get(n, {})]
        pairs = [ours[n][key] - theirs[n][key] for n in both]
        figures[key] = {
            **summary_of(known),
            "spread": statistics.stdev(means) if len(means) > 1 else None,
            "difference": summary_of(pairs) if pairs and others is not seeds else None,
        }
    times = [
        line.seconds
        for path in (out / "rows" / row.name).glob("seed-*/run/log.jsonl")
        for line in read_lines(path, _Line)
        if line.event == "train" and line.seconds is not None
    ]
    return {
        "name": row.name,
        "title": row.label,
        "seeds": [*seeds],
        "objects": len(values),
        "figures": figures,
        "step_seconds": statistics.median(times) if times else None,
        "paper": dict(row.paper),
        "note": row.note,
    }


def markdown_table(table: dict[str, Any]) -> str:
    """Return the text of ``table.md``."""
    from ..kernels.runtime.tables import cell, markdown

    rows, plan = table["rows"], table["plan"]
    shown = [key for key in METRICS if any(key in row["figures"] for row in rows)]
    heads = [METRICS[key].head for key in shown]

    def line(row: dict[str, Any], part: str) -> list[str]:
        found = []
        for key in shown:
            figure = row["figures"].get(key, {})
            figure = figure if part == "mean" else figure.get("difference") or {}
            digits = METRICS[key].digits
            found.append(
                cell(figure["mean"], figure["interval"], digits, part != "mean") if figure else "-"
            )
        return found

    def seconds(row: dict[str, Any]) -> str:
        return "-" if row["step_seconds"] is None else f"{row['step_seconds']:.3g}"

    counts = [[row["title"], ", ".join(row["seeds"]) or "-", str(row["objects"])] for row in rows]
    main = [[*c, *line(row, "mean"), seconds(row)] for c, row in zip(counts, rows)]
    parts = [f"# {plan['title']}", plan["note"]]
    parts += [markdown(["", "seeds", "objects", *heads, "s a step"], main, True)]
    parts += [
        "New views: means over the seeds for each object, then over objects, with 95 % bootstrap "
        "intervals over objects."
    ]
    spread = [
        [row["title"], *(f"{row['figures'][k]['spread']:.2g}" for k in shown)]
        for row in rows
        if row["figures"] and all(row["figures"][k]["spread"] is not None for k in shown)
    ]
    changes = [[row["title"], *line(row, "difference")] for row in rows]
    published = [row for row in rows if row["paper"]]
    for text, head, lines in (
        ("Differences to the reference row, object by object:", heads, changes),
        ("Standard deviation of the seeds' means:", heads, spread),
        (
            "The paper's own figures, of other data and sizes: compare the order of the rows.",
            heads,
            [[row["title"], *(str(row["paper"].get(k, "-")) for k in shown)] for row in published],
        ),
    ):
        if any(word != "-" for each in lines for word in each[1:]):
            parts += [text, markdown(["", *head], lines, True)]
    parts += [f"{row['title']}: {row['note']}" for row in rows if row["note"]]
    return "\n\n".join(filter(None, parts)) + "\n"
