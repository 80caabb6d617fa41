"""Table of an ablation: means over objects and seeds, paired differences, series."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from msgspec import to_builtins

from .figures import METRICS, RowResult
from .jobs import Settings
from .series import DEFINITION, series_of

Empty = Mapping[str, Mapping[str, float]]  # by row, PSNR of an empty picture by object


def make_table(settings: Settings, results: list[RowResult], empty: Empty) -> dict[str, Any]:
    """Make the content of ``table.json``.

    Args:
        settings: the plan, and the settings shared by all rows.
        results: of its rows.
        empty: PSNR of an empty picture, for the rows of series.

    Returns:
        ``rows`` with their figures, ``series``, and the settings of the evaluation.
    """
    from gamba_warp.eval.averages import LEVEL, RESAMPLES

    from ..versions import used_versions

    plan, (name, value) = settings.plan, settings.budget
    known = {result.row.name: result for result in results}
    others = [known.get(result.row.compare_with or plan.compare_with or "") for result in results]
    return {
        "plan": plan.name,
        "title": plan.title,
        "note": plan.note,
        "data": settings.data.name,
        "budget": {name: value},
        "compare_with": plan.compare_with,
        "evaluation": to_builtins(settings.evaluation) | {"shapes": settings.meshes is not None},
        "bootstrap": {"level": LEVEL, "resamples": RESAMPLES, "seed": 0, "method": "percentile"},
        "rows": [_row(*pair) for pair in zip(results, others)],
        "series": _series(results, empty),
        "series_definition": DEFINITION,
        "versions": used_versions(),
    }


def _row(result: RowResult, reference: RowResult | None) -> dict[str, Any]:
    row, seeds = result.row, result.seeds
    logs = [seed.log for seed in seeds.values()]
    records = [seed.task.record.ended for seed in seeds.values()]
    ended = [part for of in records if (part := of.get("fit" if row.kind == "fit" else "train"))]
    on_gpu = any(log.device.startswith("cuda") for log in logs)
    memory = [part.peak_memory for part in ended]
    if on_gpu:
        memory = [log.device_memory for log in logs]
    figures = _figures(result)
    status = "failed" if result.failed else "incomplete" if result.absent else "ok"
    return {
        "name": row.name,
        "title": row.label,
        "kind": row.kind,
        "status": status if seeds or result.failed else "not run",
        "seeds": sorted(seeds),
        "failed": {str(seed): reason for seed, reason in result.failed.items()},
        "absent": result.absent,
        "gaussians": result.gaussians,
        "objects": max((figure["objects"] for figure in figures.values()), default=0),
        "figures": figures,
        "difference": _difference(result, reference),
        "step_seconds": _median([seed.step_seconds for seed in seeds.values()]),
        "steps": _median([log.step for log in logs]) if row.kind == "train" else None,
        "seconds": _median([part.seconds for part in ended]),
        "peak_memory": max(filter(None, memory), default=None),
        "peak_memory_of": "GPU" if on_gpu else "process",
        "parameters": next((log.parameters for log in logs), None),
        "threads": sorted({part.threads for part in ended}),
        "jobs": sorted({part.jobs for part in ended}),
        "missing": {str(n): s.missing for n, s in seeds.items() if s.missing},
        "series": row.series,
        "paper": dict(row.paper),
        "note": row.note,
    }


def _median(values: list[Any]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _figures(result: RowResult) -> dict[str, Any]:
    """Return by metric the mean and interval over objects, the seeds' means and their spread."""
    from gamba_warp.eval.averages import summary_of

    values, found = result.values(), {}
    for metric in METRICS:
        names = [name for name, record in values.items() if metric in record]
        if not names:
            continue
        by_seed = {
            str(number): sum(seed.objects[name][metric] for name in names) / len(names)
            for number, seed in result.seeds.items()
        }
        summary = summary_of([values[name][metric] for name in names])
        found[metric] = {
            "mean": summary["mean"],
            "interval": summary["interval"],
            "objects": len(names),
            "by_seed": by_seed,
            "spread": statistics.stdev(by_seed.values()) if len(by_seed) > 1 else None,
        }
    return found


def _difference(result: RowResult, reference: RowResult | None) -> dict[str, Any] | None:
    """Return by metric the paired difference to the reference row, averaged over seeds."""
    from gamba_warp.eval.averages import summary_of

    if reference is None or reference is result or result.row.kind != "train":
        return None
    common = {*result.seeds} & {*reference.seeds}
    seeds = common or None  # the same seeds see the same samples
    ours, theirs = result.values(seeds), reference.values(seeds)
    found = {}
    for metric in METRICS:
        both = [n for n in ours if metric in ours[n] and metric in theirs.get(n, {})]
        if both:
            summary = summary_of([ours[n][metric] - theirs[n][metric] for n in both])
            found[metric] = {key: summary[key] for key in ("mean", "interval")}
            found[metric]["objects"] = len(both)
    named = {"to": reference.row.name, "seeds": sorted(common)}
    return {**named, "figures": found} if found else None


def _series(results: list[RowResult], empty: Empty) -> dict[str, Any]:
    found = {}
    for name in dict.fromkeys(r.row.series for r in results if r.row.series):
        members = [r for r in results if r.row.series == name and r.seeds]
        members.sort(key=lambda result: result.gaussians)
        rows = [
            {uid: record["psnr"] for uid, record in r.values().items() if "psnr" in record}
            for r in members
        ]
        base = empty.get(members[-1].row.name, {}) if members else {}
        made = series_of([r.gaussians for r in members], rows, base)
        if made is not None:
            absent = [r.row.name for r in results if r.row.series == name and not r.seeds]
            names = [r.row.name for r in members]
            found[name] = {"rows": names, "absent": absent, "kind": members[0].row.kind, **made}
    return found
