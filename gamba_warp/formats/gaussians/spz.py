"""Gaussians as ``.spz``, Niantic's packed format: a tenth of a ``.ply``, read by most viewers.

The header is followed by, each for all Gaussians: positions as 24-bit fixed point, opacities and
colours with 8 bits, logarithms of the scales with 8 bits, rotations, harmonics with 8 bits. Version
1 has positions of 16-bit floats, versions 1 and 2 other rotations; version 4 has the numbers of
version 3 in another container. All four are read; version 3, which every maintained reader takes,
is written. Axes are OpenGL's.

The container of versions 1 to 3 is one gzip stream. Version 4 has a plain header of 32 bytes,
records of extensions, a table of contents with the packed and the unpacked size of each stream, and
then a ZSTD stream for each kind of number. All sizes follow from the header: they are compared
before anything is unpacked, and no more is unpacked than they say.
"""

from __future__ import annotations

import gzip
import importlib
import io
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...errors import UserError, first_line
from ...files import atomic_path
from ...gaussians import SH_C0, Gaussians
from ...versions import advice
from ..headers import Source, compare_sizes
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

GZIP, MAGIC = b"\x1f\x8b", b"NGSP"  # the first bytes of versions 1 to 3, and of version 4
HEADER = struct.Struct("<4sIIBBBB")  # the last byte is the number of streams, in version 4
MAX_POINTS = 10_000_000  # as the reference has it
_PLAIN = struct.Struct("<I12x")  # of version 4: where the table of contents is
_ENTRY = struct.Struct("<QQ")  # of that table: bytes packed, bytes unpacked
_MAX_RATIO = 1040  # deflate packs at most 1032 to 1; of ZSTD the reference takes 1024 to 1
_MAX_BITS = 30  # behind the point
ANTIALIASED, _MORE = 1, 2  # flags: fitted with antialiasing; extensions follow
_MAX_EXTENSIONS = 1 << 20  # bytes of them that are read
_RECORD = struct.Struct("<II")  # of an extension: kind, and bytes that follow
_SYSTEM, _RUB = 0xADBE0003, 4  # the extension that names the axes; 4 is OpenGL's, 0 names none
_WINDOW = 27  # log2 of the memory that a ZSTD decoder gives to any frame
_VERSION = 3
_LEVEL = 6  # of gzip, the reference's; 9 takes twice the time for files 1 or 2 % smaller
_CHUNK = 1 << 18  # Gaussians that are packed at once
_FRACTION = 16  # most bits behind the point: steps of 1.5e-5
_COLOR = 0.15  # of a degree-0 coefficient, so that colours outside [0, 1] have a place
_HALF = 511  # largest of the 9 bits of a rotation's number


@dataclass
class _Unpacked:
    """Decoded arrays of an ``.spz``, attribute by attribute, and the header's values."""

    body: bytes | bytearray
    version: int
    count: int
    bits: int
    antialiased: bool
    widths: list[int]  # bytes of a Gaussian, of each kind


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
    content = source.file.read()
    unpacked = (_from_streams if content.startswith(MAGIC) else _from_gzip)(path, content)
    start, columns = 0, []
    for size in unpacked.widths:
        rows = np.frombuffer(unpacked.body, np.uint8, unpacked.count * size, start)
        columns.append(rows.reshape(unpacked.count, size))
        start += rows.nbytes
    parts = [_activated(unpacked, [x[rows] for x in columns]) for rows in _chunks(unpacked.count)]
    names = parts[0] if parts else ("opacities",)
    arrays = {name: np.concatenate([part[name] for part in parts] or [[]]) for name in names}
    del unpacked.body, columns, parts
    step = 2.0**-unpacked.bits if unpacked.version > 1 else 0.0
    gaussians = checked_gaussians(path, arrays, left_out, step)
    return flip_axes(replace(gaussians, antialiased=unpacked.antialiased))


