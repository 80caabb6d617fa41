"""Markdown tables of means or medians with their intervals, as all evaluations print them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from gamba_warp.kernels.runtime.tables import cell as cell
from gamba_warp.kernels.runtime.tables import markdown as table

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


def markdown(lines: Lines) -> str:
    """A Markdown table of lines, aligned in plain text too."""
    return table(lines[0], lines[1:], aligned=True)


def latex(lines: Lines) -> str:
    """A LaTeX ``tabular`` of lines, with the rules of booktabs."""
    arrows = str.maketrans({"↑": r"$\uparrow$", "↓": r"$\downarrow$"})
    escaped = [
        [re.sub(r"([&%$#_{}])", r"\\\1", cell).translate(arrows) for cell in line] for line in lines
    ]
    head, *rows = (" & ".join(line) + r" \\" for line in escaped)
    columns = "l" + "r" * (len(lines[0]) - 1)
    parts = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", head, r"\midrule", *rows]
    return "\n".join([*parts, r"\bottomrule", r"\end{tabular}"]) + "\n"
