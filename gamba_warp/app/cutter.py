"""How the page cuts objects out: by the picture's own alpha, or from a plain background."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import UserError


@dataclass(frozen=True)
class Ways:
    """How objects may be found."""

    matte_model: Path | None = None
    device: str = "cpu"


@dataclass(frozen=True)
class CutOut:
    """A found object: ``rgba [S, S, 4]`` centred, ``source_rgb [H, W, 3]``, ``mask [H, W]``."""

    rgba: np.ndarray
    method: str
    note: str
    source_rgb: np.ndarray
    mask: np.ndarray


def cut_out(path: str | Path, ways: Ways) -> CutOut:
    """Finds the object of a picture.

    Raises:
        UserError: the picture cannot be read, or no way finds an object.
    """
    from ..data.preprocess import WORKING_SIZE, plain_matte, recenter, shrink
    from ..images import load_rgba

    rgba = shrink(load_rgba(path, longest=WORKING_SIZE), WORKING_SIZE)
    source = rgba[..., :3]
    method, note = "alpha", "The object is what the picture's own alpha channel says."
    if rgba[..., 3].min() >= 0.5:
        method, note = "plain", "The object was cut out of a plain background."
        found = plain_matte(source)
        if found is None:
            raise UserError(f"{path}: cannot tell object from background")
        rgba = found
    try:
        return CutOut(recenter(rgba), method, note, source, rgba[..., 3])
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
