"""Turntables of reconstructions, as GIF or MP4."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..conventions import GREY
from ..gaussians import Gaussians
from ..images import to_uint8
from ..trajectories.movies import render_path, save_movie
from ..trajectories.paths import Viewpoint, turntable

FRONT = Viewpoint()
SECONDS = 3.0  # length of one turn


def turntable_frames(
    gaussians: Gaussians, view: Viewpoint = FRONT, *, size: int = 256, frames: int = 48
) -> np.ndarray:
    """Render one full turn on grey, from the reference view, with several views per launch.

    Args:
        gaussians: one object without batch dimension, in the reference frame, on the device that
            renders.
        view: of the first frame; the others have its elevation.
        size: side of the square frames, pixels, >= 1.
        frames: number of views, >= 1.

    Returns:
        ``[frames, size, size, 3]`` uint8.
    """
    cameras = turntable(frames, view.elevation, view.distance, view.fov, size)
    return np.stack([picture for picture, _ in render_path(gaussians, cameras, (GREY, GREY, GREY))])


def save_turntable(path: str | Path, frames: np.ndarray, seconds: float = SECONDS) -> None:
    """Write frames as an endless ``.gif`` or an ``.mp4`` (H.264), by the suffix, atomically.

    Args:
        path: ends in ``.gif`` or ``.mp4``.
        frames: ``[F, H, W, 3]`` uint8; for MP4 the last row or column is repeated if their number
            is odd, since H.264 needs even sizes.
        seconds: length of one turn.

    Raises:
        UserError: another suffix, or the file cannot be written.
    """
    grey = int(to_uint8(np.array(GREY)))
    sample = frames[:: max(1, len(frames) // 8)]
    save_movie(path, frames, len(frames) / seconds, sample, (grey, grey, grey))
