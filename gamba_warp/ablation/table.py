"""The table of an ablation: means over objects and seeds, paired differences, what is needed."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from .. import image_metrics
from .figures import SHAPE_METRICS, VIEW_METRICS, RowResult
from .jobs import Settings
from .plan import Plan
from .series import DEFINITION, SHARES, series_of

METRICS = (*VIEW_METRICS, *SHAPE_METRICS)  # of which LABELS are in the table itself
LABELS = {key: metric.head for key, metric in image_metrics.METRICS.items()}
LABELS |= {"chamfer": "Chamfer", "iou": "Volume IoU"}
_GROUNDS = {key: metric.head for key, metric in image_metrics.on_grounds().items()}
_DIGITS = {key: metric.digits for key, metric in image_metrics.all_figures().items()}
_DIGITS |= {"chamfer": 4, "iou": 3}
Empty = Mapping[str, Mapping[str, float]]  # by row, PSNR of an empty picture by object


def make_table(
    plan: Plan, settings: Settings, results: list[RowResult], empty: Empty
) -> dict[str, Any]:
    """Makes what ``table.json`` holds.

    Args:
        plan: the plan.
        settings: what is the same for every row.
        results: of its rows.
        empty: PSNR of an empty picture, for the rows of series.

    Returns:
        ``rows``, each with its figures, ``series``, and what the numbers mean.
    """
    from gamba_warp.eval.averages import LEVEL, RESAMPLES

    from ..versions import used_versions

    known = {result.row.name: result for result in results}
    others = {r.row.name: known.get(r.row.compare_with or plan.compare_with or "") for r in results}
    name, value = settings.budget
    return {
        "plan": plan.name,
        "title": plan.title,
        "note": plan.note,
        "data": settings.data.name,
        "budget": {name: value},
        "compare_with": plan.compare_with,
        "evaluation": {
            "split": settings.evaluation.split,
            "objects": settings.evaluation.objects,
            "views": settings.evaluation.views,
            "size": settings.evaluation.size,
            "shapes": settings.meshes is not None,
            "geometry_objects": settings.evaluation.geometry_objects,
        },
        "bootstrap": {"level": LEVEL, "resamples": RESAMPLES, "seed": 0, "method": "percentile"},
        "rows": [_row(result, others[result.row.name]) for result in results],
        "series": _series(results, empty),
        "series_definition": DEFINITION,
        "versions": used_versions(),
    }


def _row(result: RowResult, reference: RowResult | None) -> dict[str, Any]:
    row = result.row
    facts = [seed.facts for seed in result.seeds.values()]
    first = "fit" if row.kind == "fit" else "train"
    ended = [seed.record.ended.get(first) for seed in result.seeds.values()]
    ended = [part for part in ended if part is not None]
    cuda = [f.device_memory for f in facts if f.device.startswith("cuda")]
    host = [part.peak_memory for part in ended if part.peak_memory is not None]
    on_gpu = any(f.device.startswith("cuda") for f in facts)
    return {
        "name": row.name,
        "title": row.label,
        "kind": row.kind,
        "status": _status(result),
        "seeds": sorted(result.seeds),
        "failed": {str(seed): reason for seed, reason in result.failed.items()},
        "absent": result.absent,
        "gaussians": result.gaussians,
        "figures": _figures(result),
        "difference": _difference(result, reference),
        "step_seconds": _median([f.step_seconds for f in facts]),
        "steps": _median([f.steps for f in facts]) if row.kind == "train" else None,
        "seconds": _median([part.seconds for part in ended]),
        "peak_memory": max(filter(None, cuda), default=None) if on_gpu else max(host, default=None),
        "peak_memory_of": "GPU" if on_gpu else "process",
        "parameters": next((f.parameters for f in facts if f.parameters is not None), None),
        "threads": sorted({part.threads for part in ended}),
        "jobs": sorted({part.jobs for part in ended}),
        "missing": {str(n): s.missing for n, s in result.seeds.items() if s.missing},
        "series": row.series,
        "paper": dict(row.paper),
        "note": row.note,
    }


def _status(result: RowResult) -> str:
    if result.failed:
        return "failed"
    if result.seeds:
        return "incomplete" if result.absent else "ok"
    return "not run"


def _median(values: list[Any]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _figures(result: RowResult) -> dict[str, Any]:
    """By metric: mean and interval over objects, the mean of each seed, and their spread."""
    from gamba_warp.eval.averages import summary_of

    values, found = result.values(), {}
    for metric in METRICS:
        over = [record[metric] for record in values.values() if metric in record]
        if not over:
            continue
        summary = summary_of(over)
        by_seed = {}
        for number, seed in result.seeds.items():
            own = [seed.objects[n][metric] for n, r in values.items() if metric in r]
            by_seed[str(number)] = sum(own) / len(own)
        found[metric] = {
            "mean": summary["mean"],
            "interval": summary["interval"],
            "objects": len(over),
            "by_seed": by_seed,
            "spread": statistics.stdev(by_seed.values()) if len(by_seed) > 1 else None,
        }
    return found


def _difference(result: RowResult, reference: RowResult | None) -> dict[str, Any] | None:
    """By metric: the row minus the one compared with, object by object, each a mean over seeds."""
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


def page(table: dict[str, Any]) -> str:
    """The text of ``table.md``."""
    from gamba_warp.eval.tables import markdown

    parts = [f"# {table['title']}", *([table["note"]] if table["note"] else [])]
    parts += [about(table)]
    parts.append(markdown(main_lines(table)))
    for title, lines in extra_tables(table):
        parts += [f"## {title}", markdown(lines)]
    if table["series"]:
        parts += ["## How many Gaussians are needed", DEFINITION]
        parts += [sentence for s in table["series"].values() for sentence in needed_sentences(s)]
    parts += remarks(table)
    return "\n\n".join(parts) + "\n"


def about(table: dict[str, Any]) -> str:
    """What the numbers of the table are."""
    what, (budget, value) = table["evaluation"], *table["budget"].items()
    size = f"at {what['size']} pixels" if what["size"] else "at their own size"
    share = 100 * table["bootstrap"]["level"]
    order = "the same samples" if budget == "steps" else "samples in the same order"
    text = (
        f"Every row has {value:g} {budget} of training, on {order} of {table['data']}. "
        f"Means over seeds and objects with {share:g} % bootstrap intervals over objects: the "
        f"novel ones of {what['views']} views, {size}, of {what['objects']} objects of the part "
        f"{what['split']}. An interval tells how far a mean depends on the choice of objects, and "
        "the spread between seeds how far it depends on chance in training."
    )
    if any(row["kind"] == "fit" for row in table["rows"]):
        text += (
            " Fits are compared with the views that were held out from them, and a step of theirs "
            "is one of the fit of one object."
        )
    return text


def main_lines(table: dict[str, Any]) -> list[list[str]]:
    """The table itself, the head first."""
    lines = [["", *LABELS.values(), "seconds a step", "memory", "parameters", "paper"]]
    for row in table["rows"]:
        cells = [_mean_cell(row["figures"].get(m), m) for m in LABELS]
        if not row["figures"]:
            cells[0] = row["status"]
        lines.append([_label(row), *cells, *_cost_cells(row), _paper_cell(row["paper"])])
    return lines


def _label(row: dict[str, Any]) -> str:
    seeds = len(row["seeds"])
    return row["title"] + {0: "", 1: " (1 seed)", 2: ""}.get(seeds, f" ({seeds} seeds)")


def _mean_cell(figure: dict[str, Any] | None, metric: str, signed: bool = False) -> str:
    from gamba_warp.eval.tables import cell

    if figure is None:
        return "-"
    return cell(figure["mean"], figure["interval"], _DIGITS[metric], signed)


def _cost_cells(row: dict[str, Any]) -> list[str]:
    step, memory, parameters = (row[k] for k in ("step_seconds", "peak_memory", "parameters"))
    return [
        "-" if step is None else f"{step:.3g}",
        "-" if memory is None else f"{memory / 2**20:,.0f} MB",
        "-" if parameters is None else f"{parameters:,}",
    ]


def _paper_cell(paper: dict[str, float]) -> str:
    return ", ".join(f"{LABELS[name]} {value:g}" for name, value in paper.items()) or "-"


def extra_tables(table: dict[str, Any]) -> list[tuple[str, list[list[str]]]]:
    """Titles and lines of the other tables: grounds, differences, seeds, numbers of Gaussians."""
    found = []
    if any(key in row["figures"] for row in table["rows"] for key in _GROUNDS):
        lines = [["", *_GROUNDS.values()]]
        for row in table["rows"]:
            cells = [_mean_cell(row["figures"].get(key), key) for key in _GROUNDS]
            lines.append([row["title"], *cells])
        found.append(("On black and on grey, both sides composited by their alpha", lines))
    head, titles = ["", *LABELS.values()], {r["name"]: r["title"] for r in table["rows"]}
    differing = [row for row in table["rows"] if row["difference"]]
    if differing:
        lines = [head]
        for row in differing:
            figures = row["difference"]["figures"]
            cells = [_mean_cell(figures.get(m), m, True) for m in LABELS]
            lines.append([f"{row['title']} - {titles[row['difference']['to']]}", *cells])
        found.append(("Differences, object by object", lines))
    several = [row for row in table["rows"] if len(row["seeds"]) > 1 and row["figures"]]
    if several:
        lines = [head]
        for row in several:
            cells = []
            for metric in LABELS:
                figure = row["figures"].get(metric)
                spread = None if figure is None else figure["spread"]
                cells.append("-" if spread is None else f"{spread:.{_DIGITS[metric] + 1}f}")
            lines.append([row["title"], *cells])
        found.append(("Spread between seeds (standard deviation of their means)", lines))
    for name, series in table["series"].items():
        found.append((f"Series {name}", _series_lines(series)))
    return found


def _series_lines(series: dict[str, Any]) -> list[list[str]]:
    shares = [f"objects with {key} %" for key in series["reached"]]
    lines = [["Gaussians", "PSNR [dB]", "quality", *shares]]
    for k, number in enumerate(series["numbers"]):
        quality = "-" if series["quality"] is None else f"{100 * series['quality'][k]:.1f} %"
        own = [values[k] for values in series["reached"].values()]
        cells = ["-" if value is None else f"{100 * value:.0f} %" for value in own]
        lines.append([f"{number:,}", f"{series['psnr'][k]:.2f}", quality, *cells])
    return lines


def needed_sentences(series: dict[str, Any]) -> list[str]:
    """What a series says, a sentence for each share."""
    found = []
    count, rows = series["objects"], "fits" if series["kind"] == "fit" else "models"
    for share in (f"{100 * share:g}" for share in SHARES):
        need = series["needed"][share]
        if need["number"] is None:
            found.append(f"The {rows} do not gain over an empty picture, so no share is stated.")
            break
        bound = "at most " if need["at_most"] else ""
        ends = need["interval"]
        shown = "" if ends is None else f" [{ends[0]:,.0f}, {ends[1]:,.0f}]"
        found.append(
            f"{share} % of the quality of {series['numbers'][-1]:,} Gaussians needs "
            f"{bound}{need['number']:,.0f}{shown} of them ({count} objects, {rows})."
        )
    if series["no_gain"]:
        found.append(f"{series['no_gain']} objects gain nothing, and have no share of their own.")
    return found


def remarks(table: dict[str, Any]) -> list[str]:
    """Sentences below the table: notes of the rows, failures, what is not there."""
    found = [f"{row['title']}: {row['note']}" for row in table["rows"] if row["note"]]
    for row in table["rows"]:
        title = row["title"]
        found += [f"failed: {title}, seed {s}: {why}" for s, why in row["failed"].items()]
        for seed, names in row["missing"].items():
            found.append(f"{title}, seed {seed}: {len(names)} objects lack; first {names[0]}")
        if row["absent"]:
            seeds = ", ".join(map(str, row["absent"]))
            found.append(f"{title}: not run, or not to the end: seed {seeds}.")
    lonely = [row["title"] for row in table["rows"] if len(row["seeds"]) == 1]
    if lonely:
        found.append(f"One seed alone, so no spread is known: {', '.join(lonely)}.")
    cost = "Memory is the most that the process of the training held, the libraries in it included."
    threads = sorted({(t, j) for row in table["rows"] for t in row["threads"] for j in row["jobs"]})
    if threads:
        shown = " or ".join(f"{j} at once with {t} CPU threads each" for t, j in threads)
        cost += f" Rows ran {shown}, and their times are those."
    if any(row["peak_memory_of"] == "GPU" for row in table["rows"]):
        cost = "Memory is what torch held on the GPU at most."
    return [*found, cost]
