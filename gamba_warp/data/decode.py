"""Decoded pictures at the size that is asked for: RGBA, and depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import UserError
from ..images import check_size, open_picture
from .layouts import Stored


def resized(picture: np.ndarray, size: int | None, path: Path | Stored) -> np.ndarray:
    """A picture at another height; colour is weighted by alpha, so that no background bleeds in.

    Args:
        picture: ``[H, W, 4]`` uint8.
        size: height of the result, whose width follows; None keeps both.
        path: names the picture in an error.

    Raises:
        UserError: it would be too large.
    """
    height, width = picture.shape[:2]
    if size is None or size == height:
        return picture
    new = (max(1, round(width * size / height)), size)
    check_size(*new, f"{path}: at height {size}")
    # PIL premultiplies RGBA by itself, and its box filter is the exact area average.
    kind = Image.Resampling.BOX if size < height else Image.Resampling.BILINEAR
    return np.asarray(Image.fromarray(picture).resize(new, kind))


def read_steps(
    paths: Sequence[Path | Stored] | None, views: Sequence[int], width: int, height: int
) -> np.ndarray | None:
    """Reads depth pictures of some views, by their nearest samples.

    Args:
        paths: of all views of an object, or None.
        views: numbers of those that are read.
        width: of the result, pixels.
        height: see above.

    Returns:
        ``[V, height, width]`` float32 in steps of the file, >= 0; None where there is none.

    Raises:
        UserError: a picture cannot be read, or holds no depth.
    """
    if paths is None or not views:
        return None
    return np.stack([_read_depth(paths[v], width, height) for v in views])


def _read_depth(path: Path | Stored, width: int, height: int) -> np.ndarray:
    """Reads depth ``[height, width]`` float32, in the steps of the file."""
    if isinstance(path, Stored):
        values = path.read()
        if values.shape != (height, width):
            near = Image.Resampling.NEAREST
            values = np.asarray(Image.fromarray(values).resize((width, height), near))
        return values
    with open_picture(path) as image:
        if len(image.getbands()) != 1:
            raise UserError(f"{path}: has {len(image.getbands())} channels, depth has one")
        if image.size != (width, height):
            image = image.resize((width, height), Image.Resampling.NEAREST)
        values = np.asarray(image, dtype=np.float32)
    if not np.isfinite(values).all() or values.min() < 0:
        raise UserError(f"{path}: a depth is negative or not finite")
    return values
