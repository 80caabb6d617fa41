"""Capacity of the lists in CUDA graphs, which cannot wait for their number of pairs.

Any other call reads its number of pairs back and allocates as many. A graph allocates half as many
again as the last call of its shape needed; each replay copies its count to the host. A replay with
more pairs gives images of NaN, so that a training step skips them, and ``lists_outgrown`` is True.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..tiles import MAX_PAIRS

_SLOTS = 4096  # shapes remembered; beyond these, the oldest are dropped


@dataclass
class _Shape:
    """A shape of calls: where its last count is, and the least capacity of its graphs."""

    slot: int
    in_graph: int | None = None


class _Counts:
    """Last counts of a device, ``[slots]`` int64 of the host, and the shapes, the oldest first."""

    def __init__(self, device: torch.device):
        pinned = device.type == "cuda"
        self.tensor = torch.zeros(_SLOTS, dtype=torch.int64, pin_memory=pinned)
        self.on_host = self.tensor.numpy()  # torch might wait for the device
        self.shapes: dict[Hashable, _Shape] = {}

    def outgrown(self, shape: _Shape) -> bool:
        """Return True if the last count of a shape exceeds what a graph of it allocated."""
        return shape.in_graph is not None and self.on_host[shape.slot] > shape.in_graph


_counts: dict[torch.device, _Counts] = {}
_lock = threading.Lock()


def is_capturing(device: torch.device) -> bool:
    """Return True if torch's current stream is being captured into a CUDA graph."""
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def note_count(key: Hashable, device: torch.device, count: int) -> None:
    """Remember the count of a call, for a graph of its shape."""
    with _lock:
        if device not in _counts:
            _counts[device] = _Counts(device)
        counts = _counts[device]
        shape = counts.shapes.get(key)
        if shape is None:
            slot = len(counts.shapes)
            if slot == _SLOTS:
                slot = counts.shapes.pop(next(iter(counts.shapes))).slot
            shape = counts.shapes[key] = _Shape(slot)
        counts.on_host[shape.slot] = count


def graph_capacity(key: Hashable, count: Tensor) -> int:
    """Return the capacity of a graph that is being captured, and capture the copy of its count.

    Raises:
        RuntimeError: no call of this shape was made before.
    """
    counts = _counts.get(count.device)
    if counts is None or key not in counts.shapes:
        raise RuntimeError(
            "a CUDA graph cannot capture shapes that were never rendered: run the same "
            "call once before the capture, as torch requires of all captured work"
        )
    shape = counts.shapes[key]
    last = int(counts.on_host[shape.slot])
    pairs = min(MAX_PAIRS, last + last // 2)
    shape.in_graph = pairs if shape.in_graph is None else min(pairs, shape.in_graph)
    counts.tensor[shape.slot : shape.slot + 1].copy_(count, non_blocking=True)
    return pairs


def lists_outgrown() -> bool:
    """Return True if a captured CUDA graph has more pairs than its capacity: its images are NaN.

    A new capture of the same shapes has the capacity. This does not wait for the device, whose
    counts may be some replays older or newer.
    """
    return any(c.outgrown(shape) for c in _counts.values() for shape in c.shapes.values())


def forget_graphs() -> None:
    """Forget the capacities of all CUDA graphs, which are about to be captured again."""
    for counts in _counts.values():
        for shape in counts.shapes.values():
            shape.in_graph = None


def clear() -> None:
    """Drop all shapes, for tests; CUDA graphs keep writing to their slots."""
    for counts in _counts.values():
        counts.shapes.clear()
