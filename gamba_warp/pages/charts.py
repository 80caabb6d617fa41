"""Charts as inline SVG with points, lines and logarithmic axes; the page sets colours."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from .templates import render

WIDTH, HEIGHT = 600, 380  # of a chart, pixels
COLOURS = 6  # of the style sheet, --s0 to --s5
_LEFT, _RIGHT, _TOP, _BOTTOM = 74, 24, 46, 46  # margins, pixels
_CHARACTER, _LINE = 6.4, 13.0  # size of a label's character, pixels
_FEW = 20  # lines with at most so many points have larger dots


@dataclass(frozen=True)
class Point:
    """One figure.

    Attributes:
        x: horizontal value.
        y: the figure.
        label: drawn beside it.
    """

    x: float
    y: float
    label: str = ""


@dataclass(frozen=True)
class Series:
    """Points of one colour.

    Attributes:
        name: in the legend, unless empty.
        points: in the order of the line.
        line: "" or "straight".
    """

    name: str
    points: Sequence[Point]
    line: str = ""


@dataclass(frozen=True)
class Axis:
    """An axis of a chart.

    Attributes:
        label: with the unit.
        logarithmic: False for a linear axis.
        values: ticks, if given.
    """

    label: str
    logarithmic: bool = True
    values: Sequence[float] = ()


def chart(
    series: Sequence[Series],
    x: Axis,
    y: Axis,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> Markup | str:
    """Draw a chart.

    Points that are not finite, or not positive on a logarithmic axis, are left out.

    Args:
        series: drawn in order, later ones on top.
        x: the horizontal axis.
        y: the vertical axis, whose label is the chart's title.
        size: width and height in user units.

    Returns:
        The ``<svg>`` element, or an empty text without points.
    """
    found = [
        (s, [p for p in s.points if _fits(p.x, x) and _fits(p.y, y)], i)
        for i, s in enumerate(series)
    ]
    found = [(s, points, i) for s, points, i in found if points]
    if not found:
        return ""
    shown = [point for _, points, _ in found for point in points]
    left, right, top, bottom = _LEFT, size[0] - _RIGHT, _TOP, size[1] - _BOTTOM
    to_x = _Scale([p.x for p in shown], x, left, right)
    to_y = _Scale([p.y for p in shown], y, bottom, top)
    drawn, named = [], []
    for s, points, index in found:
        placed = [(to_x(p.x), to_y(p.y)) for p in points]
        dots = list(zip(placed, points))
        named += [(at, p.label) for at, p in dots if p.label]
        drawn.append(
            {
                "colour": f"var(--s{index % COLOURS})",
                "name": s.name,
                "line": s.line,
                "path": _path(placed),
                "radius": 4.5 if not s.line else 3 if len(points) <= _FEW else 2.2,
                "dots": [(at, f"{p.label}: {p.x:.4g}, {p.y:.3g}".lstrip(": ")) for at, p in dots],
            }
        )
    return render(
        "chart.svg",
        **{"size": size, "left": left, "right": right, "top": top, "bottom": bottom},
        **{"x": x, "y": y, "series": drawn},
        columns=[(to_x(value), number(value)) for value in x.values or to_x.ticks()],
        rows=[(to_y(value), number(value)) for value in y.values or to_y.ticks()],
        labels=_labels(named, size[0], bottom),
    )


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
"""


def picture(drawn: Sequence[tuple[str, str]], size: tuple[int, int] = (WIDTH, HEIGHT)) -> str:
    """Combine charts with titles into one SVG file with its own colours.

    Args:
        drawn: pairs of a title and the result of ``chart``.
        size: of the charts.

    Returns:
        The text of the file; empty without charts.
    """
    if not drawn:
        return ""
    step_x, step_y, columns = size[0] + _GAP, size[1] + _GAP + _TITLE, min(_COLUMNS, len(drawn))
    width, height = columns * step_x + _GAP, -(-len(drawn) // columns) * step_y + _GAP
    parts = [f'<rect width="{width}" height="{height}" fill="#ffffff"/>']
    for i, (name, svg) in enumerate(drawn):
        x, y = _GAP + i % columns * step_x, _GAP + i // columns * step_y
        parts.append(f'<text class="title" x="{x + 6}" y="{y + 16}">{html.escape(name)}</text>')
        element = f'<svg x="{x}" y="{y + _TITLE}" width="{size[0]}" height="{size[1]}" '
        parts.append(str(svg).replace("<svg ", element, 1))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">'
        f"<style>{_STYLE}</style>{''.join(parts)}</svg>\n"
    )


