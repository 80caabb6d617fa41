"""The device that a command computes on, and how it shares the cores."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from .conventions import DeviceChoice
from .errors import UserError
from .kernels.runtime.system import cores

if TYPE_CHECKING:
    import torch


def pick_device(name: DeviceChoice) -> torch.device:
    """The device of the option ``--device``.

    Args:
        name: ``auto`` is CUDA where there is a device, else the CPU.

    Raises:
        UserError: CUDA is asked for and is not there.
    """
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: no CUDA device is available")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def share_cores() -> None:
    """Lets threads that wait sleep at once, where other programs use the cores too.

    By default the threads of torch's CPU operators turn in a loop for milliseconds while they wait
    for each other. Where a core is not free, that takes the time of the thread that is waited for:
    a mesh took five times as long beside a training on two cores (docs/pace.md). It must be called
    before torch is imported, and leaves what the user has set as it is.
    """
    chosen = {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & {*os.environ}
    if chosen or "torch" in sys.modules or not hasattr(os, "getloadavg"):
        return
    if os.getloadavg()[0] > 0.5 * cores():
        os.environ["GOMP_SPINCOUNT"] = "1000"


@contextmanager
def full_products() -> Iterator[None]:
    """Matrix products of float32 keep all digits inside, whatever the process lets a GPU round to.

    It holds for what is computed inside, and so for no backward pass that autograd runs later.
    """
    import torch

    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
