"""Which CUDA kernels a shape runs on: chosen by a small model of the machine, visible, overridable.

One pass over the whole sequence computes each exponential once, but gives the machine only
batch x channels to do at once. Cut into pieces, all run at once, and each but the last is walked
twice: first from zero for what it adds, then from its right state.
"""

from __future__ import annotations

import dataclasses
import functools
from contextlib import AbstractContextManager

import torch

from ...runtime.choice import Choice
from .blocks import MARK, frame

MOST_PIECES = 256  # the carry between them is serial
RESIDENT = (3, 2)  # blocks of a multiprocessor, by their registers: forward, gradient
OVERHEAD = 16  # tokens


@dataclasses.dataclass(frozen=True)
class Variant:
    """A choice of kernels; results differ between variants by rounding only.

    Attributes:
        pieces: of the sequence in the forward, at most; 1 is one launch, more are three.
        channels: of a thread in the forward.
        states: of a thread in the forward; 16 / states threads share a channel.
        back_pieces: as ``pieces``, of the gradient.
        back_channels: as ``channels``, of the gradient.
        back_states: as ``states``, of the gradient.
        block: threads of a block, a multiple of 32.
    """

    pieces: int = 1
    channels: int = 2
    states: int = 4
    back_pieces: int = 1
    back_channels: int = 2
    back_states: int = 4
    block: int = 128


_choice: Choice[Variant | None] = Choice(None)


def use_variant(variant: Variant) -> AbstractContextManager[None]:
    """Every scan on CUDA runs on ``variant`` inside; the gradient, where it runs inside.

    It holds for all threads of the process: autograd computes gradients on threads of its own.
    """
    return _choice.use(variant)


@functools.cache
def _multiprocessors(index: int) -> int:
    return torch.cuda.get_device_properties(index).multi_processor_count


@functools.cache
def choose(
    batch: int, length: int, channels: int, states: int, groups: int, multiprocessors: int
) -> Variant:
    """The variant for a shape on a device of so many multiprocessors.

    The model: a multiprocessor holds ``RESIDENT`` blocks at a time, and k blocks at once take
    k + 1/2 times as long as one would take at its full rate. P pieces are walked (2 - 1/P) times
    in the forward; the gradient's walks are longer, so that they cost (4 - 1/P) / 3. Beginning
    and ending a piece costs as much as ``OVERHEAD`` tokens. No GPU has timed it.
    """
    variant = Variant()
    if not batch or not length:
        return variant
    units = -(-length // MARK)

    def pieces(per_thread: tuple[int, int], resident: int, walks: float) -> int:
        f = frame(variant.block, *per_thread, states)
        blocks = batch * groups * -(-(channels // groups) // f.span)

        def cost(count: int) -> float:
            load = -(-blocks * count // multiprocessors)
            rounds = -(-load // resident)
            work = (walks + 1 - 1 / count) / walks / count
            return work * (load + 0.5 * rounds) * (1 + OVERHEAD * count / length)

        return min(range(1, min(units, MOST_PIECES) + 1), key=cost)

    return dataclasses.replace(
        variant,
        pieces=pieces((variant.channels, variant.states), RESIDENT[0], 1.0),
        back_pieces=pieces((variant.back_channels, variant.back_states), RESIDENT[1], 3.0),
    )


def scan_variant(shape: tuple, states: int, groups: int, device: torch.device) -> Variant:
    """The variant that a scan of u ``[B, L, D]`` with N states and G groups runs on.

    On a CPU, where only tests run these kernels, the default one without pieces.
    """
    if _choice.value is not None:
        return _choice.value
    if device.type != "cuda":
        return Variant()
    index = torch.cuda.current_device() if device.index is None else device.index
    return choose(*shape, states, groups, _multiprocessors(index))
