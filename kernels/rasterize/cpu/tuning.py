"""Sizes and accuracy of the CPU's kernels: fixed for callers, and to be changed for a measurement.

A call of ``rasterization`` looks here once. What it finds goes with its lists to its gradient, so
nothing below ``function.py`` reads the choice in force. On CUDA there is one choice, see CUDA.md.
"""

from __future__ import annotations

import dataclasses
from contextlib import AbstractContextManager

from ...runtime.choice import Choice
from ..constants import TILE

BLOCK = 4  # pixels, side of the block whose pixels are lanes


@dataclasses.dataclass(frozen=True)
class Tuning:
    """A choice of the CPU's kernels; ``make study WHAT=raster`` has what each choice costs.

    Attributes:
        tile: side in pixels of the squares that have a list each, 8 or 16.
        width: of the sub-tiles that are tested against an ellipse, pixels: 4, 8 or 16.
        height: likewise.
        degree: of the polynomial for exp, 2 to 5; its relative error is at most 1.8e-3, 7.5e-5,
            2.6e-6 and 3e-7.
    """

    tile: int = TILE
    width: int = BLOCK
    height: int = BLOCK
    degree: int = 5

    def __post_init__(self) -> None:
        if self.tile not in (8, 16):
            raise ValueError(f"tile is {self.tile}, allowed are 8 and 16")
        for name in ("width", "height"):
            side = getattr(self, name)
            if side not in (4, 8, 16) or side > self.tile:
                raise ValueError(f"{name} is {side}, allowed are 4, 8 and 16, at most the tile")
        if not 2 <= self.degree <= 5:
            raise ValueError(f"degree is {self.degree}, allowed are 2 to 5")

    @property
    def columns(self) -> int:
        """Blocks in a row of a tile."""
        return self.tile // BLOCK

    @property
    def blocks(self) -> int:
        """Blocks of a tile."""
        return self.columns**2

    def numbers(self) -> list[int]:
        """The attributes in their order, for an operator; ``Tuning(*numbers)`` is the way back."""
        return [self.tile, self.width, self.height, self.degree]


_DEFAULT = Tuning()
_choice = Choice(_DEFAULT)


def current() -> Tuning:
    """The choice in force."""
    return _choice.value


def tuning_for(device: str) -> Tuning:
    """The choice in force, for a call on a type of device.

    Raises:
        ValueError: it is not the default, and the device is not a CPU.
    """
    tuning = current()
    if device != "cpu" and tuning.numbers() != _DEFAULT.numbers():
        raise ValueError(f"device is {device}: {tuning} is for a CPU")
    return tuning


def use_tuning(tuning: Tuning) -> AbstractContextManager[None]:
    """Every rasterization on the CPU that begins inside runs on ``tuning``, its gradient too.

    It holds for all threads of the process. On CUDA a call raises ``ValueError`` inside, unless it
    is the default.
    """
    return _choice.use(tuning)
