"""Outputs of an ablation: ``table.md``, and the page with pictures."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import image_metrics
from ..errors import UserError
from ..files import write_json, write_text
from ..kernels.runtime.tables import cell, markdown
from ..pages.charts import Axis, Point, Series, chart
from ..pages.page import Section, demo_page
from ..pages.sheet import tiles
from .figures import RowResult, collect, empty_psnr
from .jobs import STRIPS, Settings
from .series import DEFINITION, SHARES
from .table import make_table

_LABELS = {key: metric.head for key, metric in image_metrics.METRICS.items()}
_LABELS |= {"chamfer": "Chamfer", "iou": "Volume IoU"}
_GROUNDS = {key: metric.head for key, metric in image_metrics.on_grounds().items()}
_DIGITS = {key: metric.digits for key, metric in image_metrics.all_figures().items()}
_DIGITS |= {"chamfer": 4, "iou": 3}
_MAX_ROWS = 24  # of one picture
Lines = list[list[str]]  # cells by row, the head first


def write_results(settings: Settings) -> bool:
    """Write the table and the page from the results of all rows so far.

    Returns:
        True if a row of the table has failed.

    Raises:
        UserError: a report is damaged, or a file cannot be written.
    """
    results = collect(settings)
    empty: dict[str, dict[str, float]] = {}
    for name in {result.row.series for result in results} - {None}:
        members = [r for r in results if r.row.series == name and r.seeds]
        if len(members) > 1:
            largest = max(members, key=lambda result: result.gaussians)
            first = largest.first
            empty[largest.row.name] = empty_psnr(settings.data, first.views, first.size)
    table = make_table(settings, results, empty)
    write_json(settings.out / "table.json", table)
    write_text(settings.out / "table.md", _markdown_page(table))
    first, *others = [
        Section(title, header=header, table=rows)
        for title, (header, *rows) in _tables(table).items()
    ]
    first.text = _about(table)
    sections = [first, *others, *_needed(table["series"])]
    sections.append(Section("Notes", table=[[text] for text in _remarks(table)]))
    sections += _pictures(results)
    page = settings.out / "index.html"
    demo_page(page, sections, title=table["title"], text=table["note"])
    return any(result.failed for result in results)


def _markdown_page(table: dict[str, Any]) -> str:
    parts = [f"# {table['title']}", table["note"], _about(table)]
    for title, (header, *rows) in _tables(table).items():
        parts += ["" if title == "Table" else f"## {title}", markdown(header, rows, aligned=True)]
    if table["series"]:
        parts += ["## How many Gaussians are needed", DEFINITION]
        parts += [sentence for s in table["series"].values() for sentence in _sentences(s)]
    return "\n\n".join(filter(None, [*parts, *_remarks(table)])) + "\n"


def _about(table: dict[str, Any]) -> str:
    """Describe the numbers of the table."""
    evaluation, (budget, value) = table["evaluation"], *table["budget"].items()
    size = f"at {evaluation['size']} pixels" if evaluation["size"] else "at their own size"
    share = 100 * table["bootstrap"]["level"]
    order = "the same samples" if budget == "steps" else "samples in the same order"
    text = (
        f"Every row has {value:g} {budget} of training, on {order} of {table['data']}. "
        f"Means over seeds and objects with {share:g} % bootstrap intervals over objects: the "
        f"novel ones of {evaluation['views']} views, {size}, of {_count(table)} of the split "
        f"{evaluation['split']}. An interval covers the choice of objects, and the spread between "
        "seeds the randomness of training."
    )
    if any(row["kind"] == "fit" for row in table["rows"]):
        text += (
            " Fits are compared with their held-out views, and their step is a step of the fit of "
            "one object."
        )
    return text


def _count(table: dict[str, Any]) -> str:
    """Format the number of evaluated objects, and of those requested if it differs."""
    requested = table["evaluation"]["objects"]
    rows = [row for row in table["rows"] if row["figures"]]
    counts = sorted({row["objects"] for row in rows}) or [0]
    number = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    fewer = any(row["objects"] < requested for row in rows if row["kind"] == "train")
    return f"{number} objects" + (f" ({requested} were requested)" if fewer else "")


def _cells(figures: Mapping[str, Any], keys: Iterable[str], signed: bool = False) -> list[str]:
    found = ((key, figures.get(key)) for key in keys)
    return [f"{cell(f['mean'], f['interval'], _DIGITS[k], signed)}" if f else "-" for k, f in found]


def _tables(table: dict[str, Any]) -> dict[str, Lines]:
    """Return tables by title: main, backgrounds, differences, seeds, numbers of Gaussians."""
    rows, head = table["rows"], ["", *_LABELS.values()]
    main: Lines = [[*head, "seconds a step", "memory", "parameters", "paper"]]
    for row in rows:
        count = len(row["seeds"])
        label = row["title"] + {0: "", 1: " (1 seed)", 2: ""}.get(count, f" ({count} seeds)")
        figures = _cells(row["figures"], _LABELS)
        if not row["figures"]:
            figures[0] = row["status"]
        step, memory, parameters = (row[k] for k in ("step_seconds", "peak_memory", "parameters"))
        costs = [
            "-" if step is None else f"{step:.3g}",
            "-" if memory is None else f"{memory / 2**20:,.0f} MB",
            "-" if parameters is None else f"{parameters:,}",
        ]
        paper = ", ".join(f"{_LABELS[name]} {value:g}" for name, value in row["paper"].items())
        main.append([label, *figures, *costs, paper or "-"])
    found = {"Table": main}
    if any(key in row["figures"] for row in rows for key in _GROUNDS):
        lines = [[row["title"], *_cells(row["figures"], _GROUNDS)] for row in rows]
        title = "On black and on grey, both sides composited by their alpha"
        found[title] = [["", *_GROUNDS.values()], *lines]
    titles = {row["name"]: row["title"] for row in rows}
    lines = [
        [f"{row['title']} - {titles[other['to']]}", *_cells(other["figures"], _LABELS, True)]
        for row in rows
        if (other := row["difference"])
    ]
    if lines:
        found["Differences, object by object"] = [head, *lines]
    lines = []
    for row in rows:
        if len(row["seeds"]) > 1 and row["figures"]:
            spreads = ((m, (row["figures"].get(m) or {}).get("spread")) for m in _LABELS)
            texts = ("-" if s is None else f"{s:.{_DIGITS[m] + 1}f}" for m, s in spreads)
            lines.append([row["title"], *texts])
    if lines:
        found["Spread between seeds (standard deviation of their means)"] = [head, *lines]
    for name, series in table["series"].items():
        shares = [f"objects with {key} %" for key in series["reached"]]
        found[f"Series {name}"] = lines = [["Gaussians", "PSNR [dB]", "quality", *shares]]
        for k, number in enumerate(series["numbers"]):
            quality = "-" if series["quality"] is None else f"{100 * series['quality'][k]:.1f} %"
            reached = [values[k] for values in series["reached"].values()]
            cells = ["-" if value is None else f"{100 * value:.0f} %" for value in reached]
            lines.append([f"{number:,}", f"{series['psnr'][k]:.2f}", quality, *cells])
    return found


def _sentences(series: dict[str, Any]) -> list[str]:
    """Describe a series, one sentence per share."""
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


def _remarks(table: dict[str, Any]) -> list[str]:
    """Return sentences below the table: notes of the rows, failures, missing results."""
    found = [f"{row['title']}: {row['note']}" for row in table["rows"] if row["note"]]
    for row in table["rows"]:
        title = row["title"]
        found += [f"failed: {title}, seed {s}: {why}" for s, why in row["failed"].items()]
        for seed, names in row["missing"].items():
            found.append(
                f"{title}, seed {seed}: {len(names)} objects are missing; first {names[0]}"
            )
        if row["absent"]:
            seeds = ", ".join(map(str, row["absent"]))
            found.append(f"{title}: not run or not finished: seed {seeds}.")
    single = [row["title"] for row in table["rows"] if len(row["seeds"]) == 1]
    if single:
        found.append(f"A single seed, so the spread is unknown: {', '.join(single)}.")
    cost = "Memory is the peak of the training process, libraries included."
    threads = sorted({(t, j) for row in table["rows"] for t in row["threads"] for j in row["jobs"]})
    if threads:
        shown = " or ".join(f"{j} at once with {t} CPU threads each" for t, j in threads)
        cost += f" Rows ran {shown}, which their times reflect."
    if any(row["peak_memory_of"] == "GPU" for row in table["rows"]):
        cost = "Memory is torch's peak on the GPU."
    return [*found, cost]


def _needed(series: Mapping[str, Any]) -> list[Section]:
    """Return sections of the numbers of Gaussians needed, with curves of quality over N."""
    found = []
    for name, part in series.items():
        text = " ".join([DEFINITION, *_sentences(part)])
        points = [Point(n, 100 * q) for n, q in zip(part["numbers"], part["quality"] or ())]
        axes = Axis("Gaussians", values=part["numbers"]), Axis("quality [%]", False)
        drawn = chart([Series(name, points, "straight")], *axes)
        found.append(Section(f"How many Gaussians are needed: {name}", text, charts=[drawn]))
    return found


def _pictures(results: list[RowResult]) -> list[Section]:
    """Return pictures of the same few objects from every row, below the true views.

    A model's picture has one row per view, input | prediction | truth; a fit's has truth | fitted.
    """
    found = []
    for kind, folder, columns, truth, caption in (
        ("train", "views", 3, 2, "the first is the input view"),
        ("fit", "fit", 2, 0, "held-out views"),
    ):
        rows = [r for r in results if r.row.kind == kind and r.seeds][:_MAX_ROWS]
        strips = {r.row.label: r.first.task.folder / folder / "strips" for r in rows}
        shared = [{path.name for path in strip.glob("*.png")} for strip in strips.values()]
        for name in sorted(set.intersection(*shared))[:STRIPS] if shared else ():
            views: dict[str, np.ndarray] = {}
            for label, strip in strips.items():
                with contextlib.suppress(UserError, ValueError):
                    shown = tiles(strip / name, columns)
                    views.setdefault("Truth", shown[truth])
                    views[label] = shown[1]
            if views:
                title = f"{Path(name).stem}, {'models' if kind == 'train' else 'fits'}"
                found.append(Section(title, f"Views: {caption}.", views=views))
    return found
