"""Launches on CUDA where there is no GPU: told to a function in a dry run, or executed by another.

In a dry run the tensors may be fake, without memory: inside, ``views.py`` makes no views, and what
is asked of the device is answered for one that is imagined. A stand-in executes what CUDA would,
on tensors of the CPU: inside, the operators take their CUDA path for these.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import torch
import warp as wp


@dataclass(frozen=True)
class Recorder:
    """Who is told of the launches.

    Attributes:
        note: called with the kernel, the dimensions of the launch and the threads of a block.
        multiprocessors: of the imagined device.
    """

    note: Callable[[wp.Kernel, tuple[int, ...], int], None]
    multiprocessors: int


@dataclass(frozen=True)
class StandIn:
    """Who executes the launches, on tensors of the CPU.

    Attributes:
        launch: called with the kernel, the dimensions of the launch, its arguments as Warp takes
            them, and the threads of a block; returns when all is done.
        multiprocessors: of the imagined device.
    """

    launch: Callable[[wp.Kernel, tuple[int, ...], list, int], None]
    multiprocessors: int


stand_in: ContextVar[StandIn | None] = ContextVar("stand_in", default=None)
_recorder: ContextVar[Recorder | None] = ContextVar("recorder", default=None)


# The recorder of this thread; None where launches are made. Each view of a tensor asks it, so it is
# the variable's own method, without a call of Python's around it.
recorder: Callable[[], Recorder | None] = _recorder.get


@contextmanager
def recording(recorder: Recorder) -> Iterator[None]:
    """Inside, in this thread, launches on CUDA are only told to ``recorder``."""
    token = _recorder.set(recorder)
    try:
        yield
    finally:
        _recorder.reset(token)


def kind_of(device: torch.device) -> str:
    """Which kernels work on a device's tensors, "cpu" or "cuda" (or else the device's type)."""
    return device.type if stand_in.get() is None else "cuda"


def multiprocessors_of(device: torch.device) -> int:
    """The number of multiprocessors of a CUDA device; of the imagined one in a dry run."""
    if (imagined := _recorder.get() or stand_in.get()) is not None:
        return imagined.multiprocessors
    index = torch.cuda.current_device() if device.index is None else device.index
    return _properties(index).multi_processor_count


_properties = functools.cache(torch.cuda.get_device_properties)
