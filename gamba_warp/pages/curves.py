"""Curves of a training run as inline SVG, from its ``log.jsonl``."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..conventions import GROUNDS
from ..image_metrics import METRICS
from .page import ticks
from .run_log import RunRecord, Series

# Points of a curve: with more than the least they are averaged, eight or more at a time.
_LEAST, _MOST, _EACH = 60, 100, 8
_WIDTH, _HEIGHT = 480, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 74, 456, 46, 204
_COLOURS = 6
_COLOUR_OF = {"held out": 1, "input view": 1, "novel views": 2}  # the same in all charts


@dataclass(frozen=True)
class Chart:
    """One chart.

    Attributes:
        title: with the unit.
        lines: names of ``RunRecord.series`` by label.
        logarithmic: whether the vertical axis is, where values span over 3 x.
        exact: whether points are left out where there are many, and not averaged; of validations
            they always are.
    """

    title: str
    lines: dict[str, str]
    logarithmic: bool = False
    exact: bool = False


@dataclass(frozen=True)
class _Curve:
    """Points of a curve; ``low`` and ``high`` hold the middle 80 % of what was averaged."""

    label: str
    colour: str
    steps: np.ndarray
    values: np.ndarray
    low: np.ndarray
    high: np.ndarray
    binned: bool


def _held_out(measure: str) -> dict[str, str]:
    return {"input view": f"val.{measure}_input", "novel views": f"val.{measure}_novel"}


_CHARTS = (
    Chart("Loss", {"training": "train.loss", "held out": "val.loss"}, True),
    Chart("PSNR, dB", {"training, all views": "train.psnr", **_held_out("psnr")}),
    Chart(
        "PSNR of novel views on other grounds, dB, held out",
        {f"on {ground}": f"val.psnr_{ground}_novel" for ground in GROUNDS},
    ),
    *(
        Chart(
            f"{metric.title[0].upper()}{metric.title[1:]}, held out"
            + ("" if metric.more_is_better else " (lower is better)"),
            _held_out(key),
        )
        for key, metric in METRICS.items()
        if key != "psnr"
    ),
    Chart("Learning rate", {"": "train.lr"}, exact=True),
    Chart("Norm of the gradient", {"": "train.grad_norm"}, True),
    Chart("Speed, views a second", {"": "train.views_per_second"}),
)


def draw_curves(record: RunRecord) -> str:
    """Draws a run's curves: losses, PSNR, SSIM, LPIPS, mask IoU, learning rate, speed.

    Each chart has the steps and the hours below it, and the values of a place in its tooltips.

    Args:
        record: the run's log.

    Returns:
        HTML for a page of ``page``, whose style sheet it needs; one sentence if the log is empty.
    """
    terms = [n for n in record.series if n.startswith("train.loss_")]
    charts = list(_CHARTS)
    if len(terms) > 1:
        names = {n.removeprefix("train.loss_").replace("_", " "): n for n in terms[:_COLOURS]}
        charts.insert(5, Chart("Terms of the training loss, unweighted", names, True))
    return draw_charts(charts, record)


def draw_charts(charts: Sequence[Chart], record: RunRecord) -> str:
    """Draws charts of one's own choice; the arguments and the rest are as for ``draw_curves``."""
    drawn = [_draw(chart, record) for chart in charts]
    if not any(drawn):
        return "<p>The log holds no figures yet.</p>"
    return f'<div class="charts">{"".join(drawn)}</div>'


