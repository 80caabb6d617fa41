"""Crossings of two lines of a chart: the length from which one series costs more than another."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

# Figures of a case with the axis "lengths": key of the record or of its work, name, unit, factor.
FIGURES = {
    "ms_p50": ("time", "milliseconds", 1.0),
    "peak_bytes": ("memory", "MiB at the peak", 2.0**-20),
}


class Crossing(NamedTuple):
    """Point from which the second series costs more than the first.

    Attributes:
        op: of the case.
        case: its name.
        direction: of the records.
        dtype: of the records.
        figure: "time" or "memory".
        first: name of the series that costs less beyond the crossing.
        second: name of the other one.
        lengths: lengths that both have, the least and the greatest.
        at: the length L*, interpolated between two lengths on logarithmic axes; None if the series
            do not cross.
        value: the figure there, in the unit of ``FIGURES``; None likewise.
        cheaper: name of the series that costs less at the greatest length.
    """

    op: str
    case: str
    direction: str
    dtype: str
    figure: str
    first: str
    second: str
    lengths: tuple[float, float]
    at: float | None
    value: float | None
    cheaper: str

    def text(self) -> str:
        """Describe the crossing in one sentence."""
        where = f"{self.direction}, {self.dtype}, {self.figure}"
        low, high = (f"{length:,.0f}" for length in self.lengths)
        if self.at is None:
            measured = f"every L from {low} to {high}" if low != high else f"L {low}"
            return f"{where}: {self.cheaper} costs less at {measured}."
        return (
            f"{where}: L* = {self.at:,.0f}; beyond it {self.cheaper} costs less than "
            f"{self.first if self.cheaper == self.second else self.second} (L {low} to {high})."
        )


def crossings(records: Iterable[dict]) -> list[Crossing]:
    """Find the crossings of every case with the axis "lengths": of its first and second series.

    If lines cross more than once, the crossing at the greatest length counts.
    """
    found: dict[tuple[str, ...], list[dict]] = {}
    for r in records:
        if r["axis"] == "lengths" and r["status"] == "ok":
            key = (r["op"], r["case"], r["direction"], r["dtype"])
            found.setdefault(key, []).append(r)
    made = [_crossing(key, part, name) for key, part in found.items() for name in FIGURES]
    return [crossing for crossing in made if crossing is not None]


def series_of(records: Sequence[dict], figure: str) -> dict[str, dict[float, float]]:
    """Figures by series and length, of the records of one direction and dtype."""
    factor, result = FIGURES[figure][2], {}
    for r in records:
        value, length = r.get(figure) or r["work"].get(figure), r["parameters"].get("L")
        if value and value > 0 and type(length) in (int, float) and length > 0:
            name = str(r["parameters"].get("series", r["variant"]))
            result.setdefault(name, {})[length] = factor * value
    return result


def _crossing(key: tuple[str, ...], records: Sequence[dict], figure: str) -> Crossing | None:
    lines = series_of(records, figure)
    if len(lines) < 2:
        return None
    (first, a), (second, b) = list(lines.items())[:2]
    both = sorted(a.keys() & b.keys())
    if not both:
        return None
    gap = [math.log(b[x]) - math.log(a[x]) for x in both]
    cheaper = first if gap[-1] > 0 else second
    op, case, direction, dtype = key
    common: dict[str, Any] = dict(op=op, case=case, direction=direction, dtype=dtype)
    common |= dict(figure=FIGURES[figure][0], first=first, second=second, cheaper=cheaper)
    common["lengths"] = (both[0], both[-1])
    for i in reversed(range(len(both) - 1)):
        if (gap[i] > 0) != (gap[i + 1] > 0):
            share = gap[i] / (gap[i] - gap[i + 1])
            low, high = both[i], both[i + 1]
            at = _between(low, high, share)
            return Crossing(**common, at=at, value=_between(a[low], a[high], share))
    return Crossing(**common, at=None, value=None)


def _between(low: float, high: float, share: float) -> float:
    """Interpolate between two numbers on a logarithmic axis."""
    return math.exp(math.log(low) + share * (math.log(high) - math.log(low)))
