"""What an ablation writes: its table, and its page with curves and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..files import write_json, write_text
from ..images import load_rgba
from ..pages.charts import Axis, Point, Series, chart
from ..pages.curves import Chart, curves_section
from ..pages.page import Section, demo_page
from ..pages.run_log import read_run_log
from .figures import RowResult, SeedResult, collect, empty_psnr
from .jobs import STRIPS, Settings
from .plan import Plan
from .series import DEFINITION
from .table import about, extra_tables, main_lines, make_table, needed_sentences, page, remarks

_MOST_ROWS = 24  # of one picture
_CURVES = {
    "Loss of training": ("train.loss", True),
    "Held-out novel views, PSNR [dB]": ("val.psnr_novel", False),
}


def write_page(path: Path, table: dict[str, Any], results: list[RowResult]) -> None:
    """Writes the page.

    Args:
        path: the file.
        table: what ``make_table`` returns.
        results: what it was made of.

    Raises:
        UserError: the file cannot be written.
    """
    head, *lines = main_lines(table)
    sections = [Section("Table", about(table), header=head, table=lines)]
    for title, (first, *rest) in extra_tables(table):
        sections.append(Section(title, header=first, table=rest))
    sections += _needed(table["series"])
    notes = [[text] for text in remarks(table)]
    sections.append(Section("Notes", table=notes))
    sections += _curves(results, table["compare_with"])
    sections += _pictures(results)
    demo_page(path, sections, title=table["title"], text=table["note"])


def _needed(series: Mapping[str, Any]) -> list[Section]:
    """What is needed, in words and as a curve of quality over the number's logarithm."""
    found = []
    for name, part in series.items():
        text = " ".join([DEFINITION, *needed_sentences(part)])
        points = [Point(n, 100 * q) for n, q in zip(part["numbers"], part["quality"] or ())]
        axes = Axis("Gaussians", values=part["numbers"]), Axis("quality [%]", False)
        drawn = chart([Series(name, points, "straight")], *axes)
        found.append(Section(f"How many Gaussians are needed: {name}", text, charts=[drawn]))
    return found


def _first(result: RowResult) -> SeedResult | None:
    return next((result.seeds[seed] for seed in sorted(result.seeds)), None)


def _curves(results: list[RowResult], compare_with: str | None) -> list[Section]:
    """Curves of each row that was trained, beside those of the row compared with."""
    trained = {r.row.name: r for r in results if r.row.kind == "train" and r.seeds}
    records = {}
    for name, result in trained.items():
        seed = _first(result)
        try:
            records[name] = read_run_log(seed.folder / "run" / "log.jsonl") if seed else None
        except UserError:
            continue
    found = []
    other = records.get(compare_with or "")
    for name, record in records.items():
        if record is None:
            continue
        title, charts = trained[name].row.label, []
        for label, (key, logarithmic) in _CURVES.items():
            lines = {title: key}
            if other is not None and name != compare_with and key in other.series:
                record.series[f"{key} of another"] = other.series[key]
                lines[trained[compare_with or ""].row.label] = f"{key} of another"
            charts.append(Chart(label, lines, logarithmic))
        text = f"Seed {min(trained[name].seeds)}; the minutes are those of {title}."
        found.append(curves_section(f"Curves: {title}", text, record, charts))
    return found


def _pictures(results: list[RowResult]) -> list[Section]:
    """The same few objects as every row shows them, the true views above."""
    found = []
    for kind, folder in (("train", "views"), ("fit", "fit")):
        rows = [(r, _first(r)) for r in results if r.row.kind == kind]
        strips = {r.row.label: s.folder / folder / "strips" for r, s in rows if s is not None}
        strips = dict(list(strips.items())[:_MOST_ROWS])
        shared = [{p.stem for p in path.glob("*.png")} for path in strips.values()]
        names = sorted(set.intersection(*shared)) if shared else []
        for name in names[:STRIPS]:
            views = _panels({label: path / f"{name}.png" for label, path in strips.items()}, kind)
            if views:
                what = "the first is the input view" if kind == "train" else "held-out views"
                found.append(
                    Section(
                        f"{name}, {'models' if kind == 'train' else 'fits'}",
                        f"Views: {what}.",
                        views=views,
                    )
                )
    return found


def _panels(paths: Mapping[str, Path], kind: str) -> dict[str, np.ndarray]:
    """Rows of views by label, cut out of comparison pictures; the true ones first.

    A model's picture has a row a view, input | prediction | truth; a fit's has truth | fitted.
    """
    found: dict[str, np.ndarray] = {}
    columns, truth, shown = (3, 2, 1) if kind == "train" else (2, 0, 1)
    for label, path in paths.items():
        try:
            picture = load_rgba(path)[..., :3]
        except UserError:
            continue
        side = picture.shape[1] // columns
        count = picture.shape[0] // max(1, side)  # the views are square
        if not side or not count or picture.shape[0] % count:
            continue
        height = picture.shape[0] // count
        cells = picture[: count * height, : columns * side]
        cells = cells.reshape(count, height, columns, side, 3).transpose(2, 0, 1, 3, 4)
        found.setdefault("Truth", cells[truth])
        found[label] = cells[shown]
    return found


def write_results(plan: Plan, settings: Settings, out: Path) -> bool:
    """Writes the table and the page from what all rows of the plan have so far.

    Returns:
        Whether a row of the table has failed.

    Raises:
        UserError: a report is damaged, or a file cannot be written.
    """
    results = collect(plan, settings)
    empty: dict[str, dict[str, float]] = {}
    for name in {result.row.series for result in results} - {None}:
        members = [r for r in results if r.row.series == name and r.seeds]
        if len(members) > 1:
            largest = max(members, key=lambda result: result.gaussians)
            first = largest.seeds[min(largest.seeds)]
            empty[largest.row.name] = empty_psnr(settings.data, first)
    table = make_table(plan, settings, results, empty)
    write_json(out / "table.json", table)
    write_text(out / "table.md", page(table))
    write_page(out / "index.html", table, results)
    return any(result.failed for result in results)
