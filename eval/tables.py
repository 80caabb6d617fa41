"""Markdown tables of means or medians with their intervals, as both evaluations print them."""

from __future__ import annotations

from collections.abc import Sequence


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
