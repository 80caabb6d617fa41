"""Point clouds read to the last number: ``.xyz``, ``.pts``, ``.pcd`` and ``.ply``.

What a header promises is there, every word is a number, every row has the same columns; else the
file is refused. (Open3D's readers keep what they have when a line is bad, even memory that was
never written.)

- ``.xyz``: at least three columns; further ones (normals, colours: the format does not say which)
  are checked and not used.
- ``.pts``: a line with the number of points, or none; then ``x y z``, ``x y z intensity``,
  ``x y z r g b`` or ``x y z intensity r g b``.
- ``.pcd``: text, binary or compressed; ``x y z`` and, where they are there, ``normal_x normal_y
  normal_z``.
- ``.ply``: text or binary; ``x y z`` and ``nx ny nz``.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ..errors import UserError
from .headers import MAX_VALUES, compare_sizes, lines_of, open_shape, read_table
from .ply_data import read_ply

SUFFIXES = (".xyz", ".pts", ".pcd", ".ply")
MAX_POINTS = MAX_VALUES // 3
MAX_UNPACKED = 1 << 30  # bytes of a compressed .pcd
_MAX_FIELDS = 1024  # of a .pcd; its descriptors of shape have up to 640
_HEADER_LINES = 64
_PTS_COLUMNS = (3, 4, 6, 7)
_AXES, _PCD_NORMALS = ("x", "y", "z"), ("normal_x", "normal_y", "normal_z")


class Cloud(NamedTuple):
    """What a file holds.

    Attributes:
        positions: ``[N, 3]`` float64, finite, N > 0.
        normals: ``[N, 3]`` float64 of any length, perhaps not finite; or None.
    """

    positions: np.ndarray
    normals: np.ndarray | None = None


def read_cloud(path: Path) -> Cloud:
    """Reads a cloud by its suffix, one of ``SUFFIXES``.

    Raises:
        UserError: missing, empty, over ``MAX_POINTS`` points, not what its header says, a word
            that is no number, or a point that is not finite. (A ``.pcd`` of a depth camera marks
            pixels without a point by NaN: such a file is refused, with their number, because a
            cloud with holes is not the cloud that somebody meant to compare.)
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"{path}: not one of {', '.join(SUFFIXES)}")
    try:
        cloud = reader(path)
    except MemoryError as error:
        raise UserError(f"{path}: not enough memory for it") from error
    count = len(cloud.positions)
    if count == 0:
        raise UserError(f"{path}: no points in it")
    if count > MAX_POINTS:
        raise UserError(f"{path}: {count} points, over the limit of {MAX_POINTS}")
    bad = count - np.count_nonzero(np.isfinite(cloud.positions).all(1))
    if bad:
        raise UserError(f"{path}: {bad} of {count} points are not finite")
    return cloud


def _read_xyz(path: Path) -> Cloud:
    with open_shape(path) as (file, _):
        table = read_table(lines_of(file, str(path), comments="#"), str(path))
    if len(table) and table.shape[1] < 3:
        raise UserError(f"{path}: {table.shape[1]} columns, expected x y z")
    return Cloud(np.ascontiguousarray(table[:, :3]))


def _read_pts(path: Path) -> Cloud:
    with open_shape(path) as (file, _):
        lines = lines_of(file, str(path), comments="#")
        first = next(lines, "")
        count = None
        if len(first.split()) == 1:
            count = _whole(path, "the number of points", first.strip())
        elif first:
            lines = chain([first], lines)
        table = read_table(lines, str(path), _PTS_COLUMNS)
    if count is not None and len(table) != count:
        raise UserError(
            f"{path}: truncated or false header, {count} points but {len(table)} lines follow"
        )
    return Cloud(np.ascontiguousarray(table[:, :3]))


def _read_ply(path: Path) -> Cloud:
    data = read_ply(path)
    positions = data.numbers("vertex", _AXES)
    if positions is None:
        raise UserError(f"{path}: its vertices have no x, y and z")
    return Cloud(positions, data.numbers("vertex", ("nx", "ny", "nz")))


class _PcdHeader(NamedTuple):
    """The fields of a ``.pcd`` as a type for numpy, the number of points, and the kind of data."""

    kind: np.dtype
    count: int
    data: str


def _read_pcd(path: Path) -> Cloud:
    with open_shape(path) as (file, size):
        header = _pcd_header(path, file)
        kind, count = header.kind, header.count
        says, left = f"{count} points", size - file.tell()
        if header.data == "ascii":
            return _pcd_text(path, lines_of(file, str(path)), header)
        wanted = count * kind.itemsize
        if header.data == "binary":
            compare_sizes(path, says, wanted, left)
            rows = np.frombuffer(file.read(wanted), kind, count)
            return _pcd_cloud(lambda name: rows[name][:, 0], kind)
        sizes = np.frombuffer(file.read(8), "<u4")
        packed, unpacked = (int(number) for number in sizes) if len(sizes) == 2 else (0, 0)
        compare_sizes(path, says, packed, left - 8, exact=False)
        if unpacked != wanted or wanted > MAX_UNPACKED:
            raise UserError(
                f"{path}: truncated or false header, {says} take {wanted} bytes but it holds "
                f"{unpacked}, of {MAX_UNPACKED} at most"
            )
        compare_sizes(path, says, wanted, packed * 264, exact=False)  # LZF's longest repetition
        plain = lzf_decompressed(file.read(packed), wanted, str(path))

    # Compressed points are stored field by field, not point by point.
    def field(name: str) -> np.ndarray:
        inner, offset = kind.fields[name][:2]  # pyright: ignore[reportOptionalSubscript]
        return np.frombuffer(plain, inner.base, count * inner.shape[0], offset * count)

    return _pcd_cloud(field, kind)


