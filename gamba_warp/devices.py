"""The device that a command computes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from .conventions import DeviceChoice
from .errors import UserError

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