def _thinned(series: Series, label: str, number: int, exact: bool) -> _Curve:
    colour = f"var(--s{_COLOUR_OF.get(label, number) % _COLOURS})"
    steps, values = np.array(series.steps), np.array(series.values)
    if len(steps) <= _LEAST:
        return _Curve(label, colour, steps, values, values, values, False)
    if exact:
        kept = np.linspace(0, len(steps) - 1, min(_MOST, len(steps))).astype(int)
        values = values[kept]
        return _Curve(label, colour, steps[kept], values, values, values, True)
    count = min(_MOST, max(_LEAST // 3, len(steps) // _EACH))
    edges = np.linspace(steps[0], steps[-1], count + 1)[1:-1]
    cuts = np.unique(np.searchsorted(steps, edges, side="right"))
    parts = [part for part in np.split(np.arange(len(steps)), cuts) if len(part)]
    middle = np.array([steps[part].mean() for part in parts])
    means = np.array([values[part].mean() for part in parts])
    low, high = np.array([np.quantile(values[part], (0.1, 0.9)) for part in parts]).T
    return _Curve(label, colour, middle, means, low, high, True)


class _Axes:
    """Places in a chart: ``x`` of a step, ``y`` of a value."""

    def __init__(self, last: float, found: Sequence[_Curve], logarithmic: bool) -> None:
        lows = np.concatenate([curve.low for curve in found])
        highs = np.concatenate([curve.high for curve in found])
        self.last = last or 1.0
        self.low, self.high = float(lows.min()), float(highs.max())
        self.logarithmic = logarithmic and self.low > 0 and self.high > 3 * self.low

    def x(self, step: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * step / self.last

    def y(self, value: float) -> float:
        bend = math.log10 if self.logarithmic else float
        low, high = bend(self.low), bend(self.high)
        share = (bend(value) - low) / (high - low) if high > low else 0.5
        return _BOTTOM - (_BOTTOM - _TOP) * share


def _draw(chart: Chart, record: RunRecord) -> str:
    """The chart's ``<svg>``, or an empty text where none of its lines has a point."""
    found = [
        _thinned(record.series[name], label, number, chart.exact or name.startswith("val."))
        for number, (label, name) in enumerate(chart.lines.items())
        if name in record.series and record.series[name].steps
    ]
    if not found:
        return ""
    last = max(series.steps[-1] for series in record.series.values() if series.steps)
    axes = _Axes(last, found, chart.logarithmic)
    title = html.escape(chart.title) + (", logarithmic" if axes.logarithmic else "")
    parts = [
        f'<text class="name" x="{_LEFT}" y="14">{title}</text>',
        _scale(axes, record),
        *(_line(curve, axes) for curve in found),
        _legend(found),
        *_slots(found, axes, record),
    ]
    name = html.escape(chart.title, quote=True)
    box = f'viewBox="0 0 {_WIDTH} {_HEIGHT}"'
    return f'<svg {box} role="img" aria-label="{name}">{"".join(parts)}</svg>'


def _scale(axes: _Axes, record: RunRecord) -> str:
    """Lines and numbers of the axes; below, the steps and the hours (or minutes)."""
    parts = []
    for value in ticks(axes.low, axes.high, axes.logarithmic):
        y = axes.y(value)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(
            f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_short(value)}</text>'
        )
    steps, minutes = _times(record)
    unit, name = (60.0, "hours") if minutes[-1] > 90 else (1.0, "minutes")
    rows = [("steps", [(v, v) for v in ticks(0, axes.last, False)])]
    marks = ticks(0, minutes[-1] / unit, False)
    rows.append((name, [(v, float(np.interp(v * unit, minutes, steps))) for v in marks]))
    for row, (label, places) in enumerate(rows):
        y = _BOTTOM + 18 + 17 * row
        parts.append(f'<text x="{_LEFT - 14}" y="{y}" text-anchor="end">{label}</text>')
        for value, step in places:
            at = f'x="{axes.x(step):.1f}" y="{y}"'
            parts.append(f'<text {at} text-anchor="middle">{value:,.7g}</text>')
    return "".join(parts)


def _times(record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """Steps and the minutes that had passed at each, both rising."""
    longest = max(record.series.values(), key=lambda series: len(series.steps))
    steps = np.array([0.0, *longest.steps])
    return steps, np.maximum.accumulate(np.array([0.0, *longest.minutes]))


def _line(curve: _Curve, axes: _Axes) -> str:
    colour = curve.colour
    xs = [f"{axes.x(step):.1f}" for step in curve.steps]

    def points(values: np.ndarray) -> list[str]:
        return [f"{x},{axes.y(v):.1f}" for x, v in zip(xs, values)]

    parts = []
    if curve.binned and (curve.high > curve.low).any():
        around = " ".join([*points(curve.high), *reversed(points(curve.low))])
        parts.append(f'<polygon class="band" style="fill: {colour}" points="{around}"/>')
    line = points(curve.values)
    parts.append(f'<polyline class="line" style="stroke: {colour}" points="{" ".join(line)}"/>')
    if not curve.binned:
        places = (point.split(",") for point in line)
        dots = "".join(f'<circle cx="{x}" cy="{y}" r="2.2"/>' for x, y in places)
        parts.append(f'<g style="fill: {colour}">{dots}</g>')
    return "".join(parts)


def _legend(found: Sequence[_Curve]) -> str:
    """Labels in the curves' colours, with their last values."""
    parts = []
    for curve in found:
        text = html.escape(f"{curve.label} {_short(curve.values[-1])}".strip())
        space = ' dx="12"' if parts else ""
        parts.append(f'<tspan style="fill: {curve.colour}"{space}>{text}</tspan>')
    return f'<text x="{_LEFT}" y="31">{"".join(parts)}</text>'


def _slots(found: Sequence[_Curve], axes: _Axes, record: RunRecord) -> list[str]:
    """Columns with the values there as their tooltips, one for each point of the finest curve."""
    finest = max(found, key=lambda curve: len(curve.steps))
    xs = np.array([axes.x(step) for step in finest.steps])
    edges = [_LEFT, *((xs[1:] + xs[:-1]) / 2), _RIGHT]
    steps, minutes = _times(record)
    made = []
    for step, left, right in zip(finest.steps, edges, edges[1:]):
        hours = np.interp(step, steps, minutes) / 60
        lines = [f"step {step:,.0f}, {f'{hours:.2f} h' if hours >= 1 else f'{hours * 60:.1f} min'}"]
        for curve in found:
            near = int(np.abs(curve.steps - step).argmin())
            value = f"{curve.label} {_short(curve.values[near])}".strip()
            away = curve is not finest and abs(curve.steps[near] - step) * 200 > axes.last
            lines.append(value + (f" (step {curve.steps[near]:,.0f})" if away else ""))
        at = f'x="{left:.0f}" width="{max(1, right - left):.0f}" y="{_TOP}"'
        text = html.escape("\n".join(lines))
        size = _BOTTOM - _TOP
        made.append(f'<rect class="slot" {at} height="{size}"><title>{text}</title></rect>')
    return made


def _short(value: float) -> str:
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.3g}"
