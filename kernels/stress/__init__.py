"""Random and hostile cases of the operators, compared with float64, for ``gamba stress``."""

from .core.case import Case, Op, Option, Outcome, Runs, generator, run_case
from .core.report import read_reproducer, reproducer
from .core.runner import draw_cases, shrink

__all__ = [
    "Case",
    "Op",
    "Option",
    "Outcome",
    "Runs",
    "draw_cases",
    "generator",
    "read_reproducer",
    "reproducer",
    "run_case",
    "shrink",
]
