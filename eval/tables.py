"""Markdown tables of means or medians with intervals, shared by all evaluations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from gamba_warp.image_metrics import Metric
from gamba_warp.kernels.runtime.tables import cell
from gamba_warp.kernels.runtime.tables import markdown as table

Lines = list[list[str]]  # cells by row, the head first


class Column(NamedTuple):
    """A column of figures.

    Attributes:
        title: its heading.
        digits: number of decimals.
    """

    title: str
    digits: int


def columns_of(metrics: Mapping[str, Metric]) -> dict[str, Column]:
    """Return the columns of image metrics, by their keys."""
    return {key: Column(metric.head, metric.digits) for key, metric in metrics.items()}


class Row(NamedTuple):
    """A row of figures.

    Attributes:
        names: cells before the figures.
        figures: by key, as from ``averages.summary_of``, intervals optional; None if missing.
        signed: positive values get a plus sign, for differences.
    """

    names: Sequence[str]
    figures: Mapping[str, dict[str, Any] | None]
    signed: bool = False


def figures(
    head: Sequence[str], columns: Mapping[str, Column], rows: Iterable[Row], of: str = "mean"
) -> Lines:
    """Return the lines of a table of figures, for ``markdown``; "-" for a missing figure.

    Args:
        head: titles of the names.
        columns: by the figures' keys.
        rows: each with as many names as ``head``.
        of: statistic shown, "mean" or "median".
    """
    ends = {"mean": "interval", "median": "median_interval"}[of]
    lines = [[*head, *(column.title for column in columns.values())]]
    for row in rows:
        cells = []
        for key, column in columns.items():
            figure = row.figures.get(key)
            shown = figure and cell(figure[of], figure.get(ends), column.digits, row.signed)
            cells.append(shown or "-")
        lines.append([*row.names, *cells])
    return lines


def markdown(lines: Lines) -> str:
    """Format lines as a Markdown table, aligned in plain text too."""
    return table(lines[0], lines[1:], aligned=True)
