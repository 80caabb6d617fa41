"""Which CUDA kernels a shape runs on: chosen by a small model of the machine, visible, overridable.

One pass over the whole sequence computes each exponential once, but gives the machine only
batch x channels to do at once. Cut into segments, all run at once, and each but the last is walked
twice: first from zero for what it adds, then from its right state.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from contextlib import AbstractContextManager

import torch

from ...runtime.choice import Choice
from ...runtime.recording import multiprocessors_of
from .blocks import MARK, block_shape

MOST_SEGMENTS = 256  # the carry between them is serial
RESIDENT = (3, 2)  # blocks of a multiprocessor, by their registers: forward, gradient
OVERHEAD = 16  # tokens


@dataclasses.dataclass(frozen=True)
class Tuning:
    """A choice of kernels; results differ between choices by rounding only.

    Attributes:
        segments: of the sequence in the forward, at most; 1 is one launch, more are three.
        channels: of a thread in the forward.
        states: of a thread in the forward; 16 / states threads share a channel.
        back_segments: as ``segments``, of the gradient.
        back_channels: as ``channels``, of the gradient.
        back_states: as ``states``, of the gradient.
        block: threads of a block, a multiple of 32.
    """

    segments: int = 1
    channels: int = 2
    states: int = 4
    back_segments: int = 1
    back_channels: int = 2
    back_states: int = 4
    block: int = 128

    def numbers(self) -> list[int]:
        """The fields in their order, as the operators take them: ``Tuning(*numbers)`` is equal."""
        forward = [self.segments, self.channels, self.states]
        return [*forward, self.back_segments, self.back_channels, self.back_states, self.block]


_choice: Choice[Tuning | None] = Choice(None)


def current() -> Tuning | None:
    """The tuning that ``use_tuning`` asks for; None where the shape decides."""
    return _choice.value


def use_tuning(tuning: Tuning) -> AbstractContextManager[None]:
    """Every scan on CUDA that begins inside runs on ``tuning``, and so does its gradient.

    It holds for all threads of the process. A gradient may run later: it has the tuning of its
    forward.
    """
    return _choice.use(tuning)


@functools.cache
def choose(
    batch: int, length: int, channels: int, states: int, groups: int, multiprocessors: int
) -> Tuning:
    """The tuning for a shape on a device of so many multiprocessors.

    The model: a multiprocessor holds ``RESIDENT`` blocks at a time, and k blocks at once take
    k + 1/2 times as long as one would take at its full rate. P segments are walked (2 - 1/P) times
    in the forward; the gradient's walks are longer, so that they cost (4 - 1/P) / 3. Beginning
    and ending a segment costs as much as ``OVERHEAD`` tokens. No GPU has timed it.
    """
    tuning = Tuning()
    if not batch or not length:
        return tuning
    units = -(-length // MARK)

    def segments(per_thread: tuple[int, int], resident: int, walks: float) -> int:
        shape = block_shape(tuning.block, *per_thread, states)
        blocks = batch * groups * -(-(channels // groups) // shape.span)

        def cost(count: int) -> float:
            load = -(-blocks * count // multiprocessors)
            rounds = -(-load // resident)
            work = (walks + 1 - 1 / count) / walks / count
            return work * (load + 0.5 * rounds) * (1 + OVERHEAD * count / length)

        return min(range(1, min(units, MOST_SEGMENTS) + 1), key=cost)

    return dataclasses.replace(
        tuning,
        segments=segments((tuning.channels, tuning.states), RESIDENT[0], 1.0),
        back_segments=segments((tuning.back_channels, tuning.back_states), RESIDENT[1], 3.0),
    )


def scan_tuning(
    shape: Sequence[int],
    states: int,
    groups: int,
    device: torch.device,
    numbers: Sequence[int] = (),
) -> Tuning:
    """The tuning that a scan runs on.

    On a CPU, where only tests run these kernels, it is the default one, without segments.

    Args:
        shape: of u, ``[B, L, D]``.
        states: N.
        groups: G.
        device: of the tensors.
        numbers: of the tuning that was asked for; if empty, the shape decides.
    """
    if numbers:
        return Tuning(*numbers)
    if device.type != "cuda":
        return Tuning()
    return choose(*shape, states, groups, multiprocessors_of(device))
