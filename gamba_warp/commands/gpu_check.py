"""``gamba gpu-check``: all that only a CUDA machine can tell, in one run of a few minutes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from ..gpu_check import MINUTES, StepName
from ..untrusted.ranges import Minutes, ranged


@ranged
def gpu_check_command(
    *,
    device: Literal["cuda", "cpu"] = "cuda",
    quick: bool = False,
    out: Path = Path("out/gpu-check"),
    minutes: Minutes = MINUTES,
    steps: tuple[StepName, ...] = (),
) -> int:
    """Runs kernel checks, full-size inference and the benchmark on this machine.

    Writes gpu-check.json and gpu-check.md after every item, and says what it could not do. The
    exit code is 0 if all that could be run passed, 1 if something failed, 2 without a CUDA device.

    Args:
        device: "cpu" tries the command itself, with --quick in seconds.
        quick: Use tiny sizes.
        out: Folder for the results.
        minutes: Time limit of the whole run.
        steps: Steps to take; all if not given.
    """
    from ..gpu_check.check import run_gpu_check

    return run_gpu_check(device, quick, out, minutes, steps)
