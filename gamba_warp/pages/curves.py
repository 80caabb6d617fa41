"""Curves of a training run, from its ``log.jsonl``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..conventions import GROUNDS
from ..image_metrics import METRICS
from . import charts
from .charts import Axis, Point, round_values
from .page import Section
from .run_log import RunRecord, Series

# Points of a curve: above _LEAST they are averaged, eight or more at a time.
_LEAST, _MOST, _EACH = 60, 100, 8
_SIZE = (480, 250)
_COLOUR_OF = {"held out": 1, "input view": 1, "novel views": 2}  # the same in all charts


@dataclass(frozen=True)
class Chart:
    """One chart.

    Attributes:
        title: with the unit.
        lines: names of ``RunRecord.series`` by label.
        logarithmic: use a logarithmic vertical axis if values span over a factor of 3.
        exact: many points are thinned instead of averaged; validations always are.
    """

    title: str
    lines: dict[str, str]
    logarithmic: bool = False
    exact: bool = False


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


def curves_section(
    title: str, text: str, record: RunRecord, chosen: Sequence[Chart] | None = None
) -> Section:
    """Return a run's curves: losses, PSNR, SSIM, LPIPS, mask IoU, learning rate, speed.

    Each chart has axes of steps and hours, and tooltips with the values.

    Args:
        title: of the section.
        text: of the section; replaced by a note if the log has no figures.
        record: the run's log.
        chosen: other charts.
    """
    if chosen is None:
        chosen = [_with_datasets(chart, record.validated) for chart in _CHARTS]
        terms = [n for n in record.series if n.startswith("train.loss_")]
        if len(terms) > 1:
            names = {n.removeprefix("train.loss_").replace("_", " "): n for n in terms}
            names = dict(list(names.items())[: charts.COLOURS])
            chosen.insert(5, Chart("Terms of the training loss, unweighted", names, True))
    drawn = [svg for chart in chosen if (svg := _draw(chart, record))]
    return Section(title, text if drawn else "The log holds no figures yet.", charts=drawn)


def _with_datasets(chart: Chart, names: Sequence[str]) -> Chart:
    """Add the lines of further datasets, except input views, as far as there are colours."""
    lines = dict(chart.lines)
    for name in names:
        for label, series in chart.lines.items():
            if series.startswith("val.") and not series.endswith("_input"):
                lines[f"{label}, {name}"] = series.replace("val.", f"val/{name}.", 1)
    return replace(chart, lines=dict(list(lines.items())[: charts.COLOURS]))


def _thinned(series: Series, exact: bool) -> list[Point]:
    """Return the curve's points; averaged ones have the middle 80 % of the values as spread."""
    steps, values = np.array(series.steps), np.array(series.values)
    if exact and len(steps) > _LEAST:
        kept = np.linspace(0, len(steps) - 1, min(_MOST, len(steps))).astype(int)
        steps, values = steps[kept], values[kept]
    if exact or len(steps) <= _LEAST:
        return [Point(*pair) for pair in zip(steps.tolist(), values.tolist())]
    count = min(_MOST, max(_LEAST // 3, len(steps) // _EACH))
    edges = np.linspace(steps[0], steps[-1], count + 1)[1:-1]
    cuts = np.unique(np.searchsorted(steps, edges, side="right"))
    parts = [part for part in np.split(np.arange(len(steps)), cuts) if len(part)]
    found = []
    for part in parts:
        low, high = np.quantile(values[part], (0.1, 0.9)).tolist()
        found.append(Point(steps[part].mean(), values[part].mean(), spread=(low, high)))
    return found


def _draw(chart: Chart, record: RunRecord) -> str:
    """Return the chart's ``<svg>``, or an empty text if no line has a point."""
    lines, drawn = {}, []
    for index, (label, name) in enumerate(chart.lines.items()):
        series = record.series.get(name)
        if series and series.steps:
            lines[label] = points = _thinned(series, chart.exact or name.startswith("val"))
            last = f"{label} {_short(points[-1].y)}".strip()
            kind = "straight" if len(series.steps) <= _LEAST else "curve"
            drawn.append(charts.Series(last, points, kind, _COLOUR_OF.get(label, index)))
    if not lines:
        return ""
    ends = [end for points in lines.values() for p in points for end in (p.y, *(p.spread or ()))]
    logarithmic = chart.logarithmic and min(ends) > 0 and max(ends) > 3 * min(ends)
    longest = max(record.series.values(), key=lambda series: len(series.steps))
    steps = np.array([0.0, *longest.steps])
    minutes = np.maximum.accumulate(np.array([0.0, *longest.minutes]))
    last = max(series.steps[-1] for series in record.series.values() if series.steps) or 1.0
    unit, name = (60.0, "hours") if minutes[-1] > 90 else (1.0, "minutes")
    times = round_values(0, minutes[-1] / unit) if minutes[-1] > 0 else [0.0]
    rows = [
        ("steps", [(value, f"{value:,.7g}") for value in round_values(0, last)]),
        (name, [(float(np.interp(v * unit, minutes, steps)), f"{v:,.7g}") for v in times]),
    ]
    finest = max(lines.values(), key=len)
    tooltips = []
    for x in (point.x for point in finest):
        hours = np.interp(x, steps, minutes) / 60
        texts = [f"step {x:,.0f}, {f'{hours:.2f} h' if hours >= 1 else f'{hours * 60:.1f} min'}"]
        for label, points in lines.items():
            near = min(points, key=lambda point: abs(point.x - x))
            away = points is not finest and abs(near.x - x) * 200 > last
            texts.append(f"{label} {_short(near.y)}".strip())
            texts[-1] += f" (step {near.x:,.0f})" if away else ""
        tooltips.append((x, "\n".join(texts)))
    return charts.chart(
        drawn,
        Axis("steps", False, ends=(0.0, last), rows=rows),
        Axis(chart.title + (", logarithmic" if logarithmic else ""), logarithmic),
        **{"name": chart.title, "size": _SIZE, "tooltips": tooltips},
    )


def _short(value: float) -> str:
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.3g}"
