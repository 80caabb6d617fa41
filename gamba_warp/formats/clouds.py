"""Point clouds: ``.xyz``, ``.pts``, ``.pcd`` and ``.ply``, read completely or refused.

Open3D's readers keep a part of a malformed file, even memory that was never written.

- ``.xyz``: at least three columns; further ones (normals or colours, the format does not say) are
  checked and not used.
- ``.pts``: optionally a line with the number of points; then ``x y z``, ``x y z intensity``,
  ``x y z r g b`` or ``x y z intensity r g b``.
- ``.pcd``: text, binary or compressed; ``x y z``, and ``normal_x normal_y normal_z`` if present.
- ``.ply``: text or binary; ``x y z`` and ``nx ny nz``.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ..errors import UserError
from .headers import (
    MAX_COLUMNS,
    MAX_VALUES,
    check_lines,
    compare_sizes,
    open_shape,
    read_rows,
)
from .ply_data import PlyData, read_ply

SUFFIXES = (".xyz", ".pts", ".pcd", ".ply")
MAX_POINTS = MAX_VALUES // 3
MAX_UNPACKED = 1 << 30  # bytes of a compressed .pcd
_HEADER_LINES = 64
_PTS_COLUMNS = (3, 4, 6, 7)
_AXES, _PCD_NORMALS = ("x", "y", "z"), ("normal_x", "normal_y", "normal_z")


class Cloud(NamedTuple):
    """Points of a file."""

    positions: np.ndarray  # [N, 3] float64, finite, N > 0
    normals: np.ndarray | None = None  # [N, 3] float64 of any length, not checked


def read_cloud(path: Path) -> Cloud:
    """Read a cloud by its suffix, one of ``SUFFIXES``.

    Raises:
        UserError: the file is missing, empty, over ``MAX_POINTS`` points or malformed, a word is
            not a number, or a point is not finite. (A ``.pcd`` of a depth camera marks pixels
            without a point by NaN: it is refused with their number, because a cloud with holes is
            not the cloud that somebody meant to compare.)
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
        raise UserError(f"{path}: no points in it")
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


def _read_pts(path: Path) -> Cloud:
    with open_shape(path) as (file, _):
        rows = read_rows(file.read(), str(path), comments=True)
    if len(rows.sizes) and rows.sizes[0] == 1:
        stated, rows = rows.values[0], rows.part(1, len(rows.sizes))
        if not (stated >= 0 and stated == np.rint(stated)):
            what = f"the number of points is {stated:g}, not a whole number"
            raise UserError(f"{path}: broken header, {what}")
        check_lines(path, f"{stated:.0f} points", int(min(stated, 1e18)), len(rows.sizes))
    return Cloud(np.ascontiguousarray(rows.table(str(path), _PTS_COLUMNS)[:, :3]))


def cloud_of(path: Path, data: PlyData) -> Cloud:
    """Return the cloud of a ``.ply`` file's content. Raises UserError as ``read_cloud``."""
    positions = data.numbers("vertex", _AXES)
    if positions is None:
        raise UserError(f"{path}: its vertices have no x, y and z")
    return _checked(path, Cloud(positions, data.numbers("vertex", ("nx", "ny", "nz"))))


