"""Point clouds: ``.xyz`` and ``.ply``, read completely or refused.

Open3D's readers keep a part of a malformed file, even memory that was never written.

- ``.xyz``: at least three columns; further ones (normals or colours, the format does not say) are
  checked and not used.
- ``.ply``: text or binary; ``x y z`` and ``nx ny nz``.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import UserError
from .headers import MAX_VALUES, open_shape, read_rows
from .ply_data import PlyData, read_ply

SUFFIXES = (".xyz", ".ply")
MAX_POINTS = MAX_VALUES // 3
_AXES = ("x", "y", "z")


class Cloud(NamedTuple):
    """Points of a file."""

    positions: np.ndarray  # [N, 3] float64, finite, N > 0
    normals: np.ndarray | None = None  # [N, 3] float64 of any length, not checked


def read_cloud(path: Path) -> Cloud:
    """Read a cloud by its suffix, one of ``SUFFIXES``.

    Raises:
        UserError: the file is missing, empty, over ``MAX_POINTS`` points or malformed, a word is
            not a number, or a point is not finite.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"{path}: not one of {', '.join(SUFFIXES)}")
    try:
        return _checked(path, reader(path))
    except MemoryError as error:
        raise UserError(f"{path}: not enough memory for it") from error


def _checked(path: Path, cloud: Cloud) -> Cloud:
    count = len(cloud.positions)
    if count == 0:
        raise UserError(f"{path}: contains no points")
    if count > MAX_POINTS:
        raise UserError(f"{path}: {count} points, over the limit of {MAX_POINTS}")
    bad = count - np.count_nonzero(np.isfinite(cloud.positions).all(1))
    if bad:
        raise UserError(f"{path}: {bad} of {count} points are not finite")
    return cloud


def _read_xyz(path: Path) -> Cloud:
    with open_shape(path) as (file, _):
        table = read_rows(file.read(), str(path), comments=True).table(str(path))
    if len(table) and table.shape[1] < 3:
        raise UserError(f"{path}: {table.shape[1]} columns, expected x y z")
    return Cloud(np.ascontiguousarray(table[:, :3]))


def cloud_of(path: Path, data: PlyData) -> Cloud:
    """Return the cloud of a ``.ply`` file's content. Raises UserError as ``read_cloud``."""
    positions = data.numbers("vertex", _AXES)
    if positions is None:
        raise UserError(f"{path}: its vertices have no x, y and z")
    return _checked(path, Cloud(positions, data.numbers("vertex", ("nx", "ny", "nz"))))


_READERS = {".xyz": _read_xyz, ".ply": lambda path: cloud_of(path, read_ply(path))}
