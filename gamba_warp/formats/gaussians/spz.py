"""Gaussians as ``.spz``, Niantic's packed format: a tenth of a ``.ply``, read by most viewers.

The header is followed by, each for all Gaussians: positions as 24-bit fixed point, opacities and
colours with 8 bits, logarithms of the scales with 8 bits, rotations, harmonics with 8 bits. Version
1 has positions of 16-bit floats, versions 1 and 2 other rotations; version 4 has the numbers of
version 3 in another container (``spz_container.py``). All four are read; version 3, which every
maintained reader takes, is written. Axes are OpenGL's.
"""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ...errors import UserError
from ...files import atomic_path
from ...gaussians import SH_C0, Gaussians
from ..headers import open_shape
from .arrays import (
    DEGREES,
    MIN_SCALE,
    checked_gaussians,
    export_arrays,
    flip_axes,
    from_smallest_three,
    smallest_three,
    warn_of_steps,
)
from .spz_container import ANTIALIASED, COUNTS, HEADER, MAGIC, unpacked

_VERSION = 3
_FRACTION = 16  # most bits behind the point: steps of 1.5e-5
_COLOR = 0.15  # of a degree-0 coefficient, so that colours outside [0, 1] have a place
_HALF = 511  # largest of the 9 bits of a rotation's number


def save_spz(path: str | Path, gaussians: Gaussians) -> str | None:
    """Write one object as ``.spz``, version 3, turned to the format's axes, atomically.

    Returns:
        A sentence about losses beyond the format's precision, or None.

    Raises:
        UserError: a value is not finite, there is no Gaussian, positions are out of the format's
            range, or the file cannot be written.
        ValueError: there is a batch dimension.
    """
    arrays = export_arrays(path, gaussians, "opengl")
    count, harmonics = len(arrays["opacities"]), arrays["harmonics"]
    reach = float(np.abs(arrays["means"]).max())
    bits = next((b for b in range(_FRACTION, -1, -1) if round(reach * 2**b) < 1 << 23), None)
    if bits is None:
        raise UserError(f"{path}: not written, means reach {reach:.3g}, an .spz holds {1 << 23}")
    warn_of_steps(path, torch.from_numpy(arrays["means"]), 2.0**-bits)
    fixed = np.rint(arrays["means"].astype(np.float64) * 2**bits).astype("<i4")
    logs = np.log(arrays["scales"].clip(MIN_SCALE).astype(np.float64))
    coefficients = (arrays["colors"] - 0.5) / SH_C0
    flags = ANTIALIASED if gaussians.antialiased else 0
    parts = [
        HEADER.pack(MAGIC, _VERSION, count, DEGREES[harmonics.shape[1]], bits, flags, 0),
        fixed[:, :, None].view(np.uint8)[..., :3].tobytes(),
        _bytes(arrays["opacities"] * 255.0),
        _bytes((coefficients * _COLOR + 0.5) * 255.0),
        _bytes((logs + 10) * 16),
        _packed_quats(arrays["quats"]),
        _bytes(harmonics * 128.0 + 128),
    ]
    with atomic_path(path) as temporary:  # without the time, so that equal input is equal output
        temporary.write_bytes(gzip.compress(b"".join(parts), 9, mtime=0))
    clipped = int((np.abs(harmonics) > 1).any((1, 2)).sum())
    wide = int(((logs < -10 - 1 / 16) | (logs > 6)).any(1).sum())
    lost = [f"harmonics of {clipped} Gaussians to ±1"] if clipped else []
    lost += [f"scales of {wide} Gaussians to 4.5e-5 and 380"] if wide else []
    return f"{path}: the format clips {' and '.join(lost)}." if lost else None


def load_spz(path: str | Path, left_out: list[str] | None = None) -> Gaussians:
    """Read an ``.spz`` file of version 1 to 4, from this or another program, as one object.

    ``left_out`` as for ``checked_gaussians``.

    Raises:
        UserError: the file is missing, not ``.spz``, of another version, truncated or longer than
            it states, or its values are invalid; or version 4 without a module for ZSTD.
    """
    path = Path(path)
    with open_shape(path) as (file, _):
        content = file.read()
    found = unpacked(path, content)
    count, K, at = found.count, COUNTS[found.degree], 0

    def take(kind: str, *shape: int) -> np.ndarray:
        nonlocal at
        values = np.frombuffer(found.body, kind, int(np.prod((count, *shape))), at)
        at += values.nbytes
        return values.reshape(count, *shape)

    if found.version == 1:
        means = take("<f2", 3).astype(np.float64)
    else:
        low = take("u1", 3, 3).astype(np.int32)
        fixed = low[..., 0] | low[..., 1] << 8 | low[..., 2] << 16
        means = (fixed - ((fixed & 0x800000) << 1)) / 2.0**found.bits
    opacities = take("u1") / 255
    colors = (take("u1", 3) / 255 - 0.5) / _COLOR * SH_C0 + 0.5
    scales = np.exp(take("u1", 3) / 16 - 10)
    if found.version > 2:
        quats = _unpacked_quats(take("<u4"))
    else:
        xyz = take("u1", 3) / 127.5 - 1
        quats = np.column_stack([np.sqrt(np.maximum(0.0, 1 - (xyz**2).sum(1))), xyz])
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    arrays["colors"] = colors
    arrays["harmonics"] = (take("u1", K, 3).astype(np.float64) - 128) / 128
    step = 2.0**-found.bits if found.version > 1 else 0.0
    gaussians = checked_gaussians(path, arrays, left_out, step)
    return flip_axes(replace(gaussians, antialiased=found.antialiased))


def _bytes(values: np.ndarray) -> bytes:
    return np.rint(values).clip(0, 255).astype(np.uint8).tobytes()


def _packed_quats(quats: np.ndarray) -> bytes:
    """Pack the largest number's index, and of the others of xyzw a sign and 9 bits each."""
    largest, three = smallest_three(np.roll(quats.astype(np.float64), -1, axis=1))
    size = np.floor(np.abs(three) * np.sqrt(2) * _HALF + 0.5).clip(0, _HALF).astype(np.uint32)
    word = largest.astype(np.uint32)
    for column, sign in zip(size.T, (three < 0).T):
        word = (word << 10) | (sign.astype(np.uint32) << 9) | column
    return word.astype("<u4").tobytes()


def _unpacked_quats(words: np.ndarray) -> np.ndarray:
    words = words.astype(np.uint32)
    columns = []
    for shift in (20, 10, 0):
        part = (words >> np.uint32(shift)) & np.uint32(1023)
        size = (part & _HALF) / _HALF * np.sqrt(0.5)
        columns.append(np.where(part >> 9, -size, size))
    quats = from_smallest_three((words >> 30).astype(np.int64), np.stack(columns, 1))
    return np.roll(quats, 1, axis=1)
