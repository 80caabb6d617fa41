"""Rendering of a file of Gaussians along a camera path, for ``gamba render``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor

from ..cameras import Cameras
from ..errors import UserError
from ..gaussians import Gaussians
from ..images import save_image
from ..untrusted.ranges import check_range
from .files import load_path
from .movies import SECONDS, check_gif, render_path, save_images, save_movie
from .paths import TURNS, Viewpoint, placed, spiral, to_unit, turntable

Kind = Literal["gif", "mp4", "png"]
Color = tuple[float, float, float]

FRAMES = 48  # of one turn
FPS = 24.0  # of a camera file without a rate
SIDE = 512  # pixels
_SIDES = Meta(ge=16, le=4096)
_NEAR = 0.01  # nearest rendered depth
_SAMPLE = 8  # frames for the palette of a GIF
_NAMED = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "gray": (0.5, 0.5, 0.5)}


def parse_size(text: str) -> tuple[int, int | None]:
    """Parse ``WxH`` to width and height, or ``W`` to the width and None, in pixels.

    Raises:
        UserError: the text is malformed, or a side is out of range.
    """
    match = re.fullmatch(r"(\d{1,9})(?:[xX](\d{1,9}))?", text.strip())
    if match is None:
        raise UserError(f"--size {text[:40]}: give a width such as 512, or WxH such as 640x360")
    width, *heights = (int(side) for side in match.groups() if side is not None)
    for side in (width, *heights):
        check_range("--size", side, _SIDES)
    return width, heights[0] if heights else None


def parse_background(text: str) -> Color | None:
    """Parse a name or ``#rrggbb`` to RGB in [0, 1]; None for ``none``, which is transparent.

    Raises:
        UserError: the text is malformed.
    """
    if text == "none":
        return None
    if text in _NAMED:
        return _NAMED[text]
    if re.fullmatch("#?[0-9a-fA-F]{6}", text):
        red, green, blue = (int(text[-6:][i : i + 2], 16) / 255 for i in (0, 2, 4))
        return red, green, blue
    raise UserError(
        f"--background {text[:40]}: one of {', '.join(_NAMED)}, none, or a colour such as #3366ff"
    )


@dataclass
class Film:
    """Cameras and options of a rendering along a path.

    Attributes:
        cameras: ``[V]``, in an object's unit frame, or in the file's own frame.
        own: True if they are in the file's own frame.
        rate: images per second.
        background: RGB in [0, 1], or None for transparent images.
        depth: also write depth maps.
    """

    cameras: Cameras
    own: bool
    rate: float
    background: Color | None
    depth: bool = False


def plan_path(
    trajectory: str,
    size: tuple[int, int | None] | None,
    frames: int | None,
    view: dict[str, float | None],
) -> tuple[Cameras, bool, float]:
    """Return the cameras for the options of ``gamba render``.

    Args:
        trajectory: turntable, spiral, or a file of cameras.
        size: as from ``parse_size``.
        frames: number of images of a turntable or spiral.
        view: elevation, distance and fov of a turntable or spiral; None is the default.

    Returns:
        The cameras, True if they are in the file's own frame, and the images per second.

    Raises:
        UserError: the file is invalid, or an option does not apply to it.
    """
    if trajectory in ("turntable", "spiral"):
        width, height = size or (SIDE, None)
        make, turns = (turntable, 1) if trajectory == "turntable" else (spiral, TURNS)
        point = Viewpoint().changed(**view)
        count = frames or turns * FRAMES
        shape = (width, height or width)
        return make(count, point, shape), False, count / (turns * SECONDS)
    options = [name for name, value in {**view, "frames": frames}.items() if value is not None]
    if options:
        raise UserError(f"--{options[0]} applies to a turntable or a spiral, not to a file")
    path = load_path(trajectory, size)
    for side in (path.cameras.width, path.cameras.height):
        if side > int(_SIDES.le or 0) or side < 1:
            name = f"{path.cameras.width}x{path.cameras.height}"
            raise UserError(f"{trajectory}: images of {name}; give a smaller --size")
    return path.cameras, True, path.fps or FPS


def shoot(
    target: Path,
    kind: Kind,
    gaussians: Gaussians,
    frame: tuple[Tensor, float],
    film: Film,
    device: torch.device,
    tell=lambda count: None,
) -> None:
    """Render a file of Gaussians along a path, and write the output atomically.

    Args:
        target: the ``.gif`` or ``.mp4``; for ``png`` the folder, or a ``.png`` for a single view.
        kind: of the output.
        gaussians: one object of any size and position.
        frame: its centre ``[3]`` and its longest side.
        film: cameras and options.
        device: device that renders.
        tell: called with the number of newly finished images, for a progress bar.

    Raises:
        UserError: a file cannot be written, or is too large for its kind.
    """
    center, side = frame
    # Rendered at the origin with side 1, where float32 is most precise.
    moved = gaussians.in_unit(center, side).to(device)
    cameras = to_unit(film.cameras, center, side) if film.own else film.cameras
    own_cameras = film.cameras if film.own else placed(film.cameras, center, side)
    near = {"near_plane": min(_NEAR, _NEAR / side)}

    def views(part: Cameras):
        for image, depth in render_path(moved, part, film.background, film.depth, **near):
            yield image, None if depth is None else depth * side

    def counted():
        for view in views(cameras):
            yield view
            tell(1)

    if kind == "png" and target.suffix.lower() == ".png":
        save_image(target, next(counted())[0] / 255.0)
        return
    if kind == "png":
        save_images(target, counted(), own_cameras, film.rate)
        return
    count = len(cameras.viewmats)
    every = cameras[:: max(1, count // _SAMPLE)]
    if kind == "gif":
        check_gif(cameras.width, cameras.height, count)
        sample = np.stack([image for image, _ in views(every)])
    else:
        sample = np.zeros((0, 1, 1, 3), np.uint8)
    red, green, blue = (round(255 * value) for value in film.background or (1.0, 1.0, 1.0))
    frames = (image for image, _ in counted())
    save_movie(target, frames, film.rate, sample, (red, green, blue))
