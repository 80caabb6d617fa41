"""The kernels that a device takes, and the size of a GPU.

Tests without a GPU replace these functions, and ``launch.launch_on_stream``.
"""

from __future__ import annotations

import functools

import torch


def kind_of(device: torch.device) -> str:
    """Device type whose kernels a tensor takes, "cpu" or "cuda" (or another type)."""
    return device.type


def multiprocessors_of(device: torch.device) -> int:
    """The number of multiprocessors of a CUDA device."""
    index = torch.cuda.current_device() if device.index is None else device.index
    return _properties(index).multi_processor_count


_properties = functools.cache(torch.cuda.get_device_properties)