def _pcd_header(path: Path, file: BinaryIO) -> _PcdHeader:
    """Reads the header; the file then stands at the data. Raises UserError."""
    lines: dict[str, list[str]] = {}
    for _ in range(_HEADER_LINES):
        words = file.readline(1 << 14).decode("ascii", "replace").split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] in lines:
            raise UserError(f"{path}: broken header, {words[0][:20]} is there twice")
        lines["FIELDS" if words[0] == "COLUMNS" else words[0]] = words[1:]
        if words[0] == "DATA":
            break
    for key in ("FIELDS", "SIZE", "TYPE", "DATA"):
        if not lines.get(key):
            raise UserError(f"{path}: broken header, no {key}")
    names, kinds = lines["FIELDS"], lines["TYPE"]
    sizes = [_whole(path, "SIZE", word) for word in lines["SIZE"]]
    repeats = [_whole(path, "COUNT", word) for word in lines.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(sizes) == len(kinds) == len(repeats):
        raise UserError(f"{path}: broken header, FIELDS, SIZE, TYPE and COUNT differ in length")
    counts = {key: _whole(path, key, " ".join(lines[key])) for key in _PCD_COUNTS if key in lines}
    count = counts.get("POINTS", counts.get("WIDTH", 0) * counts.get("HEIGHT", 1))
    if "WIDTH" in counts and counts["WIDTH"] * counts.get("HEIGHT", 1) != count:
        raise UserError(f"{path}: false header, WIDTH times HEIGHT is not {count} POINTS")
    if sum(repeats) > _MAX_FIELDS or min(repeats) < 1:
        raise UserError(f"{path}: broken header, COUNT {' '.join(lines['COUNT'])[:60]}")
    fields = []
    for i, (name, letter, size, repeat) in enumerate(zip(names, kinds, sizes, repeats)):
        if (letter, size) not in _PCD_KINDS:
            raise UserError(f"{path}: field {name[:40]} has type {letter[:9]} of {size} bytes")
        used = name in (*_AXES, *_PCD_NORMALS) and repeat == 1
        known = name if used and names.count(name) == 1 else f"unused {i}"  # "_" may repeat
        fields.append((known, _PCD_KINDS[letter, size], (repeat,)))
    kind = np.dtype(fields)
    missing = [axis for axis in _AXES if axis not in (kind.names or ())]
    if missing:
        raise UserError(f"{path}: broken header, not one field {' '.join(missing)}")
    data = lines["DATA"][0]
    if data not in ("ascii", "binary", "binary_compressed"):
        raise UserError(f"{path}: broken header, DATA {data[:20]}")
    return _PcdHeader(kind, count, data)


def _pcd_text(path: Path, lines: Iterator[str], header: _PcdHeader) -> Cloud:
    widths = {name: field[0].shape[0] for name, field in (header.kind.fields or {}).items()}
    table = read_table(lines, str(path), (sum(widths.values()),))
    if len(table) != header.count:
        raise UserError(
            f"{path}: truncated or false header, {header.count} points "
            f"but {len(table)} lines follow"
        )
    ends = dict(zip(widths, np.cumsum(list(widths.values()))))
    return _pcd_cloud(lambda name: table[:, ends[name] - 1], header.kind)


def _pcd_cloud(field, kind: np.dtype) -> Cloud:
    """The cloud of the columns ``[N]`` that ``field`` gives by name."""

    def stacked(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([np.asarray(field(name), np.float64) for name in names], 1)

    has_normals = set(_PCD_NORMALS) <= set(kind.names or ())
    return Cloud(stacked(_AXES), stacked(_PCD_NORMALS) if has_normals else None)


def _whole(path: Path, what: str, word: str) -> int:
    if not (word.isascii() and word.isdecimal() and len(word) <= 18):
        raise UserError(f"{path}: broken header, {what} is '{word[:40]}', not a whole number")
    return int(word)


def lzf_decompressed(data: bytes, size: int, source: str) -> bytearray:
    """Unpacks a block of LZF, the compression of ``.pcd`` files (Marc Lehmann's liblzf).

    A control byte below 32 is followed by that many bytes and one more, as they are. A greater one
    repeats what lies before: its upper 3 bits are the length less 2 (7: the next byte adds to it),
    its lower 5 bits and the next byte the distance less 1.

    Args:
        data: the block.
        size: of its content, bytes.
        source: named in errors.

    Raises:
        UserError: the block is broken, or its content is not of that size.
    """
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            length += 2
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            if start < 0:
                raise UserError(f"{source}: its compressed data are broken")
            part = out[start : start + length]
            if len(part) < length:  # it repeats itself
                part = (part * (length // len(part) + 1))[:length]
            out += part
            if len(out) > size:
                break
    except IndexError:
        at = end + 1
    if at > end or len(out) != size:
        raise UserError(f"{source}: its compressed data are broken, or are not {size} bytes")
    return out


_READERS = {".xyz": _read_xyz, ".pts": _read_pts, ".pcd": _read_pcd, ".ply": _read_ply}
_PCD_COUNTS = ("WIDTH", "HEIGHT", "POINTS")
_PCD_KINDS = {
    (letter, size): f"<{letter.lower()}{size}"
    for letter, sizes in {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}.items()
    for size in sizes
}
