"""Presentation of the studies' cases, in addition to the table of every case."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gamba_warp.errors import UserError
from gamba_warp.files import write_json, write_text
from gamba_warp.kernels.bench.core import report
from gamba_warp.measure import page as pages
from gamba_warp.measure import suites
from gamba_warp.measure.page import line_chart
from gamba_warp.pages.charts import Axis, Point, Series, chart, pareto

from . import targets
from .crossing import FIGURES, crossings, series_of
from .draw import bars, growth_picture
from .parts import parts_of, parts_table
from .slopes import ERRORS, GROWTH, error_charts, growth_charts, growth_lines, growth_table


def more(document: dict, records: Sequence[dict]) -> tuple[list[str], list[report.Table]]:
    """Crossings and excessive growth, in sentences; slopes and parts, in tables.

    For a whole document (without records), its targets.
    """
    if not records:
        return [], targets.rows(document)
    tables = [rows for rows in (growth_table(records), parts_table(records)) if rows]
    return [*(c.text() for c in crossings(records)), *growth_lines(records)], tables


def charts_of(case: str, records: Sequence[dict]) -> list[str]:
    """Charts of a study's axis; for any other, those of ``gamba bench``."""
    axis: str = records[0]["axis"] or ""
    if "," in axis:
        each = ([r | {"axis": one} for r in records] for one in axis.split(","))
        return [svg for part in each for svg in charts_of(case, part)]
    done = [r for r in records if r["status"] == "ok"]
    if axis == "parts":
        split = [(r["variant"], {n: sum(t) for n, t in parts_of(r).items()}) for r in done]
        few = (dict(split[i : i + 3]) for i in range(0, len(split), 3))  # a colour each
        return [bars(series, "milliseconds of a run") for series in few]
    if axis == "memory":
        return [_memory_chart(done)]
    if axis == "switched off":
        return [_switch_chart(done)]
    if axis == "share":
        return _share_charts(case, done)
    if axis == "lengths":
        return _length_charts(done)
    if axis == ERRORS:
        return error_charts(done)
    if axis.startswith(GROWTH):
        return growth_charts(done)
    return pages.charts_of(case, records)


def markdown(documents: Sequence[dict]) -> str:
    """The tables of studies as Markdown."""
    by = "`make study`, not by hand, of results of `gamba bench` and of the studies"
    return report.markdown(documents, more, by)


def page(documents: Sequence[dict]) -> str:
    """The tables and charts of studies as a self-contained HTML page."""
    return pages.page(documents, more, charts_of)


def summary(document: dict) -> str:
    """Lines on targets, crossings, excessive growth, and failures."""
    lines = [f"{c.op}: {c.text()}" for c in crossings(document["records"])]
    for op, cases in report.groups(document).items():
        lines += [f"{op}: {line}" for records in cases.values() for line in growth_lines(records)]
    stopped = (r for r in document["records"] if r["status"].startswith("stopped"))
    lines += [f"{r['op']}: {r['variant']}, {r['direction']}: {r['status']}" for r in stopped]
    return "\n".join([*targets.lines(document), *lines, suites.summary(document, None)])


def write_pages(documents: Sequence[dict], out: Path) -> list[Path]:
    """Write pages like ``suites.write_pages``; charts of growth for .svg, all records for .json.

    Raises:
        UserError: nothing grows in the documents, or they are not of one machine and level.
    """
    if out.suffix == ".json":
        write_json(out, join(documents))
        return [out]
    if out.suffix != ".svg":
        return suites.write_pages(documents, out, markdown, page)
    picture = growth_picture(documents)
    if not picture:
        raise UserError(f"--out {out}: these results have no cases of growth to draw")
    write_text(out, picture)
    return [out]


