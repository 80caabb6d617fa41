"""Meshes of STL files, binary and text."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import UserError
from .headers import BOM, Lines, Source, blocks_of, compare_sizes, read_rows
from .materials import SideFiles
from .parts import Part

_HEAD = 84  # bytes of a binary file before its faces: a text and their count
_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(source: Source, sides: SideFiles) -> Iterator[Part]:
    """Yield the one part of a file; its faces share no vertices.

    A file is text if it begins with "solid", without zero bytes, and does not have the length of
    the binary file that it would be.

    Raises:
        UserError: it holds less than it states, or a word is not a number.
    """
    path, file, size = source
    data = file.read()
    count = struct.unpack_from("<I", data, 80)[0] if size >= _HEAD else -1
    start = data[: 1 << 12].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if size != _HEAD + 50 * count and start.startswith(b"solid") and b"\0" not in start:
        corners = _text_corners(path, data, sides)
    else:
        if size < _HEAD:
            raise UserError(f"{path}: {size} bytes are too few for an .stl file")
        compare_sizes(path, f"{count} faces", 50 * count, size - _HEAD, exact=False)
        behind = size - _HEAD - 50 * count
        if behind and not count:
            raise UserError(f"{path}: its header states no faces, but {behind} bytes follow")
        if behind:
            sides.omit(f"{behind} bytes behind the faces are left out")
        faces = np.frombuffer(data, _FACE, count, _HEAD)
        if b"COLOR=" in data[:80] or (faces["attribute"] & 0x8000).any():
            sides.warnings.append("the colours of an .stl file are not read")
        corners = faces["corners"].reshape(-1, 3)
    yield Part(corners.astype(np.float64), np.arange(len(corners)).reshape(-1, 3))


def _text_corners(path: Path, data: bytes, sides: SideFiles) -> np.ndarray:
    """Return ``[3 F, 3]``; keywords begin a line, in either case, as a name may be any words."""
    begun = ends = last = 0
    rows = []
    text = data.removeprefix(BOM).replace(b"\r", b"\n").lower()
    for block in blocks_of(text, str(path)):
        lines = Lines(block)
        begun, ends, last = (
            count + np.count_nonzero(lines.begin_with(word))
            for count, word in ((begun, b"facet"), (ends, b"endfacet"), (last, b"endsolid"))
        )
        rows.append(lines.behind(b"vertex", lines.begin_with(b"vertex")))
    points = read_rows(b"".join(rows), str(path)).table(str(path), (3,))
    if not last and len(points):
        sides.omit("there is no endsolid: the end of the file may be missing")
    if not begun == ends == len(points) / 3:
        says = f"{begun} facets, {ends} of them with an end, and {len(points)} vertices"
        raise UserError(f"{path}: truncated or invalid, {says}")
    return points
