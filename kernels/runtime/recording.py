"""A dry run of launches on CUDA: they are told to a function instead of made.

The tensors may be fake, without memory: inside, ``views.py`` makes no views, and what is asked of
the device is answered for one that is imagined.
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


def multiprocessors_of(device: torch.device) -> int:
    """The number of multiprocessors of a CUDA device; of the imagined one in a dry run."""
    recorder = _recorder.get()
    if recorder is not None:
        return recorder.multiprocessors
    index = torch.cuda.current_device() if device.index is None else device.index
    return _properties(index).multi_processor_count


_properties = functools.cache(torch.cuda.get_device_properties)
