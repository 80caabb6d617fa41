"""Random and hostile cases of the operators, compared with float64, for ``gamba stress``."""

from .core.case import DTYPES, Case, Comparison, Op, Outcome, generator, judge, run_case
from .core.report import (
    FORMAT,
    document,
    failure_text,
    markdown,
    read_reproducer,
    reproducer,
    table,
)
from .core.runner import Row, Tally, draw_cases, run_cases, shrink

__all__ = [
    "DTYPES",
    "FORMAT",
    "Case",
    "Comparison",
    "Op",
    "Outcome",
    "Row",
    "Tally",
    "document",
    "draw_cases",
    "failure_text",
    "generator",
    "judge",
    "markdown",
    "read_reproducer",
    "reproducer",
    "run_case",
    "run_cases",
    "shrink",
    "table",
]
