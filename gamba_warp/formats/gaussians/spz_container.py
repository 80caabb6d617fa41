"""Containers of an ``.spz``: one gzip stream (versions 1 to 3), or ZSTD streams (version 4).

Version 4 has a plain header of 32 bytes, records of extensions, a table of contents with the packed
and the unpacked size of each stream, and then the streams: positions, opacities, colours, scales,
rotations, and harmonics if any. All sizes follow from the header: they are compared before
anything is unpacked, and no more is unpacked than they say.
"""

from __future__ import annotations

import gzip
import importlib
import io
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import UserError, first_line
from ...versions import advice
from ..headers import compare_sizes
from .arrays import DEGREES

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
COUNTS = {degree: count for count, degree in DEGREES.items()}


@dataclass
class Unpacked:
    """Decoded arrays of an ``.spz``, attribute by attribute, and the header's values."""

    body: bytes | bytearray
    version: int
    count: int
    bits: int
    antialiased: bool
    widths: list[int]  # bytes of a Gaussian, of each kind


def unpacked(path: Path, content: bytes) -> Unpacked:
    """Return the numbers of a file of any version, as many as its header states.

    Raises:
        UserError: not ``.spz``, damaged, truncated, or the header is malformed or of another
            version; or version 4 without a module for ZSTD.
    """
    return (_from_streams if content.startswith(MAGIC) else _from_gzip)(path, content)


def _header(path: Path, header: bytes, packed: int) -> Unpacked:
    """Return the values of a header, without the numbers themselves.

    The ``packed`` bytes of the file cannot hold more than ``_MAX_RATIO`` times as many.
    """
    _, version, count, degree, bits, flags, _ = HEADER.unpack(header)
    if degree not in COUNTS:
        raise UserError(f"{path}: harmonics of degree {degree}, only 0 to 3 are supported")
    if bits > _MAX_BITS or count > MAX_POINTS:
        raise UserError(f"{path}: broken header, {count} Gaussians, {bits} bits")
    position, rotation = 6 if version == 1 else 9, 4 if version > 2 else 3
    each = [position, 1, 3, 3, rotation, *([3 * COUNTS[degree]] if degree else [])]
    says = f"{count} Gaussians"
    compare_sizes(path, says, count * sum(each), _MAX_RATIO * packed, exact=False)
    return Unpacked(b"", version, count, bits, bool(flags & ANTIALIASED), each)


def _from_gzip(path: Path, content: bytes) -> Unpacked:
    stream = gzip.GzipFile(fileobj=io.BytesIO(content))
    try:
        head = stream.read(HEADER.size)
        if len(head) < HEADER.size or not head.startswith(MAGIC):
            raise UserError(f"{path}: not an .spz file")
        _, version, count, _, _, flags, _ = HEADER.unpack(head)
        if version not in (1, 2, 3):
            raise UserError(f"{path}: .spz of version {version}, in gzip only 1 to 3 are supported")
        found = _header(path, head, len(content))
        wanted = count * sum(found.widths)
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
    found.body = body[:wanted]
    return found


def _from_streams(path: Path, content: bytes) -> Unpacked:
    start = HEADER.size + _PLAIN.size
    if len(content) < start:
        raise UserError(f"{path}: truncated, the header of an .spz takes {start} bytes")
    _, version, _, _, _, flags, streams = HEADER.unpack_from(content)
    (table,) = _PLAIN.unpack_from(content, HEADER.size)
    if version != 4:
        raise UserError(f"{path}: .spz of version {version}, without gzip only 4 is supported")
    found = _header(path, content[: HEADER.size], len(content))
    sizes = [found.count * width for width in found.widths]
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
    found.body = body
    return found


def _stream(path: Path, zstd: Any, number: int, packed: memoryview, size: int) -> bytes:
    """Unpack one ZSTD frame of exactly ``size`` bytes, and at most one byte more."""
    # A frame of a long stream may look back over all of it, which takes that much memory.
    window = {zstd.DecompressionParameter.window_log_max: max(_WINDOW, size.bit_length())}
    decoder = zstd.ZstdDecompressor(options=window)
    try:
        found = decoder.decompress(packed, size + 1)
    except zstd.ZstdError as error:
        reason = first_line(error)
        raise UserError(f"{path}: stream {number} is truncated or damaged ({reason})") from error
    if len(found) > size or decoder.unused_data:
        raise UserError(f"{path}: invalid header, stream {number} holds more than {size} bytes")
    if not decoder.eof or len(found) < size:
        raise UserError(
            f"{path}: truncated or invalid header, stream {number} ends after {len(found)} of"
            f" {size} bytes"
        )
    return found


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
