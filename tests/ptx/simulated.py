"""A GPU simulated by functions: operators on tensors of the CPU then take their CUDA path."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
import warp as wp

from gamba_warp.kernels.runtime import gpu, launch

# Called with a kernel, the dimensions of its launch, the arguments as Warp takes them, the threads
# of a block, and the device; all is done when it returns.
Launch = Callable[[wp.Kernel, tuple[int, ...], list, int, torch.device], None]

_NAMES = (gpu, "kind_of"), (gpu, "multiprocessors_of"), (launch, "launch_on_stream")
_REAL = tuple(getattr(*name) for name in _NAMES)


@contextmanager
def _replaced(functions: tuple[Callable, ...]) -> Iterator[None]:
    before = [getattr(*name) for name in _NAMES]
    try:
        for name, function in zip(_NAMES, functions):
            setattr(*name, function)
        yield
    finally:
        for name, function in zip(_NAMES, before):
            setattr(*name, function)


def simulated(launch_on: Launch, multiprocessors: int):
    """Route all launches to ``launch_on`` within the block."""
    return _replaced((lambda device: "cuda", lambda device: multiprocessors, launch_on))


def not_simulated():
    """Take each tensor's own device again within the block."""
    return _replaced(_REAL)


def is_simulated() -> bool:
    """Return True within the block of ``simulated``."""
    return gpu.kind_of is not _REAL[0]
