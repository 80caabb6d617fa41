"""Independent second reader of point clouds."""

import math
import re

import numpy as np

_COMMENTS = (b"#", b"//")


def points_in(data: bytes, suffix: str) -> np.ndarray | str | None:
    """The points of a text cloud, or the number of points of a binary one.

    Args:
        data: the file.
        suffix: ".xyz" or ".ply".

    Returns:
        ``[N, 3]`` float64 of a text; the reason why it is not a cloud; or None if unknown.
    """
    if suffix == ".ply":
        return _ply(data)
    lines = [line for line in _lines(data) if not line.lstrip().startswith(_COMMENTS)]
    return _table(lines, [0, 1, 2])


def vertices_stated(data: bytes, suffix: str) -> int | None:
    """Number of vertices in the header of a mesh, or None if it has none."""
    if suffix == ".ply":
        found = re.findall(rb"^element[ \t]+vertex[ \t]+(\d+)\s*$", data[:4096], re.MULTILINE)
        return int(found[0]) if len(found) == 1 else None
    if suffix == ".stl" and not data.lstrip().startswith(b"solid") and len(data) >= 84:
        return 3 * int.from_bytes(data[80:84], "little")
    return None


def _lines(data: bytes) -> list[bytes]:
    data = data.removeprefix(b"\xef\xbb\xbf")  # a byte order mark
    return [line for line in data.replace(b"\r", b"\n").split(b"\n") if line.strip()]


def _table(lines: list[bytes], columns: list[int]) -> np.ndarray | str:
    rows = []
    for line in lines:
        words = line.replace(b",", b" ").replace(b";", b" ").split()
        try:
            row = [float(words[column]) for column in columns]
        except (ValueError, IndexError):
            return f"the line {line[:30]!r} is no point"
        if not all(map(math.isfinite, row)):
            return f"the line {line[:30]!r} is not finite"
        rows.append(row)
    return np.array(rows, np.float64).reshape(-1, 3)


def _ply(data: bytes) -> np.ndarray | str | None:
    head, end, rest = data.partition(b"\nend_header")
    lines = [line.split() for line in head.splitlines()]
    elements = [words for words in lines if words[:1] == [b"element"]]
    names = [words[-1] for words in lines if words[:1] == [b"property"]]
    if not end or [b"format", b"ascii", b"1.0"] not in lines or len(elements) != 1:
        return None
    if any(names.count(axis) != 1 for axis in (b"x", b"y", b"z")) or not elements[0][2].isdigit():
        return None
    rows = _lines(rest.partition(b"\n")[2])
    if len(rows) != int(elements[0][2]):
        return f"it states {int(elements[0][2])} points and has {len(rows)} lines"
    return _table(rows, [names.index(axis) for axis in (b"x", b"y", b"z")])
