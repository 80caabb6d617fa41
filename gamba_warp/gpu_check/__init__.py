"""Steps and time limits of ``gamba gpu-check``, the checks that need a CUDA machine.

This module imports nothing slow.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

StepName = Literal["checks", "inference", "bench", "peers-conv", "peers-scan", "peers-raster"]
MINUTES = 8.0  # of the whole run


class Step(NamedTuple):
    """A part of the run.

    Attributes:
        name: of ``check.run_step``.
        seconds: time limit in a run of ``MINUTES``, compilation included.
        packages: at least one is needed, with CUDA.
    """

    name: StepName
    seconds: float
    packages: tuple[str, ...] = ()


# In order of importance; together they may exceed the total time.
STEPS = (
    Step("checks", 160),
    Step("inference", 110),
    Step("bench", 160),
    Step("peers-conv", 60, ("causal-conv1d",)),
    Step("peers-scan", 90, ("mamba-ssm", "mambapy")),
    Step("peers-raster", 480, ("gsplat", "gswarp")),  # gsplat compiles on first use
)
