"""The steps of ``gamba gpu-check``, and the time that each may take; imports nothing slow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

StepName = Literal[
    "compile", "checks", "inference", "tests", "bench", "peers-conv", "peers-scan", "peers-raster"
]
MINUTES = 8.0  # of the whole run


@dataclass(frozen=True)
class Step:
    """A part of the run.

    Attributes:
        name: "tests" runs pytest, all others ``steps.run_step``.
        seconds: time limit in a run of ``MINUTES``.
        cuda: whether a CPU leaves it out.
        packages: of which at least one is needed.
    """

    name: StepName
    seconds: float
    cuda: bool = False
    packages: tuple[str, ...] = ()


# What matters most comes first; together they may want more than the whole time.
STEPS = (
    Step("compile", 100, cuda=True),
    Step("checks", 100),
    Step("inference", 100),
    Step("tests", 90, cuda=True),
    Step("bench", 130),
    Step("peers-conv", 60, True, ("causal-conv1d",)),
    Step("peers-scan", 90, True, ("mamba-ssm", "mambapy")),
    Step("peers-raster", 480, True, ("gsplat", "gswarp")),  # gsplat compiles itself on first use
)