def number(value: float) -> str:
    """Format a figure with up to six digits, or as a power of ten."""
    if value and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:,.6g}"


def _fits(value: float, axis: Axis) -> bool:
    return math.isfinite(value) and (value > 0 or not axis.logarithmic)


def _path(points: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)


class _Scale:
    """Map from figures to pixels, with a margin at both ends; ``low`` and ``high`` bound it."""

    def __init__(self, values: Sequence[float], axis: Axis, start: float, end: float) -> None:
        self._start, self._end, self._logarithmic = start, end, axis.logarithmic
        self._bend = math.log10 if axis.logarithmic else float
        self._only = values[0] if min(values) == max(values) else None
        low, high = self._bend(min(values)), self._bend(max(values))
        margin = 0.08 * (high - low) or (0.3 if axis.logarithmic else abs(high) or 1.0)
        if axis.logarithmic:  # at least a factor of 2.5, so that noise is not exaggerated
            margin = max(margin, (0.4 - high + low) / 2)
        low, high = low - margin, high + margin
        self._low, self._high = low, high
        # Untrusted figures may exceed the range of floats.
        self.low = 10 ** max(low, -300.0) if axis.logarithmic else low
        self.high = 10 ** min(high, 300.0) if axis.logarithmic else high

    def __call__(self, value: float) -> float:
        part = (self._bend(value) - self._low) / (self._high - self._low)
        return self._start + (self._end - self._start) * part

    def ticks(self) -> list[float]:
        """Return round values within the bounds; if all figures are equal, that figure."""
        if self._only is not None and not self._logarithmic:
            return [float(f"{self._only:.4g}")]
        return round_values(self.low, self.high, self._logarithmic)


def round_values(low: float, high: float, logarithmic: bool = False) -> list[float]:
    """Return round values within bounds: multiples of 1, 2 or 5 times a power of ten.

    Args:
        low: lower bound; above 0 if ``logarithmic``.
        high: upper bound, above ``low``.
        logarithmic: for a logarithmic axis, which has more values over a short span.
    """
    if logarithmic:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        close = high < 8 * low
        leads = (1, 1.5, 2, 3, 4, 5, 6, 7, 8) if close else (1, 2, 5) if high < 200 * low else (1,)
        values = [float(f"{lead}e{power}") for power in powers for lead in leads]
    else:
        raw = (high - low) / 5
        unit = 10.0 ** math.floor(math.log10(raw))
        step = next(unit * lead for lead in (1, 2, 5, 10) if unit * lead >= raw)
        values = [step * i for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return [value for value in values if low <= value <= high]


def _labels(
    named: Sequence[tuple[tuple[float, float], str]], width: float, bottom: float
) -> list[tuple[float, float, str]]:
    """Place texts beside their points, each at the first position without overlap."""
    taken = [(x - 9, y - 9, x + 9, y + 9) for (x, y), _ in named]
    found = []
    for (x, y), text in named:
        length = _CHARACTER * len(text)
        boxes = [
            (left, y + lines * _LINE - 7, left + length, y + lines * _LINE + 7)
            for lines in (0, -1, 1, -2, 2, -3, 3, -4, 4)
            for left in (x + 12, x - 12 - length)
        ]
        free = (
            box
            for box in boxes
            if box[0] >= 2 and box[2] <= width and box[1] >= _TOP - 16 and box[3] <= bottom
            if not any(
                box[0] < t[2] and t[0] < box[2] and box[1] < t[3] and t[1] < box[3] for t in taken
            )
        )
        box = next(free, boxes[0])
        taken.append(box)
        found.append((box[0], box[3] - 3, text))
    return found