def _read_pcd(path: Path) -> Cloud:
    with open_shape(path) as (file, size):
        fields, count, data = _pcd_header(path, file)
        kind = np.dtype(fields)
        says, left, wanted = f"{count} points", size - file.tell(), count * kind.itemsize
        columns = {}
        if data == "ascii":
            ends = np.cumsum([repeat for _, _, (repeat,) in fields])
            table = read_rows(file.read(), str(path)).table(str(path), (int(ends[-1]),))
            check_lines(path, says, count, len(table))
            columns = {name: table[:, end - 1] for (name, *_), end in zip(fields, ends)}
        elif data == "binary":
            compare_sizes(path, says, wanted, left)
            rows = np.frombuffer(file.read(wanted), kind, count)
            columns = {name: rows[name][:, 0] for name, *_ in fields}
        else:  # compressed points are stored field by field, not point by point
            sizes = np.frombuffer(file.read(8), "<u4")
            packed, unpacked = map(int, sizes) if len(sizes) == 2 else (0, 0)
            compare_sizes(path, says, packed, left - 8, exact=False)
            if unpacked != wanted or wanted > MAX_UNPACKED:
                raise UserError(
                    f"{path}: truncated or false header, {says} take {wanted} bytes but it holds "
                    f"{unpacked}, of {MAX_UNPACKED} at most"
                )
            compare_sizes(path, says, wanted, packed * 264, exact=False)  # LZF's best ratio
            plain = lzf_decompressed(file.read(packed), wanted, str(path))
            at = 0
            for name, code, (repeat,) in fields:
                columns[name] = np.frombuffer(plain, code, count * repeat, at)
                at += columns[name].nbytes

    def stacked(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([np.asarray(columns[name], np.float64) for name in names], 1)

    has_normals = columns.keys() >= {*_PCD_NORMALS}
    return Cloud(stacked(_AXES), stacked(_PCD_NORMALS) if has_normals else None)


def _pcd_header(path: Path, file: BinaryIO) -> tuple[list[tuple[str, str, tuple[int]]], int, str]:
    """Read the header: each field's name, type and shape, the number of points, kind of data.

    Fields without use, with several values or with a repeated name are called ``unused N``.
    """
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
    names, kinds, data = lines["FIELDS"], lines["TYPE"], lines["DATA"][0]
    sizes = [_whole(path, "SIZE", word) for word in lines["SIZE"]]
    repeats = [_whole(path, "COUNT", word) for word in lines.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(sizes) == len(kinds) == len(repeats):
        raise UserError(f"{path}: broken header, FIELDS, SIZE, TYPE and COUNT differ in length")
    counts = {key: _whole(path, key, " ".join(lines[key])) for key in _PCD_COUNTS if key in lines}
    count = counts.get("POINTS", counts.get("WIDTH", 0) * counts.get("HEIGHT", 1))
    if "WIDTH" in counts and counts["WIDTH"] * counts.get("HEIGHT", 1) != count:
        raise UserError(f"{path}: false header, WIDTH times HEIGHT is not {count} POINTS")
    if sum(repeats) > MAX_COLUMNS or min(repeats) < 1:
        raise UserError(f"{path}: broken header, COUNT {' '.join(lines['COUNT'])[:60]}")
    fields = []
    for i, (name, letter, size, repeat) in enumerate(zip(names, kinds, sizes, repeats)):
        if (letter, size) not in _PCD_KINDS:
            raise UserError(f"{path}: field {name[:40]} has type {letter[:9]} of {size} bytes")
        used = name in (*_AXES, *_PCD_NORMALS) and repeat == names.count(name) == 1
        fields.append((name if used else f"unused {i}", _PCD_KINDS[letter, size], (repeat,)))
    missing = [axis for axis in _AXES if axis not in [name for name, _, _ in fields]]
    if missing:
        raise UserError(f"{path}: broken header, not one field {' '.join(missing)}")
    if data not in ("ascii", "binary", "binary_compressed"):
        raise UserError(f"{path}: broken header, DATA {data[:20]}")
    return fields, count, data


def _whole(path: Path, what: str, word: str) -> int:
    if not (word.isascii() and word.isdecimal() and len(word) <= 18):
        raise UserError(f"{path}: broken header, {what} is '{word[:40]}', not a whole number")
    return int(word)


def lzf_decompressed(data: bytes, size: int, source: str) -> bytearray:
    """Unpack a block of LZF, the compression of ``.pcd`` files (Marc Lehmann's liblzf).

    A control byte below 32 is followed by that many literal bytes and one more. A greater one
    copies bytes of the output: its upper 3 bits are the length less 2 (7: the next byte adds to
    it), its lower 5 bits and the next byte the distance less 1.

    Raises:
        UserError: the block is malformed, or its content is not of ``size`` bytes.
    """
    out, at = bytearray(), 0
    try:
        while at < len(data) and len(out) <= size:
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
                raise IndexError
            part = out[start : start + length]
            out += (part * -(-length // len(part)))[:length]  # it may reach into its own copy
    except IndexError:
        at = len(data) + 1
    if at > len(data) or len(out) != size:
        raise UserError(f"{source}: its compressed data are broken, or are not {size} bytes")
    return out


_READERS = {
    **{".xyz": _read_xyz, ".pts": _read_pts, ".pcd": _read_pcd},
    ".ply": lambda path: cloud_of(path, read_ply(path)),
}
_PCD_COUNTS = ("WIDTH", "HEIGHT", "POINTS")
_PCD_KINDS = {
    (letter, size): f"<{letter.lower()}{size}"
    for letter, sizes in {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}.items()
    for size in sizes
}
