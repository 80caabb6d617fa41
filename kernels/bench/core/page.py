"""The page with charts: one HTML file that loads nothing else."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Sequence
from dataclasses import replace

from .charts import Axis, Point, Series, chart, pareto
from .report import (
    EXPLANATION,
    TARGET_HEADER,
    More,
    groups,
    machine_line,
    nothing_more,
    oracles,
    table,
    target_rows,
)

_NUMBER = re.compile(r"[0-9.,e-]+( to [0-9.,e-]+)?")
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
        return [svg for one in axis.split(",") for svg in charts_of(case, _on_axis(records, one))]
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
    series = []
    found = [(r, r.get(figure) or r["work"].get(figure)) for r in records]
    done = [r | {"figure": scale * value} for r, value in found if value]
    values = [(r, r["parameters"].get(axis)) for r in done]
    done = [r for r, value in values if type(value) in (int, float) and value > 0]
    for name in dict.fromkeys(map(_series_of, done)):
        points = [Point(r["parameters"][axis], r["figure"]) for r in done if _series_of(r) == name]
        series.append(Series(name, sorted(points, key=lambda p: p.x), "straight"))
    ticks = sorted({r["parameters"][axis] for r in done})
    axis_label = case if axis == "N" else _AXES.get(axis, axis)
    return chart(series, Axis(axis_label, values=ticks), Axis(label))


def _series_of(record: dict) -> str:
    """The name of the line that a record lies on."""
    return record["parameters"].get("series") or record["direction"]


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


def _on_axis(records: Sequence[dict], axis: str) -> list[dict]:
    return [r | {"axis": axis} for r in records]


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


_STYLE = """
:root {
  color-scheme: light dark;
  --back: #f5f5f2; --card: #ffffff; --text: #22252a; --soft: #686d76; --line: #dfe0dc;
  --s0: #1f6feb; --s1: #d1582b; --s2: #2c8a57; --s3: #8250c4; --good: #2c8a57; --bad: #c03a2b;
}
@media (prefers-color-scheme: dark) {
  :root {
    --back: #16181c; --card: #202329; --text: #e8e8e6; --soft: #9aa0aa; --line: #343840;
    --s0: #6ea8ff; --s1: #f08a5d; --s2: #5cc48d; --s3: #b896f0; --good: #5cc48d; --bad: #ff7b6b;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0 auto; padding: 2rem 1.25rem 3rem; max-width: 76rem;
  background: var(--back); color: var(--text); font: 15px/1.5 system-ui, sans-serif;
}
h1 { margin: 0; font-size: 1.6rem; font-weight: 650; }
h2 { margin: 0 0 .5rem; font-size: 1.15rem; font-weight: 600; }
p { margin: .35rem 0 0; max-width: 52rem; color: var(--soft); }
section {
  margin-top: 1.5rem; padding: 1.25rem; background: var(--card);
  border: 1px solid var(--line); border-radius: 12px;
}
.charts { display: grid; gap: 1rem; margin-top: 1rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 33rem), 1fr)); }
svg { display: block; width: 100%; max-width: 45rem; height: auto; }
svg text { fill: var(--text); font: 12px system-ui, sans-serif;
  paint-order: stroke; stroke: var(--card); stroke-width: 3px; stroke-linejoin: round; }
svg .axis { fill: var(--soft); font-weight: 600; }
svg .grid { stroke: var(--line); }
svg .line { fill: none; stroke-width: 2; stroke-linejoin: round; }
svg .steps { stroke-dasharray: 5 4; }
svg .guide { stroke-dasharray: 3 4; }
svg .ring { fill: none !important; stroke-width: 2; }
.scroll { overflow-x: auto; margin-top: 1rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { padding: .25rem 1.2rem .25rem 0; text-align: left; border-bottom: 1px solid var(--line); }
th { font-weight: 500; color: var(--soft); }
td.number { text-align: right; white-space: nowrap; }
.reached { color: var(--good); } .missed { color: var(--bad); }
"""


def page(
    documents: Sequence[dict],
    more: More = nothing_more,
    charts: Callable[[str, Sequence[dict]], list[str]] = charts_of,
) -> str:
    """Returns a self-contained HTML page with the tables and the charts."""
    body = [f"<header><h1>Benchmarks</h1><p>{EXPLANATION}</p>"]
    body.append("<p>Circle: ours; ring: the default; square: a peer.</p></header>")
    for document in documents:
        head = f"<h2>{html.escape(machine_line(document))}</h2>"
        if document["interrupted"]:
            head += "<p>The run was interrupted; what was measured is here.</p>"
        if targets := target_rows(document):
            head += _html_table(TARGET_HEADER, targets)
        body.append(f"<section>{head}</section>")
        for op, cases in groups(document).items():
            for case, records in cases.items():
                text = html.escape(f"{records[0]['text']} {oracles(records)}")
                figures = "".join(charts(case, records))
                figures = f'<div class="charts">{figures}</div>' if figures else ""
                said, tables = more(records)
                rows = "".join(_html_table(*rows) for rows in (table(records), *tables))
                lines = "".join(f"<p>{html.escape(line)}</p>" for line in said)
                name = html.escape(f"{op}: {case}")
                body.append(
                    f"<section><h2>{name}</h2><p>{text}</p>{lines}{figures}{rows}</section>"
                )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Benchmarks</title><style>{_STYLE}</style></head>\n<body>{''.join(body)}</body></html>\n"
    )


def _html_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def cell(text: str) -> str:
        kind = text if text in ("reached", "missed") else ""
        if _NUMBER.fullmatch(text):
            kind = "number"
        return f'<td class="{kind}">{html.escape(text)}</td>'

    head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
    lines = [f"<tr>{head}</tr>"]
    lines += [f"<tr>{''.join(cell(c) for c in row)}</tr>" for row in rows]
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'