def join(documents: Sequence[dict]) -> dict:
    """Join the records of several runs in one document; for the same case the last run counts.

    Raises:
        UserError: they are not of one machine, level and set of versions.
    """
    first, *others = documents
    for other in others:
        for name, value in first["machine"].items():
            if name not in ("date", "peers") and other["machine"].get(name) != value:
                raise UserError(f"--render: {name} is {value} and {other['machine'].get(name)}")
        if other.get("settings") != first.get("settings"):
            raise UserError("--render: results of different levels cannot be joined")
    cases: dict[tuple[str, str], list[dict]] = {}
    for document in documents:
        for op, parts in report.groups(document).items():
            cases |= {(op, case): records for case, records in parts.items()}
    joined = first | {"records": [r for records in cases.values() for r in records]}
    joined["machine"] = first["machine"] | {"date": documents[-1]["machine"]["date"]}
    joined["interrupted"] = any(document["interrupted"] for document in documents)
    joined["targets"] = [t for document in documents for t in document.get("targets", [])]
    return with_crossings(joined)


def with_crossings(document: dict) -> dict:
    """Add the crossings to the document."""
    return document | {"crossings": [c._asdict() for c in crossings(document["records"])]}


def _memory_chart(records: Sequence[dict]) -> str:
    """Draw time against the memory that is kept for the gradient."""
    kept = [r for r in records if "saved_bytes" in r["work"]]
    points = [pages.marked(r, r["work"]["saved_bytes"] / 2**20) for r in kept]
    front = Series("Pareto front", pareto(points), "steps")
    series = [Series("forward+backward", points), front]
    return chart(series, Axis("milliseconds"), Axis("kept for the gradient, MiB"))


def _switch_chart(records: Sequence[dict]) -> str:
    """Draw the share skipped by a switch of the default against the time that it saves.

    Both are shares; the time is that of the variant without the switch.
    """
    series = []
    for direction in dict.fromkeys(r["direction"] for r in records):
        found = [r for r in records if r["direction"] == direction]
        base = next((r["ms_p50"] for r in found if r["is_default"]), None)
        points = []
        for r in found:
            if base and "skipped" in r["work"] and not r["is_default"]:
                saved = 100 * (1 - base / r["ms_p50"])
                name = r["variant"].removeprefix("without ")
                points.append(Point(100 * r["work"]["skipped"], saved, name))
        series.append(Series(direction, points))
    return chart(series, Axis("work skipped, %", False), Axis("time saved, %", False))


def _share_charts(case: str, records: Sequence[dict]) -> list[str]:
    """Draw time and memory of each direction, and tokens, against the share of the picture."""
    made = []
    for direction in dict.fromkeys(r["direction"] for r in records):
        found = [r for r in records if r["direction"] == direction]
        for figure, label, scale in (
            ("ms_p50", "milliseconds", 1.0),
            ("peak_bytes", "memory, MiB", 2.0**-20),
        ):
            name = f"{label}, {direction}"
            made.append(line_chart(case, found, "share", figure, name, scale))
    first = [r for r in records if r["direction"] == records[0]["direction"]]
    return [*made, line_chart(case, first, "share", "tokens", "tokens of a batch")]


def _length_charts(records: Sequence[dict]) -> list[str]:
    """Draw time and memory of each direction and dtype against L, and where two lines cross."""
    made = []
    for direction, dtype in dict.fromkeys((r["direction"], r["dtype"]) for r in records):
        found = [r for r in records if (r["direction"], r["dtype"]) == (direction, dtype)]
        for figure, (name, unit, _) in FIGURES.items():
            lines = series_of(found, figure)
            drawn = [
                Series(s, [Point(x, y) for x, y in sorted(line.items())], "straight")
                for s, line in lines.items()
            ]
            drawn += [
                Series("crossing", [Point(c.at, c.value, f"L* = {c.at:,.0f}", "default")])
                for c in crossings(found)
                if c.figure == name and c.at is not None and c.value is not None
            ]
            ticks = sorted({x for line in lines.values() for x in line})
            label = f"{unit}, {direction}, {dtype}"
            made.append(chart(drawn, Axis("tokens L", values=ticks), Axis(label)))
    return made
