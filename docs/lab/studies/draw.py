"""Bars as inline SVG, and the charts of growths as one SVG file, for pages that load pictures."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

from markupsafe import Markup

from gamba_warp.pages.charts import HEIGHT, WIDTH

from .slopes import error_charts, growth_charts

_COLUMNS, _GAP, _TITLE = 2, 28, 30
_STYLE = """
svg { --text: #22252a; --soft: #686d76; --line: #dfe0dc; --card: #ffffff;
  --s0: #1f6feb; --s1: #d1582b; --s2: #2c8a57; --s3: #8250c4; --s4: #b8860b; --s5: #c2397b; }
.name { font-weight: 600; }
text { fill: var(--text); font: 12px system-ui, sans-serif; }
.title { font-size: 15px; font-weight: 600; }
.axis { fill: var(--soft); font-weight: 600; }
.grid { stroke: var(--line); }
.line { fill: none; stroke-width: 2; stroke-linejoin: round; }
.guide { stroke-dasharray: 3 4; }
"""


def growth_picture(documents: Sequence[dict]) -> str:
    """All growths of results as one SVG: a chart of a case beside the next, with its title.

    Args:
        documents: as ``measure`` returns them.

    Returns:
        The text of the file; empty if nothing grows in the documents.
    """
    drawn: list[tuple[str, str]] = []
    for document in documents:
        cases: dict[str, list[dict]] = {}
        for r in document["records"]:
            cases.setdefault(f"{r['op']}: {r['case']}", []).append(r)
        for name, records in cases.items():
            charts = [*growth_charts(records), *error_charts(records)]
            drawn += [(name, svg) for svg in charts if svg]
    if not drawn:
        return ""
    step_x, step_y = WIDTH + _GAP, HEIGHT + _GAP + _TITLE
    width = _COLUMNS * step_x + _GAP
    height = -(-len(drawn) // _COLUMNS) * step_y + _GAP
    parts = [f'<rect width="{width}" height="{height}" fill="#ffffff"/>']
    for i, (name, svg) in enumerate(drawn):
        x, y = _GAP + i % _COLUMNS * step_x, _GAP + i // _COLUMNS * step_y
        parts.append(f'<text class="title" x="{x + 6}" y="{y + 16}">{html.escape(name)}</text>')
        place = f'<svg x="{x}" y="{y + _TITLE}" width="{WIDTH}" height="{HEIGHT}" '
        parts.append(str(svg).replace("<svg ", place, 1))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">'
        f"<style>{_STYLE}</style>{''.join(parts)}</svg>\n"
    )


_WIDTH, _LEFT, _RIGHT, _TOP = 600, 190, 545, 44
_BAR, _BETWEEN = 11, 7  # height of a bar, and between two names, pixels


def bars(series: Mapping[str, Mapping[str, float]], label: str) -> str:
    """Returns the ``<svg>`` element, or an empty text if there is nothing to show.

    Args:
        series: by series, figures by name, >= 0; a name that one lacks is 0 there.
        label: what the figures are, with their unit.
    """
    names = list(dict.fromkeys(name for figures in series.values() for name in figures))
    largest = max((value for figures in series.values() for value in figures.values()), default=0)
    if largest <= 0:
        return ""
    step = _BAR * len(series) + _BETWEEN
    parts = [f'<text class="axis" x="{_LEFT}" y="34">{html.escape(label)}</text>']
    right = _RIGHT
    for i, name in reversed(list(enumerate(series))):
        style = f'style="fill: var(--s{i % 4})"'
        parts.append(
            f'<text class="axis" x="{right}" y="16" text-anchor="end" {style}>'
            f"{html.escape(name)}</text>"
        )
        right -= 7.2 * len(name) + 24
    for row, name in enumerate(names):
        top = _TOP + row * step
        middle = top + _BAR * len(series) / 2 + 4
        parts.append(
            f'<text x="{_LEFT - 8}" y="{middle:.1f}" text-anchor="end">{html.escape(name)}</text>'
        )
        parts += _row(top, name, list(series.values()), largest)
    height = _TOP + len(names) * step
    return Markup(f'<svg viewBox="0 0 {_WIDTH} {height}" role="img">{"".join(parts)}</svg>')


def _row(top: float, name: str, series: Sequence[Mapping[str, float]], largest: float) -> list[str]:
    parts = []
    for i, figures in enumerate(series):
        value = max(0.0, figures.get(name, 0.0))
        width, y = (_RIGHT - _LEFT) * value / largest, top + i * _BAR
        parts.append(
            f'<rect x="{_LEFT}" y="{y}" width="{width:.1f}" height="{_BAR - 1}" '
            f'style="fill: var(--s{i % 4})"/>'
        )
        text = f"{value:.3g}" if value < 1000 else f"{value:,.0f}"
        parts.append(f'<text x="{_LEFT + width + 5:.1f}" y="{y + 9}">{text}</text>')
    return parts
