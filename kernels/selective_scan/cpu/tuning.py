"""Sizes and accuracy of the CPU scan's kernels: fixed for callers, overridable to be measured."""

from __future__ import annotations

import dataclasses
from contextlib import AbstractContextManager

from ...runtime.choice import Choice

FEW = 8  # states up to which the memory, and not the arithmetic, sets the time


@dataclasses.dataclass(frozen=True)
class Tuning:
    """A choice of kernels; ``make study WHAT=scan`` has what each choice costs.

    Attributes:
        chunk: tokens between saved states, which the gradient walks at once; a multiple of
            8 and of ``strip``.
        strip: tokens that the forward walks at once for one state.
        degree: of the polynomial for the decays' 2^x, 2 to 6; the relative error of a decay is
            at most 2e-3, 1e-4, 3e-6, 3e-7 and 7.5e-9.
        table: whether a table of 16 and a cubic make 2^x in place of the polynomial where the
            processor has AVX-512; the relative error of a decay is then at most 6e-8.
        walked: states that the forward walks at once; 0 for what suits their number.
        walked_back: states that the gradient walks at once.
    """

    chunk: int = 64
    strip: int = 32
    degree: int = 5
    table: bool = True
    walked: int = 0
    walked_back: int = 4

    def __post_init__(self) -> None:
        if self.strip < 1 or self.chunk < 8 or self.chunk % 8 or self.chunk % self.strip:
            raise ValueError(
                f"chunk is {self.chunk}, strip is {self.strip}; "
                "chunk must be a multiple of 8 and of strip"
            )
        if self.walked < 0 or self.walked_back < 1:
            raise ValueError(
                f"walked is {self.walked}, walked_back is {self.walked_back}; "
                "allowed are 0 and more, and 1 and more"
            )
        if not 2 <= self.degree <= 6:
            raise ValueError(f"degree is {self.degree}, allowed are 2 to 6")

    def forward(self, states: int) -> Tuning:
        """The choice for the forward of so many states, without zeros.

        A walk fetches one tensor's rows of the next strip, so few states need shorter walks. The
        number of states of a walk changes no bit of a result, a strip's length does.
        """
        return dataclasses.replace(self, walked=self.walked or (2 if states <= FEW else 4))

    def numbers(self) -> list[int]:
        """The fields in their order, as the operators take them: ``Tuning(*numbers)`` is equal."""
        return [self.chunk, self.strip, self.degree, int(self.table), self.walked, self.walked_back]


_choice = Choice(Tuning())


def current() -> Tuning:
    """The tuning that a scan on the CPU gets if it begins now."""
    return _choice.value


def use_tuning(tuning: Tuning) -> AbstractContextManager[None]:
    """Every scan on the CPU that begins inside runs on ``tuning``, and so does its gradient.

    It holds for all threads of the process. A gradient may run later: it has the tuning of its
    forward.
    """
    return _choice.use(tuning)
