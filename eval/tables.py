"""Markdown tables of means or medians with their intervals, as all evaluations print them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

Lines = list[list[str]]  # cells by row, the head first


class Column(NamedTuple):
    """A column of figures.

    Attributes:
        title: heads it.
        digits: number of decimals.
    """

    title: str
    digits: int


class Row(NamedTuple):
    """A row of figures.

    Attributes:
        names: what stands before the figures.
        figures: by key, as ``averages.summary_of`` makes them, of which the intervals may lack;
            None where there is no such figure.
        signed: whether positive values get a plus sign, as differences have it.
    """

    names: Sequence[str]
    figures: Mapping[str, dict[str, Any] | None]
    signed: bool = False


def figures(
    head: Sequence[str], columns: Mapping[str, Column], rows: Iterable[Row], of: str = "mean"
) -> Lines:
    """The lines of a table of figures, for ``markdown``; "-" where a row has no such figure.

    Args:
        head: of the names.
        columns: by the figures' keys.
        rows: each with so many names.
        of: what is shown of each figure, "mean" or "median".
    """
    ends = {"mean": "interval", "median": "median_interval"}[of]
    lines = [[*head, *(column.title for column in columns.values())]]
    for row in rows:
        cells = []
        for key, column in columns.items():
            found = row.figures[key]
            shown = found and cell(found[of], found.get(ends), column.digits, row.signed)
            cells.append(shown or "-")
        lines.append([*row.names, *cells])
    return lines


def cell(
    value: float | None, interval: Sequence[float] | None, digits: int, signed: bool = False
) -> str:
    """``value [low, high]``; "absent" without a value, and no brackets without an interval.

    Args:
        value: a mean, a median or the like.
        interval: its ends.
        digits: number of decimals.
        signed: whether a positive value gets a plus sign.
    """
    if value is None:
        return "absent"
    ends = "" if interval is None else " [" + ", ".join(f"{x:.{digits}f}" for x in interval) + "]"
    return f"{value:{'+' if signed else ''}.{digits}f}{ends}"


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table whose columns are aligned in plain text too.

    Args:
        lines: cells by row, all rows of one length; the first row is the head.
    """
    widths = [max(map(len, column)) for column in zip(*lines)]
    texts = ["| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in lines]
    rule = "| " + " | ".join("-" * max(3, width) for width in widths) + " |"
    return "\n".join([texts[0], rule, *texts[1:]])
