"""Growth of time, memory and errors with a size: slopes on logarithmic axes, beside the work's.

A case with the axis "growth L" (or N, D, any parameter) has variants that only differ in this size;
their ``work`` counts ``units``, and their parameter ``unit`` describes these. A case with the axis
``ERRORS`` has variants over L whose ``work`` holds errors and bounds by name.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from gamba_warp.pages.charts import Axis, Point, Series, chart

from .crossing import FIGURES

GROWTH, ERRORS = "growth ", "growth of error"
BOUND = "ε"  # names of bounds begin with it
_DEARER = 1.1  # units that cost this much more at the greatest size are reported
_LEAST_BYTES = 2**23  # of less memory, the pages and slack of the heap are a part
_HEADER = ("direction", "dtype", "figure", "over", "slope", "of its work", "a unit's cost")

Line = Mapping[float, float]


class Growth(NamedTuple):
    """Growth of a figure of one direction with a size.

    Attributes:
        direction: of the records.
        dtype: of the records.
        figure: "time" or "memory".
        size: name of the parameter that grows.
        least: the smallest size measured.
        most: the greatest one.
        slope: exponent of the figure, least squares of its logarithms.
        unit: description of the units of its work.
        work_slope: exponent of the work, likewise.
        cheapest: size below ``most`` at which a unit of work costs least.
        dearer: cost of a unit at ``most`` over that at ``cheapest``.
        end_slopes: exponents of figure and work from ``cheapest`` to ``most``.
        faster: True if the figure grows faster than its work, beyond noise.
    """

    direction: str
    dtype: str
    figure: str
    size: str
    least: float
    most: float
    slope: float
    unit: str
    work_slope: float
    cheapest: float
    dearer: float
    end_slopes: tuple[float, float]
    faster: bool

    def text(self) -> str:
        """Describe in a sentence if the figure grows faster than its work."""
        where = f"{self.direction}, {self.dtype}, {self.figure} over {self.size}"
        if not self.faster:
            return f"{where} grows no faster than its work ({self.unit})."
        own, work = self.end_slopes
        return (
            f"{where} grows faster than its work ({self.unit}): from {self.cheapest:,.0f} to "
            f"{self.most:,.0f} its slope is {own:.2f} and that of the work {work:.2f}, so that one "
            f"costs {self.dearer:.2f} times as much."
        )


def slope(line: Line) -> float | None:
    """Fit the exponent of a power law to figures by size; None for fewer than two sizes.

    Args:
        line: figures > 0 by size > 0.
    """
    if len(line) < 2:
        return None
    x, y = [math.log(size) for size in line], [math.log(value) for value in line.values()]
    x0, y0 = sum(x) / len(x), sum(y) / len(y)
    spread = sum((a - x0) ** 2 for a in x)
    return sum((a - x0) * (b - y0) for a, b in zip(x, y)) / spread if spread else None


def growths(records: Iterable[dict]) -> list[Growth]:
    """The growth of time and memory of every direction and dtype of one case, where it is known."""
    made = []
    for key, part in _groups(records).items():
        for figure in FIGURES:
            found = _growth(key, part, figure)
            if found is not None:
                made.append(found)
    return made


def _groups(records: Iterable[dict]) -> dict[tuple[str, str, str], list[dict]]:
    """Measured records of a growth by direction, dtype and the name of the size."""
    found: dict[tuple[str, str, str], list[dict]] = {}
    for r in records:
        axis = r["axis"] or ""
        if axis.startswith(GROWTH) and axis != ERRORS and r["status"] == "ok":
            key = (r["direction"], r["dtype"], axis.removeprefix(GROWTH))
            found.setdefault(key, []).append(r)
    return found


def _by_size(records: Sequence[dict], size: str, figure: str) -> dict[float, float]:
    """A figure > 0 of records or of their work, by size."""
    line: dict[float, float] = {}
    for r in records:
        at, value = r["parameters"].get(size), r.get(figure) or r["work"].get(figure)
        if type(at) in (int, float) and at > 0 and value and value > 0:
            line[at] = value
    return dict(sorted(line.items()))


def _growth(key: tuple[str, str, str], records: list[dict], figure: str) -> Growth | None:
    direction, dtype, size = key
    values, work = (_by_size(records, size, name) for name in (figure, "units"))
    sizes = [s for s in values if s in work]
    values, work = {s: values[s] for s in sizes}, {s: work[s] for s in sizes}
    own, of_work = slope(values), slope(work)
    if own is None or of_work is None:
        return None
    *shorter, most = sizes
    cost = {s: math.log(values[s]) - math.log(work[s]) for s in sizes}
    cheapest = min(shorter, key=cost.__getitem__)
    dearer = _exp(cost[most] - cost[cheapest])
    ends = [slope({s: line[s] for s in (cheapest, most)}) or 0.0 for line in (values, work)]
    if figure == "ms_p50":
        apart = _apart(records, size, cheapest, most, dearer)
    else:
        apart = values[most] >= _LEAST_BYTES
    return Growth(
        *(direction, dtype, FIGURES[figure][0], size, sizes[0], most, own),
        *(str(records[0]["parameters"].get("unit", "units")), of_work, cheapest, dearer),
        (ends[0], ends[1]),
        dearer > _DEARER and apart,
    )


def _exp(x: float) -> float:
    """e^x, clamped for untrusted figures out of range."""
    return math.exp(max(-300.0, min(x, 300.0)))


def _apart(records: Sequence[dict], size: str, low: float, high: float, dearer: float) -> bool:
    """True if a unit costs more in the fast runs of one size than in the slow ones of another."""
    by_size = {r["parameters"].get(size): r for r in records}
    slow, fast = by_size[low], by_size[high]
    return dearer * (fast["ms_p20"] / fast["ms_p50"]) > slow["ms_p80"] / slow["ms_p50"]


def growth_lines(records: Sequence[dict]) -> list[str]:
    """Sentences on a case: each figure that grows faster than its work, and whether any other."""
    found = growths(records)
    faster = [g.text() for g in found if g.faster]
    if not found:
        return []
    if not faster:
        return ["Nothing here grows faster than its work."]
    return [*faster, "Nothing else here grows faster than its work."][: len(found)]


def growth_table(records: Sequence[dict]) -> tuple[list[str], list[list[str]]] | None:
    """Header and rows of the slopes, or of the errors, of one case; None if it has none."""
    if rows := _error_rows(records):
        return rows
    made = [
        [
            *(g.direction, g.dtype, g.figure, f"{g.size} {g.least:,.0f} to {g.most:,.0f}"),
            *(f"{g.slope:.2f}", f"{g.work_slope:.2f} ({g.unit})"),
            f"x {g.dearer:.2f} from {g.cheapest:,.0f} on" + (", faster" if g.faster else ""),
        ]
        for g in growths(records)
    ]
    return ([*_HEADER], made) if made else None


def growth_charts(records: Sequence[dict]) -> list[str]:
    """Draw time and memory of all directions against the size, and the work as a dashed line."""
    made = []
    parts = _groups(records)
    for dtype, size in dict.fromkeys(key[1:] for key in parts):
        mine = {key[0]: part for key, part in parts.items() if key[1:] == (dtype, size)}
        for figure, (_, label, scale) in FIGURES.items():
            lines = {name: _by_size(part, size, figure) for name, part in mine.items()}
            lines = {name: line for name, line in lines.items() if line}
            if not lines:
                continue
            drawn = [_series(name, line, scale) for name, line in lines.items()]
            name, first = next(iter(lines.items()))
            drawn += _guide(mine[name], size, first, scale)
            ticks = sorted({s for line in lines.values() for s in line})
            made.append(chart(drawn, Axis(f"{size}, {dtype}", values=ticks), Axis(label)))
    return made


def _guide(records: Sequence[dict], size: str, line: Line, scale: float) -> list[Series]:
    """The work, through the middle of a line so that slopes can be compared by eye."""
    work = _by_size(records, size, "units")
    both = [s for s in line if s in work]
    if not both:
        return []
    gap = sum(math.log(line[s]) - math.log(work[s]) for s in both) / len(both)
    unit = str(records[0]["parameters"].get("unit", "units"))
    return [_series(unit, work, scale * _exp(gap), "guide")]


def _series(name: str, line: Line, scale: float, kind: str = "straight") -> Series:
    fitted = slope(line)
    label = name if fitted is None else f"{name} {fitted:.2f}"
    return Series(label, [Point(x, scale * y) for x, y in line.items()], kind)


def _error_lines(records: Sequence[dict]) -> dict[str, dict[float, float]]:
    """Errors and bounds of a case by name, then by number of tokens."""
    found: dict[str, dict[float, float]] = {}
    for r in records:
        if r["axis"] == ERRORS and r["status"] == "ok":
            length = r["parameters"].get("L")
            for name, value in r["work"].items():
                if type(length) in (int, float) and length > 0 and value > 0:
                    found.setdefault(name, {})[length] = value
    return found


def error_charts(records: Sequence[dict]) -> list[str]:
    """Draw the errors of a case against the number of tokens, and their bounds as dashed lines."""
    lines = _error_lines(records)
    drawn = [
        Series(
            name,
            [Point(x, y) for x, y in sorted(line.items())],
            "guide" if name.startswith(BOUND) else "straight",
        )
        for name, line in lines.items()
    ]
    ticks = sorted({x for line in lines.values() for x in line})
    return [chart(drawn, Axis("tokens L", values=ticks), Axis("error"))] if drawn else []


def _error_rows(records: Sequence[dict]) -> tuple[list[str], list[list[str]]] | None:
    lines = _error_lines(records)
    if not lines:
        return None
    sizes = sorted({x for line in lines.values() for x in line})
    worst = {r["parameters"].get("L"): str(r["parameters"].get("worst", "")) for r in records}
    rows = []
    for size in sizes:
        cells = [f"{line[size]:.2g}" if size in line else "" for line in lines.values()]
        rows.append([f"{size:,.0f}", *cells, worst.get(size, "")])
    slopes = [slope(line) for line in lines.values()]
    rows.append(["slope", *("" if s is None else f"{s:.2f}" for s in slopes), ""])
    return ["L", *lines, "of"], rows
