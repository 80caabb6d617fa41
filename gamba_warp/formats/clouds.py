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
from .headers import MAX_VALUES, Source, read_rows
from .ply_data import PlyData

MAX_POINTS = MAX_VALUES // 3


class Cloud(NamedTuple):
    """Points of a file."""

    positions: np.ndarray  # [N, 3] float64, finite, N > 0
    normals: np.ndarray | None = None  # [N, 3] float64 of unit length; None if one has none


def _checked(path: Path, positions: np.ndarray, normals: np.ndarray | None = None) -> Cloud:
    """Return a cloud. Raises UserError if it has no points, too many, or one is not finite."""
    count = len(positions)
    if count == 0:
        raise UserError(f"{path}: contains no points")
    if count > MAX_POINTS:
        raise UserError(f"{path}: {count} points, over the limit of {MAX_POINTS}")
    bad = count - np.count_nonzero(np.isfinite(positions).all(1))
    if bad:
        raise UserError(f"{path}: {bad} of {count} points are not finite")
    if normals is not None:
        with np.errstate(over="ignore"):
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / lengths if np.isfinite(lengths).all() and lengths.all() else None
    return Cloud(positions, normals)


def read_xyz(source: Source) -> Cloud:
    """Read the points of an ``.xyz`` file.

    Raises:
        UserError: the file has over ``MAX_POINTS`` points or none, a word is not a number, the
            rows differ in length, or a point is not finite.
    """
    path = source.path
    table = read_rows(source.file.read(), str(path), comments=True).table(str(path))
    if len(table) and table.shape[1] < 3:
        raise UserError(f"{path}: {table.shape[1]} columns, expected x y z")
    return _checked(path, np.ascontiguousarray(table[:, :3]))


def cloud_of(path: Path, data: PlyData) -> Cloud:
    """Return the cloud of a ``.ply`` file's content. Raises UserError as ``read_xyz``."""
    positions = data.numbers("x", "y", "z")
    if positions is None:
        raise UserError(f"{path}: its vertices have no x, y and z")
    return _checked(path, positions, data.numbers("nx", "ny", "nz"))
