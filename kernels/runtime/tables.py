"""Tables in Markdown, and the cells of figures with their intervals."""

from __future__ import annotations

from collections.abc import Sequence


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]], aligned: bool = False) -> str:
    """A table in Markdown; a ``|`` and a line end inside a cell are escaped.

    Args:
        header: names of the columns.
        rows: cells of each row, as many as there are columns.
        aligned: True to align the columns in plain text too.
    """
    escapes = str.maketrans({"|": "\\|", "\n": "\\n"})
    lines = [[cell.translate(escapes) for cell in line] for line in (header, *rows)]
    widths = [max(map(len, column)) if aligned else 0 for column in zip(*lines)]
    lines.insert(1, ["-" * max(3, width) for width in widths])
    return "\n".join("| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in lines)


def cell(
    value: float | None, interval: Sequence[float] | None, digits: int, signed: bool = False
) -> str:
    """``value [low, high]``; "absent" without a value, and no brackets without an interval.

    Args:
        value: a mean, a median or the like.
        interval: its ends.
        digits: number of decimals.
        signed: True to give a positive value a plus sign.
    """
    if value is None:
        return "absent"
    ends = "" if interval is None else " [" + ", ".join(f"{x:.{digits}f}" for x in interval) + "]"
    return f"{value:{'+' if signed else ''}.{digits}f}{ends}"
