"""Gaussians written in any format, by its name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ...batch import STAGES
from ...errors import UserError
from ...files import atomic_path
from ...gaussians import Gaussians
from ..names import SPLAT_FORMATS, SplatFormat
from ..ply import header_bytes, marked, save_ply
from .arrays import export_arrays
from .compressed import packed
from .splat import save_splat
from .spz import save_spz


def to_be_written(gaussians: Gaussians, least: float | None = None) -> tuple[Gaussians, str]:
    """Select the Gaussians of one object that a command writes, without those that are never drawn.

    Args:
        gaussians: one object, no batch dimension.
        least: as for ``Gaussians.drawn``.

    Returns:
        The Gaussians, and a sentence with their number and, if they could be seen or with
        --verbose, the number left out.

    Raises:
        UserError: none is left.
    """
    drawn = gaussians.drawn(least)
    limit = "1/255" if least is None else f"{least:g}"
    if drawn.num == 0:
        raise UserError(f"no Gaussian has an opacity of {limit} or more")
    lost = gaussians.num - drawn.num
    why = f"opacity under {limit}" + (", never drawn" if least is None else "")
    said = f", {lost:,} left out ({why})" if lost and (least or STAGES.verbose) else ""
    return drawn, f"{drawn.num:,} Gaussians{said}."


def write_gaussians(
    path: str | Path, gaussians: Gaussians, kind: SplatFormat, *, comments: Iterable[str] = ()
) -> str | None:
    """Write one object's Gaussians, atomically, in the axes of the format.

    Args:
        path: file to write.
        gaussians: one object, no batch dimension, OpenCV's axes.
        kind: the format.
        comments: lines for the header of a ``.ply``, compressed or not.

    Returns:
        A sentence about losses beyond the format's precision, or None.

    Raises:
        UserError: a value is not finite, there is no Gaussian, or the file cannot be written.
        ValueError: there is a batch dimension, or the format is unknown.
    """
    if kind not in SPLAT_FORMATS:
        raise ValueError(f"the format is {kind!r}, expected one of {', '.join(SPLAT_FORMATS)}")
    if kind == "ply":
        return save_ply(path, gaussians, comments=comments)
    if kind == "compressed-ply":
        lines, body, clipped = packed(export_arrays(path, gaussians))
        with atomic_path(path) as temporary:
            temporary.write_bytes(header_bytes(marked(gaussians, comments), lines) + body)
        return f"{path}: the format clips harmonics to ±4." if clipped else None
    return (save_splat if kind == "splat" else save_spz)(path, gaussians)
