"""Sizes and accuracy of the CPU compositor: fixed for callers, overridable to be measured.

The tile is that of the lists too. On CUDA there is one choice, see CUDA.md.
"""

from __future__ import annotations

import dataclasses
from contextlib import AbstractContextManager

from ...runtime.choice import Choice
from ..constants import TILE

BLOCK = 4  # pixels, side of the block whose pixels are lanes


@dataclasses.dataclass(frozen=True)
class Variant:
    """A choice of kernels; ``gamba bench raster`` has what each choice costs.

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


_choice = Choice(Variant())


def current() -> Variant:
    """What the rasterizer runs on now."""
    return _choice.value


def use_variant(variant: Variant) -> AbstractContextManager[None]:
    """Every rasterization on the CPU runs on ``variant`` inside; a gradient must as its forward.

    It holds for all threads of the process: autograd may compute gradients on threads of its own.
    On CUDA a call raises ``ValueError`` inside, unless it is the default variant.
    """
    return _choice.use(variant)
