"""Capacity of the lists on CUDA, remembered by shape so that no call waits for its number of pairs.

The first call of a shape reads its number of pairs back. Later calls allocate the capacity that
earlier ones needed; the device copies their counts into pinned memory, which the host reads without
waiting. A count over the capacity is allowed: see ``composite_unlisted``. Images and gradients
have the same bits for any capacity, so it does not matter when a count arrives.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable
from dataclasses import dataclass
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.stand_in import is_dry

wp.set_module_options({"enable_backward": False})

_SLOTS = 4096  # shapes remembered; beyond these, the oldest are dropped
_MAX_PAIRS = 2**31 - 1  # pairs are numbered in int32


@dataclass
class Capacity:
    """Capacity remembered for a shape.

    Attributes:
        slot: index of its count in ``_Counts``.
        pairs: number of pairs that the next call allocates.
        in_graph: the least number that a CUDA graph allocates; None without one.
    """

    slot: int
    pairs: int
    in_graph: int | None = None


class _Counts:
    """The counts of a device, one per shape.

    Attributes:
        on_device: ``[slots]`` int64, the largest recent count.
        on_host: its copy, written by the device asynchronously.
        shapes: the capacity of each shape, the oldest first.
    """

    def __init__(self, device: torch.device):
        pinned = device.type == "cuda" and not is_dry()
        self.on_device = torch.zeros(_SLOTS, dtype=torch.int64, device=device)
        self.on_host = torch.zeros(_SLOTS, dtype=torch.int64, pin_memory=pinned)
        self.shapes: dict[Hashable, Capacity] = {}

    def latest(self, slot: int) -> int:
        """Return the last count copied; numpy reads memory, torch might wait for the device."""
        return int(self.on_host.numpy()[slot])


_counts: dict[torch.device, _Counts] = {}
_lock = threading.Lock()


@wp.kernel
@no_type_check
def _note(
    offset: wp.int32, slot: wp.int32, count_in: wp.array[wp.int64], highs_out: wp.array[wp.int64]
):
    # a large count decays slowly: it halves in 45 calls
    high = highs_out[slot]
    highs_out[slot] = wp.max(high - high / wp.int64(64), count_in[0])


def rounded_up(number: int) -> int:
    """Return the next number with four significant bits, at most an eighth larger."""
    step = 1 << max(0, number.bit_length() - 4)
    return -(-number // step) * step


def with_reserve(count: int) -> int:
    """Return the capacity for a count: half as many pairs again, rounded up."""
    return min(_MAX_PAIRS, rounded_up(count + count // 2))


def is_capturing(device: torch.device) -> bool:
    """Return True if torch's current stream is being captured into a CUDA graph."""
    return device.type == "cuda" and not is_dry() and torch.cuda.is_current_stream_capturing()


def find(key: Hashable, device: torch.device) -> Capacity | None:
    """Return the capacity of a shape, adapted to recent counts; None for an unknown shape."""
    counts = _counts.get(device)
    capacity = counts.shapes.get(key) if counts is not None else None
    if counts is None or capacity is None:
        return None
    count = counts.latest(capacity.slot)
    if count > _MAX_PAIRS:  # no list can hold them, so the present capacity stays
        return capacity
    fitting = with_reserve(count)
    if capacity.pairs < fitting and 4 * capacity.pairs < 5 * count or capacity.pairs > 4 * fitting:
        capacity.pairs = fitting
    return capacity


def add_graph(capacity: Capacity, pairs: int) -> None:
    """Record the number of pairs that a CUDA graph allocates."""
    capacity.in_graph = pairs if capacity.in_graph is None else min(pairs, capacity.in_graph)


def add_shape(key: Hashable, device: torch.device, count: int) -> Capacity:
    """Add a shape whose count was read back."""
    if is_dry():  # a dry run has no memory and leaves nothing behind
        return Capacity(0, with_reserve(count))
    with _lock:
        if device not in _counts:
            _counts[device] = _Counts(device)
        counts = _counts[device]
        if len(counts.shapes) < _SLOTS:
            slot = len(counts.shapes)
        else:
            slot = counts.shapes.pop(next(iter(counts.shapes))).slot
        counts.on_device[slot].fill_(count)
        counts.on_host.numpy()[slot] = count
        if device.type == "cuda":  # the next call may be on another stream
            torch.cuda.current_stream(device).synchronize()
        capacity = counts.shapes[key] = Capacity(slot, with_reserve(count))
    return capacity


def add_count(capacity: Capacity, count: Tensor) -> None:
    """Add a count, ``[1]`` int64, on the device and copy the result to the host asynchronously."""
    dry = is_dry()
    counts = _Counts(count.device) if dry else _counts[count.device]
    launch(_note, 1, [capacity.slot, count], [counts.on_device], count.device)
    if not dry:
        part = slice(capacity.slot, capacity.slot + 1)
        counts.on_host[part].copy_(counts.on_device[part], non_blocking=True)


def lists_outgrown() -> bool:
    """Return True if a captured CUDA graph has a capacity below its recent counts.

    Its images and gradients are still right, but slow. A new capture of the same shapes has the
    capacity. This does not wait for the device, whose counts may be some replays older or newer.
    """
    shapes = [(counts, shape) for counts in _counts.values() for shape in counts.shapes.values()]
    return any(s.in_graph is not None and c.latest(s.slot) > s.in_graph for c, s in shapes)


def forget_graphs() -> None:
    """Forget the capacities of all CUDA graphs, which are about to be captured again."""
    for counts in _counts.values():
        for capacity in counts.shapes.values():
            capacity.in_graph = None


def clear() -> None:
    """Drop all shapes, for tests; CUDA graphs keep writing to their slots."""
    for counts in _counts.values():
        counts.shapes.clear()
