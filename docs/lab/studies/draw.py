"""Bars as inline SVG, and the charts of growths as one SVG file."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

from markupsafe import Markup

from gamba_warp.pages.charts import picture

from .slopes import error_charts, growth_charts


def growth_picture(documents: Sequence[dict]) -> str:
    """Draw all growths of results as one SVG, with a titled chart per case.

    Args:
        documents: results of ``measure``.

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
    return picture(drawn)


_WIDTH, _LEFT, _RIGHT, _TOP = 600, 190, 545, 44
_BAR, _BETWEEN = 11, 7  # height of a bar, and between two names, pixels


def bars(series: Mapping[str, Mapping[str, float]], label: str) -> str:
    """Return the ``<svg>`` element, or an empty text without any figures.

    Args:
        series: by series, figures by name, >= 0; missing names are 0.
        label: quantity and unit of the figures.
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
