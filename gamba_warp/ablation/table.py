"""Table of an ablation: means over objects and seeds, and paired differences."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import msgspec

from gamba_warp.eval import tables
from gamba_warp.eval.averages import summary_of

from ..image_metrics import METRICS
from ..untrusted.documents import read_document, read_lines
from ..versions import used_versions
from .plan import Plan, Row


class _Report(msgspec.Struct):
    objects: list[dict[str, Any]]


class _Line(msgspec.Struct):
    event: str
    seconds: float | None = None


Seeds = dict[str, _Report]  # evaluations by seed


def _of_objects(report: _Report, key: str) -> dict[str, float]:
    """Return a metric of the novel views by object."""
    done = (record for record in report.objects if record.get("status") == "ok")
    return {str(r["name"]): r[key] for r in done if r.get(key) is not None}


def _over_seeds(seeds: Seeds, key: str) -> dict[str, float]:
    """Return means over the seeds by object, of the objects for which all have the metric."""
    first, *others = parts = [_of_objects(seeds[seed], key) for seed in seeds] or [{}]
    names = [name for name in first if all(name in part for part in others)]
    return {name: sum(part[name] for part in parts) / len(parts) for name in names}


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
    results: dict[str, Seeds] = {}
    for row in plan.rows:
        paths = sorted((out / "rows" / row.name).glob("seed-*/views/report.json"))
        names = [path.parents[1].name.removeprefix("seed-") for path in paths]
        results[row.name] = {n: read_document(p, _Report) for n, p in zip(names, paths)}
    rows = [_row(out, row, results, row.compare_with or plan.compare_with) for row in plan.rows]
    return {"plan": msgspec.to_builtins(plan), "versions": used_versions(), "rows": rows}


def _row(out: Path, row: Row, results: dict[str, Seeds], against: str | None) -> dict[str, Any]:
    seeds, others, figures = results[row.name], results.get(against or "", {}), {}
    common = [seed for seed in seeds if seed in others]  # the same seeds see the same samples
    for key in METRICS:
        if not (known := _over_seeds(seeds, key)):
            continue
        means = [statistics.fmean(_of_objects(report, key).values()) for report in seeds.values()]
        ours, theirs = (_over_seeds({s: of[s] for s in common}, key) for of in (seeds, others))
        pairs = [ours[name] - theirs[name] for name in ours if name in theirs]
        figures[key] = {
            **summary_of([*known.values()]),
            "spread": statistics.stdev(means) if len(means) > 1 else None,
            "difference": summary_of(pairs) if pairs and against != row.name else None,
        }
    times = [
        line.seconds
        for path in (out / "rows" / row.name).glob("seed-*/run/log.jsonl")
        for line in read_lines(path, _Line)
        if line.event == "train" and line.seconds is not None
    ]
    return {
        "name": row.name,
        "title": row.title or row.name,
        "seeds": [*seeds],
        "objects": len(_over_seeds(seeds, "psnr")),
        "figures": figures,
        "step_seconds": statistics.median(times) if times else None,
        "paper": dict(row.paper),
        "note": row.note,
    }


def markdown_table(table: dict[str, Any]) -> str:
    """Return the text of ``table.md``."""
    rows, plan = table["rows"], table["plan"]
    shown = [key for key in METRICS if any(key in row["figures"] for row in rows)]
    columns = tables.columns_of({key: METRICS[key] for key in shown})
    heads = [column.title for column in columns.values()]
    main, changes, spreads, papers = [], [], [["", *heads]], [["", *heads]]
    for row in rows:
        title, figures = row["title"], row["figures"]
        counts = ", ".join(row["seeds"]) or "-", str(row["objects"])
        main.append(tables.Row([title, *counts], figures))
        differences = {key: figure["difference"] for key, figure in figures.items()}
        changes.append(tables.Row([title], differences, signed=True))
        if figures and all(figures[key]["spread"] is not None for key in shown):
            spreads.append([title, *(f"{figures[key]['spread']:.2g}" for key in shown)])
        if row["paper"]:
            papers.append([title, *(str(row["paper"].get(key, "-")) for key in shown)])
    main, changes = (
        tables.figures(names, columns, lines)
        for names, lines in ((["", "seeds", "objects"], main), ([""], changes))
    )
    seconds = [row["step_seconds"] for row in rows]
    for line, text in zip(main, ["s a step", *("-" if s is None else f"{s:.3g}" for s in seconds)]):
        line.append(text)
    parts = [f"# {plan['title']}", plan["note"], tables.markdown(main)]
    parts += [
        "New views: means over the seeds for each object, then over objects, with 95 % bootstrap "
        "intervals over objects."
    ]
    for text, lines in (
        ("Differences to the reference row, object by object:", changes),
        ("Standard deviation of the seeds' means:", spreads),
        (
            "The paper's own figures, of other data and sizes: compare the order of the rows.",
            papers,
        ),
    ):
        if any(word != "-" for line in lines[1:] for word in line[1:]):
            parts += [text, tables.markdown(lines)]
    parts += [f"{row['title']}: {row['note']}" for row in rows if row["note"]]
    return "\n\n".join(filter(None, parts)) + "\n"
