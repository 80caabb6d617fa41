"""What both ways of computing 1 - SSIM share: groups of pictures, and where pictures differ."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from .constants import EDGE


def groups(
    size: int, got: Tensor, want: Tensor, slopes: Tensor | None
) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Pictures that are computed together, at most ``size``, with the place of their slopes."""
    for i in range(0, len(got), size):
        part = slice(i, i + size)
        yield got[part], want[part], None if slopes is None else slopes[part]


def box_of_windows(unequal: Tensor) -> tuple[slice, slice] | None:
    """The rows and columns of all windows that hold a True of ``[H, W]``; None if there is none."""
    sides = []
    for axis in (1, 0):
        places = unequal.any(axis).nonzero()[:, 0].tolist()
        if not places:
            return None
        sides.append(slice(max(0, places[0] - EDGE), places[-1] + EDGE + 1))
    return sides[0], sides[1]