def _activated(unpacked: _Unpacked, columns: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Return the activated values, float32, of rows of bytes ``[n, size]`` of each kind."""
    positions, opacities, colors, logs, turns, *harmonics = columns
    if unpacked.version == 1:
        means = np.ascontiguousarray(positions).view("<f2")
    else:
        low = positions.reshape(-1, 3, 3).astype(np.int32)
        fixed = low[..., 0] | low[..., 1] << 8 | low[..., 2] << 16
        means = (fixed - ((fixed & 0x800000) << 1)) / 2.0**unpacked.bits
    if unpacked.version > 2:
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
    for sh in harmonics:  # empty at degree 0
        arrays["harmonics"] = (sh.reshape(len(sh), -1, 3).astype(np.float64) - 128) / 128
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


def _header(path: Path, header: bytes, packed: int) -> _Unpacked:
    """Return the values of a header, without the numbers themselves.

    The ``packed`` bytes of the file cannot hold more than ``_MAX_RATIO`` times as many.
    """
    _, version, count, degree, bits, flags, _ = HEADER.unpack(header)
    counts = {degree: count for count, degree in DEGREES.items()}
    if degree not in counts:
        raise UserError(f"{path}: harmonics of degree {degree}, only 0 to 3 are supported")
    if bits > _MAX_BITS or count > MAX_POINTS:
        raise UserError(f"{path}: broken header, {count} Gaussians, {bits} bits")
    position, rotation = 6 if version == 1 else 9, 4 if version > 2 else 3
    widths = [position, 1, 3, 3, rotation, *([3 * counts[degree]] if degree else [])]
    says = f"{count} Gaussians"
    compare_sizes(path, says, count * sum(widths), _MAX_RATIO * packed, exact=False)
    return _Unpacked(b"", version, count, bits, bool(flags & ANTIALIASED), widths)


def _from_gzip(path: Path, content: bytes) -> _Unpacked:
    stream = gzip.GzipFile(fileobj=io.BytesIO(content))
    try:
        head = stream.read(HEADER.size)
        if len(head) < HEADER.size or not head.startswith(MAGIC):
            raise UserError(f"{path}: not an .spz file")
        _, version, count, _, _, flags, _ = HEADER.unpack(head)
        if version not in (1, 2, 3):
            raise UserError(f"{path}: .spz of version {version}, in gzip only 1 to 3 are supported")
        unpacked = _header(path, head, len(content))
        wanted = count * sum(unpacked.widths)
        body = stream.read(wanted + 1)
        records = body[wanted:]
        if flags & _MORE and records:
            records += stream.read(_MAX_EXTENSIONS)
    except (EOFError, OSError, zlib.error) as error:
        raise UserError(f"{path}: truncated or damaged ({first_line(error)})") from error
    compare_sizes(path, f"{count} Gaussians", wanted, len(body), exact=False)
    if records and not flags & _MORE:
        raise UserError(f"{path}: invalid header, more data follows than {count} Gaussians need")
    _check_axes(path, records)
    unpacked.body = body[:wanted]
    return unpacked


def _from_streams(path: Path, content: bytes) -> _Unpacked:
    start = HEADER.size + _PLAIN.size
    if len(content) < start:
        raise UserError(f"{path}: truncated, the header of an .spz takes {start} bytes")
    _, version, _, _, _, flags, streams = HEADER.unpack_from(content)
    (table,) = _PLAIN.unpack_from(content, HEADER.size)
    if version != 4:
        raise UserError(f"{path}: .spz of version {version}, without gzip only 4 is supported")
    unpacked = _header(path, content[: HEADER.size], len(content))
    sizes = [unpacked.count * width for width in unpacked.widths]
    if streams != len(sizes) or table < start:
        raise UserError(f"{path}: broken header, {streams} streams, their table at byte {table}")
    at = table + streams * _ENTRY.size
    compare_sizes(path, "header and table", at, len(content), exact=False)
    entries = list(_ENTRY.iter_unpack(content[table:at]))
    for number, (size, (_, promised)) in enumerate(zip(sizes, entries)):
        if promised != size:
            raise UserError(
                f"{path}: invalid header, stream {number} has {promised} bytes in the table of"
                f" contents, {size} by the number of Gaussians"
            )
    packed = [entry[0] for entry in entries]
    compare_sizes(path, "the streams", sum(packed), len(content) - at)
    if flags & _MORE:
        _check_axes(path, content[start : min(table, start + _MAX_EXTENSIONS)])
    body, zstd, view = bytearray(), _zstd(path), memoryview(content)
    for number, (size, length) in enumerate(zip(sizes, packed)):
        body += _stream(path, zstd, number, view[at : at + length], size)
        at += length
    unpacked.body = body
    return unpacked


def _stream(path: Path, zstd: Any, number: int, packed: memoryview, size: int) -> bytes:
    """Unpack one ZSTD frame of exactly ``size`` bytes, and at most one byte more."""
    # A frame of a long stream may look back over all of it, which takes that much memory.
    window = {zstd.DecompressionParameter.window_log_max: max(_WINDOW, size.bit_length())}
    decoder = zstd.ZstdDecompressor(options=window)
    try:
        data = decoder.decompress(packed, size + 1)
    except zstd.ZstdError as error:
        reason = first_line(error)
        raise UserError(f"{path}: stream {number} is truncated or damaged ({reason})") from error
    if len(data) > size or decoder.unused_data:
        raise UserError(f"{path}: invalid header, stream {number} holds more than {size} bytes")
    if not decoder.eof or len(data) < size:
        raise UserError(
            f"{path}: truncated or invalid header, stream {number} ends after {len(data)} of"
            f" {size} bytes"
        )
    return data


def _zstd(path: Path) -> Any:
    """Return Python's module for ZSTD: its own from 3.14 on, or its backport."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise UserError(advice("backports.zstd", f"{path}: .spz of version 4") or str(path))


def _check_axes(path: Path, records: bytes) -> None:
    """Raise UserError if an extension names other axes than the format's own; ignore others."""
    at = 0
    while at + _RECORD.size <= len(records):
        kind, length = _RECORD.unpack_from(records, at)
        at += _RECORD.size
        if kind == _SYSTEM and length == 4 and at + 4 <= len(records):
            system = int.from_bytes(records[at : at + 4], "little")
            if system not in (0, _RUB):
                raise UserError(
                    f"{path}: its axes are number {system} of the format's extension, only {_RUB}"
                    " (x right, y up, z backward) is supported"
                )
        at += length
