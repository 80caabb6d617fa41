"""Device of a tensor's work, and stand-ins for a GPU that take launches on CUDA.

In a dry run launches are only recorded: the tensors may be fake, without memory, so ``views.py``
makes no views. Any other stand-in executes launches on tensors of the CPU, for which the operators
then take their CUDA path. Queries of the device are answered for an imagined one.
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
class StandIn:
    """Receiver of launches in place of a GPU.

    Attributes:
        launch: called with the kernel, the dimensions of the launch, its arguments as Warp takes
            them, and the threads of a block; all is done when it returns.
        multiprocessors: of the imagined device.
        dry: True to only record launches.
    """

    launch: Callable[[wp.Kernel, tuple[int, ...], list, int], None]
    multiprocessors: int
    dry: bool = False


_stand_in: ContextVar[StandIn | None] = ContextVar("stand_in", default=None)

# That of this thread; None where a device makes launches.
stand_in: Callable[[], StandIn | None] = _stand_in.get


@contextmanager
def standing_in(new: StandIn | None) -> Iterator[None]:
    """Route this thread's CUDA launches to ``new`` within the block."""
    token = _stand_in.set(new)
    try:
        yield
    finally:
        _stand_in.reset(token)


def is_dry() -> bool:
    """True in a dry run."""
    return (other := stand_in()) is not None and other.dry


def kind_of(device: torch.device) -> str:
    """Device type whose kernels a tensor takes, "cpu" or "cuda" (or another type)."""
    return device.type if stand_in() is None or is_dry() else "cuda"


def multiprocessors_of(device: torch.device) -> int:
    """The number of multiprocessors of a CUDA device, or of the imagined one."""
    if (other := stand_in()) is not None:
        return other.multiprocessors
    index = torch.cuda.current_device() if device.index is None else device.index
    return _properties(index).multi_processor_count


_properties = functools.cache(torch.cuda.get_device_properties)
