"""Sizes and accuracy of the CPU scan's kernels: fixed for callers, overridable to be measured."""

from __future__ import annotations

import dataclasses
from contextlib import AbstractContextManager

from ...runtime.choice import Choice


@dataclasses.dataclass(frozen=True)
class Variant:
    """A choice of kernels; ``gamba bench scan`` has what each choice costs.

    Attributes:
        chunk: tokens between saved states, which the gradient walks at once; a multiple of
            8 and of ``strip``.
        strip: tokens that the forward walks at once for one state.
        degree: of the polynomial for the decays' 2^x, 2 to 6; the relative error of a decay is
            at most 2e-3, 1e-4, 3e-6, 3e-7 and 7.5e-9.
    """

    chunk: int = 64
    strip: int = 64
    degree: int = 5

    def __post_init__(self) -> None:
        if self.strip < 1 or self.chunk < 8 or self.chunk % 8 or self.chunk % self.strip:
            raise ValueError(
                f"chunk is {self.chunk}, strip is {self.strip}; "
                "chunk must be a multiple of 8 and of strip"
            )
        if not 2 <= self.degree <= 6:
            raise ValueError(f"degree is {self.degree}, allowed are 2 to 6")


_choice = Choice(Variant())


def current() -> Variant:
    """What a scan on the CPU runs on now."""
    return _choice.value


def use_variant(variant: Variant) -> AbstractContextManager[None]:
    """Every scan on the CPU runs on ``variant`` inside; a gradient must run inside as its forward.

    It holds for all threads of the process: autograd may compute gradients on threads of its own.
    """
    return _choice.use(variant)
