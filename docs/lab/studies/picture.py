"""The charts of growths as one SVG file, for pages that load pictures."""

from __future__ import annotations

import html
from collections.abc import Sequence

from gamba_warp.kernels.bench.core.charts import HEIGHT, WIDTH

from .slopes import error_charts, growth_charts

_COLUMNS, _GAP, _TITLE = 2, 28, 30
_STYLE = """
svg { --text: #22252a; --soft: #686d76; --line: #dfe0dc; --card: #ffffff;
  --s0: #1f6feb; --s1: #d1582b; --s2: #2c8a57; --s3: #8250c4; }
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
        parts.append(svg.replace("<svg ", place, 1))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">'
        f"<style>{_STYLE}</style>{''.join(parts)}</svg>\n"
    )
