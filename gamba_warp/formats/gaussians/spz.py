"""Gaussians as ``.spz``, Niantic's packed format: a tenth of a ``.ply``, read by most viewers.

The header is followed by, each for all Gaussians: positions as 24-bit fixed point, opacities and
colours with 8 bits, logarithms of the scales with 8 bits, rotations, harmonics with 8 bits. Version
1 has positions of 16-bit floats, versions 1 and 2 other rotations; version 4 has the numbers of
version 3 in another container (``spz_container.py``). All four are read; version 3, which every
maintained reader takes, is written. Axes are OpenGL's.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ...errors import UserError
from ...files import atomic_path
from ...gaussians import SH_C0, Gaussians
from ..headers import Source
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
from .spz_container import ANTIALIASED, HEADER, MAGIC, Unpacked, unpacked

_VERSION = 3
_LEVEL = 6  # of gzip, the reference's; 9 takes twice the time for files 1 or 2 % smaller
_CHUNK = 1 << 18  # Gaussians that are packed at once
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
    count, degree = len(arrays["opacities"]), DEGREES[arrays["harmonics"].shape[1]]
    reach = float(np.abs([arrays["means"].min(), arrays["means"].max()]).max())
    bits = next((b for b in range(_FRACTION, -1, -1) if round(reach * 2**b) < 1 << 23), None)
    if bits is None:
        raise UserError(f"{path}: not written, means reach {reach:.3g}, an .spz holds {1 << 23}")
    warn_of_steps(path, torch.from_numpy(arrays["means"]), 2.0**-bits)
    packers: dict[str, Callable[[np.ndarray], bytes]] = {
        "means": lambda x: _packed_means(x, bits),
        "opacities": lambda x: _bytes(x * 255.0),
        "colors": lambda x: _bytes(((x - 0.5) / SH_C0 * _COLOR + 0.5) * 255.0),
        "scales": lambda x: _bytes((_logs(x) + 10) * 16),
        "quats": _packed_quats,
        "harmonics": lambda x: _bytes(x * 128.0 + 128),
    }
    flags, stream = ANTIALIASED if gaussians.antialiased else 0, zlib.compressobj(_LEVEL, wbits=31)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        head = HEADER.pack(MAGIC, _VERSION, count, degree, bits, flags, 0)
        file.write(stream.compress(head))
        for name, pack in packers.items():
            for rows in _chunks(count):
                file.write(stream.compress(pack(arrays[name][rows])))
        file.write(stream.flush())
    clipped = wide = 0
    for rows in _chunks(count):
        clipped += int((np.abs(arrays["harmonics"][rows]) > 1).any((1, 2)).sum())
        logs = _logs(arrays["scales"][rows])
        wide += int(((logs < -10 - 1 / 16) | (logs > 6)).any(1).sum())
    lost = [f"harmonics of {clipped} Gaussians to ±1"] if clipped else []
    lost += [f"scales of {wide} Gaussians to 4.5e-5 and 380"] if wide else []
    return f"{path}: the format clips {' and '.join(lost)}." if lost else None


def _chunks(count: int) -> Iterator[slice]:
    """Yield parts of ``count`` rows, which bounds the memory of intermediate results."""
    return (slice(at, at + _CHUNK) for at in range(0, count, _CHUNK))


def read_spz(source: Source, left_out: list[str] | None = None) -> Gaussians:
    """Read an ``.spz`` file of version 1 to 4, from this or another program, as one object.

    ``left_out`` as for ``checked_gaussians``.

    Raises:
        UserError: the file is not ``.spz``, of another version, truncated or longer than
            it states, or its values are invalid; or version 4 without a module for ZSTD.
    """
    path = source.path
    found = unpacked(path, source.file.read())
    start, columns = 0, []
    for size in found.widths:
        rows = np.frombuffer(found.body, np.uint8, found.count * size, start)
        columns.append(rows.reshape(found.count, size))
        start += rows.nbytes
    parts = [_activated(found, [x[rows] for x in columns]) for rows in _chunks(found.count)]
    names = parts[0] if parts else ("opacities",)
    arrays = {name: np.concatenate([part[name] for part in parts] or [[]]) for name in names}
    del found.body, columns, parts
    step = 2.0**-found.bits if found.version > 1 else 0.0
    gaussians = checked_gaussians(path, arrays, left_out, step)
    return flip_axes(replace(gaussians, antialiased=found.antialiased))


def _activated(found: Unpacked, columns: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Return the activated values, float32, of rows of bytes ``[n, size]`` of each kind."""
    positions, opacities, colors, logs, turns, *harmonics = columns
    if found.version == 1:
        means = np.ascontiguousarray(positions).view("<f2")
    else:
        low = positions.reshape(-1, 3, 3).astype(np.int32)
        fixed = low[..., 0] | low[..., 1] << 8 | low[..., 2] << 16
        means = (fixed - ((fixed & 0x800000) << 1)) / 2.0**found.bits
    if found.version > 2:
        quats = _unpacked_quats(np.ascontiguousarray(turns).view("<u4")[:, 0])
    else:
        xyz = turns / 127.5 - 1
        quats = np.column_stack([np.sqrt(np.maximum(0.0, 1 - (xyz**2).sum(1))), xyz])
    arrays = {
        "means": means,
        "quats": quats,
        "scales": np.exp(logs / 16 - 10),
        "opacities": opacities[:, 0] / 255,
        "colors": (colors / 255 - 0.5) / _COLOR * SH_C0 + 0.5,
    }
    for rest in harmonics:  # empty at degree 0
        arrays["harmonics"] = (rest.reshape(len(rest), -1, 3).astype(np.float64) - 128) / 128
    return {name: value.astype(np.float32) for name, value in arrays.items()}


def _packed_means(means: np.ndarray, bits: int) -> bytes:
    """Return 24-bit fixed point numbers with ``bits`` fractional bits."""
    fixed = np.rint(means.astype(np.float64) * 2**bits).astype("<i4")
    return fixed[:, :, None].view(np.uint8)[..., :3].tobytes()


def _logs(scales: np.ndarray) -> np.ndarray:
    return np.log(scales.clip(MIN_SCALE).astype(np.float64))


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
