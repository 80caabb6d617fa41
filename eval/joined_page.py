"""The table of several methods as Markdown and as a page that loads nothing else."""

from __future__ import annotations

import html
from typing import Any

from gamba_warp.conventions import ON_GROUNDS
from gamba_warp.errors import one_line

from .averages import LEVEL
from .paper import CAVEAT, TABLE_1
from .tables import cell, markdown

_COLUMNS = {
    "psnr": ("PSNR ↑", 2),
    "ssim": ("SSIM ↑", 3),
    "lpips": ("LPIPS ↓", 3),
    "chamfer": ("Chamfer ↓", 4),
    "iou": ("Volume IoU ↑", 4),
}
_GROUNDS = {
    key: (f"{_COLUMNS[metric][0][:-2]} on {ground}{_COLUMNS[metric][0][-2:]}", _COLUMNS[metric][1])
    for key, (metric, ground) in ON_GROUNDS.items()
}
_NAMED = 5  # objects of a method that a line names

Lines = list[list[str]]


def _table(
    rows: list[dict[str, Any]],
    columns: dict[str, tuple[str, int]] = _COLUMNS,
    signed: bool = False,
    timed: bool = False,
) -> Lines:
    """Cells under the columns, the paper's unless told; "-" where a method has no such figure."""
    lines = [["", *(label for label, _ in columns.values())]]
    lines[0] += ["time [s] ↓"] if timed else []
    for row in rows:
        cells = [_figure(row[key], digits, signed) for key, (_, digits) in columns.items()]
        if timed:
            known = row["seconds"] is not None
            cells.append(f"{row['seconds']:.3g} ({row['seconds_from']})" if known else "-")
        lines.append([row["name"], *cells])
    return lines


def _figure(summary: dict[str, Any] | None, digits: int, signed: bool) -> str:
    return "-" if summary is None else cell(summary["mean"], summary["interval"], digits, signed)


def _paper() -> Lines:
    lines = [["", *(label for label, _ in _COLUMNS.values()), "time [s] ↓"]]
    return lines + [
        [name, *("-" if value is None else f"{value:g}" for value in values)]
        for name, values in TABLE_1.items()
    ]


def _texts(joined: dict[str, Any]) -> tuple[str, list[str]]:
    """What a table's numbers are, and lines on objects and remarks."""
    counts: dict[int, list[str]] = {}
    for key, (label, _) in _COLUMNS.items():
        counts.setdefault(len(joined["common"][key]), []).append(label[:-2])
    of = "; ".join(f"{', '.join(labels)}: {_count(n)}" for n, labels in counts.items())
    note = (
        f"Means over the objects that every method with the metric has ({of}), with "
        f"{100 * LEVEL:g} % bootstrap intervals over objects. Views: novel views, on white here. "
        "Lengths: the longest side of the true shape is 1. Time: measured by the evaluation on its "
        "machine (median), or stated by whoever made this table."
    )
    lines = []
    for kind, methods in joined["missing"].items():
        for name, missing in methods.items():
            if missing:
                some = "; ".join(one_line(f"{u}: {r}") for u, r in list(missing.items())[:_NAMED])
                more = "; ..." if len(missing) > _NAMED else ""
                lines.append(f"{kind}: {name} lacks {_count(len(missing))} ({some}{more}).")
    return note, lines + [f"{note}." for note in joined["notes"]]


def _count(number: int) -> str:
    return f"{number or 'no'} object{'' if number == 1 else 's'}"


def _parts(joined: dict[str, Any], paper: bool) -> list[str | Lines]:
    """Texts and tables in their order."""
    note, lines = _texts(joined)
    parts: list[str | Lines] = [_table(joined["rows"], timed=True), note, *lines]
    if joined["differences"]:
        parts += ["Differences, object by object:", _table(joined["differences"], signed=True)]
    if any(joined["common"][key] for key in _GROUNDS):
        count = _count(len(joined["common"]["psnr_black"]))
        text = f"The same novel views on black and on grey, of methods with alpha ({count}):"
        parts += [text, _table(joined["rows"], _GROUNDS)]
    return [*parts, CAVEAT, _paper()] if paper else parts


def markdown_page(joined: dict[str, Any], paper: bool) -> str:
    """The text of ``compare.md``.

    Args:
        joined: what ``joined.join`` returns.
        paper: whether the paper's own figures are printed too.
    """
    parts = [p if isinstance(p, str) else markdown(p) for p in _parts(joined, paper)]
    return "\n\n".join(parts) + "\n"


_STYLE = """
:root { color-scheme: light dark; }
body { margin: 0 auto; padding: 2rem 1.25rem; max-width: 70rem;
  font: 15px/1.5 system-ui, sans-serif; }
.scroll { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem 1.2rem .3rem 0; text-align: left; border-bottom: 1px solid #8884; }
th { font-weight: 600; } td span { opacity: .65; font-size: .85em; white-space: nowrap; }
p { max-width: 52rem; }
"""


def html_page(joined: dict[str, Any], paper: bool) -> str:
    """The text of ``compare.html``; arguments as for ``markdown_page``."""
    body = "".join(
        f"<p>{html.escape(part)}</p>" if isinstance(part, str) else _html_table(part)
        for part in _parts(joined, paper)
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Methods compared</title><style>{_STYLE}</style></head>\n"
        f"<body><h1>Methods compared</h1>{body}</body></html>\n"
    )


def _html_table(lines: Lines) -> str:
    def figure(text: str) -> str:
        value, bracket, ends = html.escape(text).partition(" [")
        return f"{value}<br><span>[{ends}</span>" if bracket else value

    head = "".join(f"<th>{html.escape(text)}</th>" for text in lines[0])
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td>{''.join(f'<td>{figure(c)}</td>' for c in cells)}</tr>"
        for name, *cells in lines[1:]
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{rows}</table></div>'
