"""Gaussians in any format: read by what the file holds, written by the format's name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ...conventions import Axes
from ...gaussians import Gaussians
from ..names import SPLAT_FORMATS, SplatFormat
from ..ply import load_ply, save_ply
from .glb import save_glb
from .splat import save_splat


def read_gaussians(path: str | Path) -> Gaussians:
    """Reads one object's Gaussians, OpenCV's axes, by what the file holds and then by its name.

    Raises:
        UserError: missing, unreadable, truncated, or no Gaussians.
    """
    return load_ply(path)


def write_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    kind: SplatFormat,
    *,
    axes: Axes = "opencv",
    min_opacity: float = 0.0,
    comments: Iterable[str] = (),
) -> str | None:
    """Writes one object's Gaussians, atomically.

    Args:
        path: file to write.
        gaussians: one object, no batch dimension, OpenCV's axes.
        kind: the format.
        axes: of ``ply``; the other formats have axes of their own.
        min_opacity: Gaussians below it are left out.
        comments: lines for the header of a ``.ply``.

    Returns:
        A sentence about what the format cannot hold, or None.

    Raises:
        UserError: a value is not finite, nothing is left, or the file cannot be written.
        ValueError: there is a batch dimension, or the format is not known.
    """
    if kind not in SPLAT_FORMATS:
        raise ValueError(f"the format is {kind!r}, expected one of {', '.join(SPLAT_FORMATS)}")
    if kind == "ply":
        save_ply(path, gaussians, axes=axes, min_opacity=min_opacity, comments=comments)
    elif kind == "splat":
        save_splat(path, gaussians, min_opacity=min_opacity)
    elif kind == "glb":
        save_glb(path, gaussians, min_opacity=min_opacity)
    return None
