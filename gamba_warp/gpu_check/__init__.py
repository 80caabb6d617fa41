"""All that only a CUDA machine can tell, in one run of a few minutes: its steps and their time.

This module imports nothing slow.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

StepName = Literal[
    "compile", "checks", "inference", "bench", "peers-conv", "peers-scan", "peers-raster"
]
MINUTES = 8.0  # of the whole run


class Step(NamedTuple):
    """A part of the run.

    Attributes:
        name: of ``steps.run_step``.
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
    Step("bench", 130),
    Step("peers-conv", 60, True, ("causal-conv1d",)),
    Step("peers-scan", 90, True, ("mamba-ssm", "mambapy")),
    Step("peers-raster", 480, True, ("gsplat", "gswarp")),  # gsplat compiles itself on first use
)
