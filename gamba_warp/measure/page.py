"""Page of benchmarks with charts: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..kernels.bench.core.report import EXPLANATION, More, nothing_more, parts
from ..pages.charts import Axis, Point, Series, chart, pareto
from ..pages.page import Section, page_text

_AXES = {
    "L": "tokens L",
    "B": "sequences B",
    "N": "N",
    "D": "channels D",
    "threads": "threads",
    "side": "side of the picture, pixels",
    "views": "views",
    "spacing": "tokens between kept states",
}


def charts_of(case: str, records: Sequence[dict]) -> list[str]:
    """Draw the case's charts, by its axis; none without an axis or figures."""
    axis: str | None = records[0]["axis"]
    done = [r for r in records if r["status"] == "ok"]
    if axis is None or not done:
        return []
    if axis == "error":
        directions = dict.fromkeys(r["direction"] for r in done)
        return [_error_chart([r for r in done if r["direction"] == d], d) for d in directions]
    if axis == "skipped":
        return [_skip_chart(done)]
    return [_line_chart(case, done, axis)]


def _line_chart(case: str, records: Sequence[dict], axis: str) -> str:
    """Draw the time against a parameter, with a line for each series or direction."""
    lines: dict[str, list[Point]] = {}
    for r in records:
        x, y = r["parameters"].get(axis), r["ms_p50"]
        if y and type(x) in (int, float) and x > 0:
            name = r["parameters"].get("series") or r["direction"]
            lines.setdefault(name, []).append(Point(x, y))
    series = [
        Series(name, sorted(points, key=lambda p: p.x), "straight")
        for name, points in lines.items()
    ]
    ticks = sorted({point.x for points in lines.values() for point in points})
    axis_label = case if axis == "N" else _AXES.get(axis, axis)
    return chart(series, Axis(axis_label, values=ticks), Axis("milliseconds"))


def _error_chart(records: Sequence[dict], direction: str) -> str:
    """Draw time against error, both better if less, with the Pareto front."""
    errors = [r["rel_rms_error"] for r in records if r["rel_rms_error"]]
    bottom = min(errors, default=0.0) / 3  # position of an error of 0, which is labelled
    points = []
    for r in records:
        point = _marked(r, r["rel_rms_error"] or 0.0)
        if r["rel_rms_error"] == 0:
            point = replace(point, y=bottom, label=f"{point.label} (error 0)")
        points.append(point)
    front = pareto([p for p in points if p.y > 0])
    series = [Series(direction, points), Series("Pareto front", front, "steps")]
    return chart(series, Axis("milliseconds"), Axis("relative rms error"))


def _marked(record: dict, y: float) -> Point:
    """Return a record's point at a height, marked as a peer or a default."""
    mark = "peer" if record["is_peer"] else "default" if record["is_default"] else ""
    return Point(record["ms_p50"], y, record["variant"], mark)


def _skip_chart(records: Sequence[dict]) -> str:
    """Draw work skipped against time saved, as shares of the default of the same direction."""
    series = []
    for direction in dict.fromkeys(r["direction"] for r in records):
        found = [r for r in records if r["direction"] == direction]
        base = next((r["ms_p50"] for r in found if r["is_default"]), None)
        series.append(Series(direction, [
            Point(100 * r["work"]["skipped"], 100 * (1 - r["ms_p50"] / base), r["variant"])
            for r in found if base and "skipped" in r["work"]
        ]))  # fmt: skip
    return chart(series, Axis("work skipped, %", False), Axis("time saved, %", False))


def page(documents: Sequence[dict], more: More = nothing_more) -> str:
    """Return a self-contained HTML page with the tables and charts."""
    sections = []
    for part in parts(documents, more):
        case = part.title.partition(": ")[2]
        drawn = [svg for svg in charts_of(case, part.records) if svg] if part.records else []
        (header, rows), *others = part.tables or [((), ())]
        text = "\n\n".join(part.texts)
        sections.append(Section(part.title, text, charts=drawn, header=header, table=rows))
        sections += [Section("", header=head, table=rows) for head, rows in others]
    text = f"{EXPLANATION}\n\nCircle: ours; ring: the default; square: a peer."
    return page_text("Benchmarks", text, sections)
