"""The page with charts: one HTML file that loads nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    "share": "share of the picture that the object covers, %",
}


def charts_of(case: str, records: Sequence[dict]) -> list[str]:
    """Draws the case's charts, by its axis; there are none without an axis or figures."""
    axis: str | None = records[0]["axis"]
    done = [r for r in records if r["status"] == "ok"]
    if axis is None or not done:
        return []
    if "," in axis:
        each = ([r | {"axis": one} for r in records] for one in axis.split(","))
        return [svg for part in each for svg in charts_of(case, part)]
    if axis == "error":
        directions = dict.fromkeys(r["direction"] for r in done)
        return [_error_chart([r for r in done if r["direction"] == d], d) for d in directions]
    if axis == "memory":
        return [_memory_chart(done)]
    if axis in ("skipped", "switched off"):
        return [_skip_chart(done, axis == "switched off")]
    return [line_chart(case, done, axis, "ms_p50", "milliseconds")]


def line_chart(
    case: str, records: Sequence[dict], axis: str, figure: str, label: str, scale: float = 1.0
) -> str:
    """Draws a figure, of the record or of its work, against a parameter.

    Args:
        case: its name.
        records: those that were measured.
        axis: name of the parameter.
        figure: key of the record or of its work.
        label: of the figure, with its unit.
        scale: factor of the figure.
    """
    lines: dict[str, list[Point]] = {}
    for r in records:
        x, y = r["parameters"].get(axis), r.get(figure) or r["work"].get(figure)
        if y and type(x) in (int, float) and x > 0:
            name = r["parameters"].get("series") or r["direction"]
            lines.setdefault(name, []).append(Point(x, scale * y))
    series = [
        Series(name, sorted(points, key=lambda p: p.x), "straight")
        for name, points in lines.items()
    ]
    ticks = sorted({point.x for points in lines.values() for point in points})
    axis_label = case if axis == "N" else _AXES.get(axis, axis)
    return chart(series, Axis(axis_label, values=ticks), Axis(label))


def _error_chart(records: Sequence[dict], direction: str) -> str:
    """Draws time against error, both better if less; no variant beats those on the front."""
    errors = [r["rel_rms_error"] for r in records if r["rel_rms_error"]]
    bottom = min(errors, default=0.0) / 3  # an error of 0 is drawn here, and labelled
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
    mark = "peer" if record["is_peer"] else "default" if record["is_default"] else ""
    return Point(record["ms_p50"], y, record["variant"], mark)


def _memory_chart(records: Sequence[dict]) -> str:
    """Draws time against the memory that is kept for the gradient."""
    kept = [r for r in records if "saved_bytes" in r["work"]]
    points = [_marked(r, r["work"]["saved_bytes"] / 2**20) for r in kept]
    front = Series("Pareto front", pareto(points), "steps")
    series = [Series("forward+backward", points), front]
    return chart(series, Axis("milliseconds"), Axis("kept for the gradient, MiB"))


def _skip_chart(records: Sequence[dict], switched_off: bool) -> str:
    """Draws work skipped against time saved, as shares of the time without the skip.

    That is the time of the default of the same direction or, if the default skips and the variants
    do not (``switched_off``), the time of the variant.
    """
    series = []
    for direction in dict.fromkeys(r["direction"] for r in records):
        found = [r for r in records if r["direction"] == direction]
        base = next((r["ms_p50"] for r in found if r["is_default"]), None)
        points = []
        for r in found:
            if base and "skipped" in r["work"] and not (switched_off and r["is_default"]):
                less, all_of_it = (base, r["ms_p50"]) if switched_off else (r["ms_p50"], base)
                saved = 100 * (1 - less / all_of_it)
                name = r["variant"].removeprefix("without ") if switched_off else r["variant"]
                points.append(Point(100 * r["work"]["skipped"], saved, name))
        series.append(Series(direction, points))
    return chart(series, Axis("work skipped, %", False), Axis("time saved, %", False))


def page(
    documents: Sequence[dict],
    more: More = nothing_more,
    charts: Callable[[str, Sequence[dict]], list[str]] = charts_of,
) -> str:
    """Returns a self-contained HTML page with the tables and the charts."""
    sections = []
    for part in parts(documents, more):
        case = part.title.partition(": ")[2]
        drawn = [svg for svg in charts(case, part.records) if svg] if part.records else []
        (header, rows), *others = part.tables or [((), ())]
        text = "\n\n".join(part.texts)
        sections.append(Section(part.title, text, charts=drawn, header=header, table=rows))
        sections += [Section("", header=head, table=rows) for head, rows in others]
    text = f"{EXPLANATION}\n\nCircle: ours; ring: the default; square: a peer."
    return page_text("Benchmarks", text, sections)
