"""Charts as inline SVG: named points, lines and logarithmic axes; the page sets the colours."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 600, 380  # of a chart, pixels
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 584, 36, 334
_CHARACTER, _LINE = 6.4, 13.0  # size of a label's character, pixels


@dataclass(frozen=True)
class Point:
    """One figure; ``mark`` is "", "default" or "peer", and ``label`` is drawn beside it."""

    x: float
    y: float
    label: str = ""
    mark: str = ""


@dataclass(frozen=True)
class Series:
    """Points of one colour; ``line`` is "" or "straight"; "steps" and "guide" hide the points."""

    name: str
    points: Sequence[Point]
    line: str = ""


@dataclass(frozen=True)
class Axis:
    """What an axis shows, with its unit; ``values`` are its ticks, if they are given."""

    label: str
    logarithmic: bool = True
    values: Sequence[float] = ()


def pareto(points: Sequence[Point]) -> list[Point]:
    """Returns, by x, the points that no other one equals or beats in both x and y (less wins)."""
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p.x, p.y)):
        if not front or point.y < front[-1].y:
            front.append(point)
    return front


def chart(series: Sequence[Series], x: Axis, y: Axis) -> str:
    """Returns the ``<svg>`` element, or an empty text if there is nothing to show.

    Points that are not finite, or not positive on a logarithmic axis, are left out.
    """
    shown = [
        Series(s.name, [p for p in s.points if _fits(p.x, x) and _fits(p.y, y)], s.line)
        for s in series
    ]
    shown = [s for s in shown if s.points]
    if not shown:
        return ""
    points = [p for s in shown for p in s.points]
    place_x = _scale([p.x for p in points], x, _LEFT, _RIGHT)
    place_y = _scale([p.y for p in points], y, _BOTTOM, _TOP)
    parts, named = _grid(place_x, place_y, x, y), []
    for i, s in enumerate(shown):
        placed = [(place_x(p.x), place_y(p.y)) for p in s.points]
        parts.append(_line(placed, s.line, i))
        if s.line not in ("steps", "guide"):
            parts += [_mark(at, p, i) for at, p in zip(placed, s.points)]
            named += [(at, p.label) for at, p in zip(placed, s.points) if p.label]
    parts += _labels(named)
    parts += _legend(shown)
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{"".join(parts)}</svg>'


def _fits(value: float, axis: Axis) -> bool:
    return math.isfinite(value) and (value > 0 or not axis.logarithmic)


def _scale(values: list[float], axis: Axis, start: float, end: float):
    """Makes the map from figures to pixels, with room at both ends; ``low, high`` bound it."""
    bend = math.log10 if axis.logarithmic else float
    low, high = bend(min(values)), bend(max(values))
    room = 0.08 * (high - low) or (0.3 if axis.logarithmic else abs(high) or 1.0)
    if axis.logarithmic:  # show at least a factor of 2.5, so that noise does not look like more
        room = max(room, (0.4 - high + low) / 2)
    low, high = low - room, high + room

    def place(value: float) -> float:
        return start + (end - start) * (bend(value) - low) / (high - low)

    if axis.logarithmic:  # a stranger's figures may leave no room in the range of numbers
        place.low, place.high = 10 ** max(low, -300.0), 10 ** min(high, 300.0)
    else:
        place.low, place.high = low, high
    return place


def _grid(place_x, place_y, x: Axis, y: Axis) -> list[str]:
    parts = []
    for value in x.values or _ticks(place_x.low, place_x.high, x.logarithmic):
        at = place_x(value)
        parts.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP}" y2="{_BOTTOM}"/>')
        text = f'x="{at:.1f}" y="{_BOTTOM + 18}" text-anchor="middle"'
        parts.append(f"<text {text}>{_number(value)}</text>")
    for value in y.values or _ticks(place_y.low, place_y.high, y.logarithmic):
        at = place_y(value)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        text = f'x="{_LEFT - 8}" y="{at + 4:.1f}" text-anchor="end"'
        parts.append(f"<text {text}>{_number(value)}</text>")
    middle = (_LEFT + _RIGHT) / 2
    parts.append(
        f'<text class="axis" x="{middle}" y="{HEIGHT - 8}" text-anchor="middle">'
        f"{html.escape(x.label)}</text>"
    )
    parts.append(f'<text class="axis" x="{_LEFT - 56}" y="16">{html.escape(y.label)}</text>')
    return parts


def _ticks(low: float, high: float, logarithmic: bool) -> list[float]:
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


def _number(value: float) -> str:
    if value and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:,.6g}"


def _line(placed: list[tuple[float, float]], kind: str, colour: int) -> str:
    if not kind:
        return ""
    if kind == "steps":  # the line shows the least y that can be had for at most x
        corners = [(after[0], at[1]) for at, after in zip(placed, placed[1:])]
        placed = [p for pair in zip(placed, [*corners, placed[-1]]) for p in pair]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in placed)
    return f'<polyline class="line {kind}" style="stroke: var(--s{colour % 4})" points="{path}"/>'


def _mark(at: tuple[float, float], point: Point, colour: int) -> str:
    x, y = at
    name = html.escape(f"{point.label}: {point.x:.4g}, {point.y:.3g}".lstrip(": "))
    style = f'style="fill: var(--s{colour % 4}); stroke: var(--s{colour % 4})"'
    if point.mark == "peer":
        shape = f'<rect class="dot" x="{x - 4:.1f}" y="{y - 4:.1f}" width="8" height="8" {style}/>'
    else:
        shape = f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="4.5" {style}/>'
    if point.mark == "default":
        shape += f'<circle class="ring" cx="{x:.1f}" cy="{y:.1f}" r="9" {style}/>'
    return f"<g>{shape}<title>{name}</title></g>"


def _labels(named: list[tuple[tuple[float, float], str]]) -> list[str]:
    """Puts texts beside their points, each at the first position that hides nothing."""
    taken = [(x - 9, y - 9, x + 9, y + 9) for (x, y), _ in named]
    parts = []
    for (x, y), text in named:
        width = _CHARACTER * len(text)
        positions = [
            (left, y + 4 + lines * _LINE)
            for lines in (0, -1, 1, -2, 2, -3, 3, -4, 4)
            for left in (x + 12, x - 12 - width)
        ]
        left, base = next(
            ((a, b) for a, b in positions if _free((a, b - 11, a + width, b + 3), taken)),
            positions[0],
        )
        taken.append((left, base - 11, left + width, base + 3))
        parts.append(f'<text x="{left:.1f}" y="{base:.1f}">{html.escape(text)}</text>')
    return parts


def _free(box: tuple, taken: list[tuple]) -> bool:
    inside = box[0] >= 2 and box[2] <= WIDTH and box[1] >= 20 and box[3] <= _BOTTOM
    return inside and not any(
        box[0] < t[2] and t[0] < box[2] and box[1] < t[3] and t[1] < box[3] for t in taken
    )


def _legend(series: list[Series]) -> list[str]:
    parts, right = [], _RIGHT
    for i, s in reversed(list(enumerate(series))):
        style = f'style="fill: var(--s{i % 4})"'
        name = html.escape(s.name)
        parts.append(
            f'<text class="axis" x="{right}" y="16" text-anchor="end" {style}>{name}</text>'
        )
        right -= 7.2 * len(s.name) + 24
    return parts
