"""Depth of G-Objaverse's ``_nd.exr`` files (normal and depth) as 16-bit pictures.

The package OpenEXR reads them, a native library, so in a child process that may be lost.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from gamba_warp.data.layouts import GOBJAVERSE_DEPTH_UNIT
from gamba_warp.errors import UserError
from gamba_warp.images import MAX_PIXELS
from gamba_warp.untrusted.children import Failed, run_each

SUFFIX = "_nd.exr"
MOST = 64 << 20  # bytes of a file; they have 2 to 4 MB
# Half the diagonal of the unit cube that holds the object: what is nearer or further is no surface,
# as the set's own example says.
_REACH = 3**0.5 / 2
_SECONDS, _MEMORY = 600.0, 4 << 30  # of an object's 40 files, which take 2 s and 0.7 GB


class DepthFile(NamedTuple):
    """One view's depth.

    Attributes:
        source: the ``_nd.exr`` file.
        target: the picture to write.
        distance: of the camera from the object's centre, object units.
    """

    source: Path
    target: Path
    distance: float


def check_package() -> None:
    """Raises UserError where the package OpenEXR is not installed."""
    if find_spec("OpenEXR") is None:
        raise UserError("--depth: needs the package OpenEXR: pip install OpenEXR")


def convert(files: Sequence[DepthFile]) -> None:
    """Writes the depth of one object's views, in a child process.

    Raises:
        UserError: a file is missing, damaged, or has no depth.
    """
    for file in files:
        if not file.source.is_file():
            raise UserError(f"{file.source.name}: no such file")
        if file.source.stat().st_size > MOST:
            raise UserError(f"{file.source.name}: over {MOST >> 20} MB")
    for _, result in run_each(_convert, [tuple(files)], seconds=_SECONDS, memory=_MEMORY):
        if isinstance(result, Failed):
            raise UserError(f"{SUFFIX.lstrip('_')} files: {result.reason}")


def _convert(files: Sequence[DepthFile]) -> None:
    """In the child."""
    for file in files:
        steps = depth_steps(_read(file.source), file.distance)
        Image.fromarray(steps).save(file.target)


def _read(path: Path) -> np.ndarray:
    OpenEXR = importlib.import_module("OpenEXR")  # optional, so that types are not known here
    try:
        header = OpenEXR.File(str(path), separate_channels=True, header_only=True).header()
        low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
        if not 0 < int(np.prod(high - low + 1)) <= MAX_PIXELS:
            raise UserError(f"{path.name}: has more than {MAX_PIXELS >> 20} megapixels, or none")
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        depth = channels["A"].pixels
    except UserError:
        raise
    except KeyError as error:
        raise UserError(f"{path.name}: has no fourth channel, which is the depth") from error
    except Exception as error:  # the library's own kinds
        raise UserError(f"{path.name}: cannot be read ({error})") from error
    return np.asarray(depth, dtype=np.float32)


def depth_steps(depth: np.ndarray, distance: float) -> np.ndarray:
    """Depth along the optical axis as a 16-bit picture of steps of ``GOBJAVERSE_DEPTH_UNIT``.

    Args:
        depth: ``[H, W]`` float32, object units; not finite or out of the object's reach where
            there is no surface.
        distance: of the camera from the object's centre, object units.

    Returns:
        ``[H, W]`` uint16; 0 where there is no surface.
    """
    with np.errstate(invalid="ignore"):
        there = np.isfinite(depth) & (np.abs(depth - distance) <= _REACH)
    steps = np.rint(np.where(there, depth, 0) / GOBJAVERSE_DEPTH_UNIT)
    return np.clip(steps, 0, 65535).astype(np.uint16)
