"""What is wrong with a result: too far from another one, or other bits."""

from __future__ import annotations

from torch import Tensor

from ..kernels.bench import Error


def within(error: Error, limit: float) -> str:
    """Returns an error in words.

    Raises:
        AssertionError: it is over the limit, or not a number.
    """
    if not error.rel_rms <= limit:
        raise AssertionError(
            f"{error.worst}: relative rms error {error.rel_rms:.2g}, allowed {limit:.2g}"
        )
    return f"{error.rel_rms:.1e}"


def same(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> None:
    """Compares results bit by bit.

    Raises:
        AssertionError: one differs.
    """
    for i, (a, b) in enumerate(zip(first, second)):
        if not a.equal(b):
            raise AssertionError(f"result {i} differs by up to {(a - b).abs().max().item():.2g}")
