"""Meshes of OFF files, with the colours of their vertices or faces."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from ..errors import UserError
from .headers import BOM, Source, check_lines, read_rows
from .materials import SideFiles
from .parts import Part, cut_polygons, to_rgba8
from .ply_data import spread

# Attributes of vertices: texture coordinates, colours, normals. Some files of ModelNet40 have the
# counts behind the word, without a blank.
_HEADER_LINES, _HEADER_LINE = 1000, 1 << 12  # lines of a header, and letters of one
_HEADER = re.compile(r"(ST)?(C)?(N)?OFF(?![A-Z])\s*(.*)")


def read_off(source: Source, sides: SideFiles) -> Iterator[Part]:
    """Yield the one part of a file.

    Raises:
        UserError: it holds less or more than its header states, or a word is not a number.
    """
    path, file, _ = source
    found = _HEADER.fullmatch(_next_line(file))
    counts = (found[4] or _next_line(file)).split() if found else []
    text = file.read()
    if found is None or len(counts) < 2 or not all(w.isdecimal() for w in counts[:2]):
        raise UserError(f"{path}: broken header, expected OFF and the vertex and face counts")
    count, faces = (int(word[:18]) for word in counts[:2])
    rows = read_rows(text, str(path), comments=True)
    check_lines(path, f"{count} vertices and {faces} faces,", count + faces, len(rows.sizes))
    table = rows.part(0, count).table(f"{path}: vertices")
    if count and table.shape[1] < 3:
        raise UserError(f"{path}: row 1 has too few numbers")
    numbers, sizes = rows.part(count, faces)
    starts = np.cumsum(sizes) - sizes
    lengths = numbers[starts]
    bad = ~((lengths >= 0) & (lengths < sizes) & (lengths == np.rint(lengths)))
    if bad.any():
        raise UserError(f"{path}: row {count + bad.argmax() + 1} has too few numbers")
    points, lengths = table[:, :3], lengths.astype(np.int64)
    corners = numbers[spread(starts + 1, lengths)]
    places = cut_polygons(sides, points, corners, lengths)
    corners = corners.astype(np.int64)
    of_vertices = table[:, 6 if found[3] else 3 : -2 if found[1] else None]
    rest = sizes - 1 - lengths  # numbers behind a face's corners: a colour, or its index in a list
    colors = None
    if of_vertices.shape[1] in (3, 4):
        colors = to_rgba8(of_vertices)[corners[places]]
    elif (rest >= 3).any():
        some, width = rest >= 3, 4 if (rest[rest >= 3] >= 4).all() else 3
        of_faces = np.full((faces, 4), 255, np.uint8)
        of_faces[some] = to_rgba8(numbers[(starts + 1 + lengths)[some, None] + np.arange(width)])
        colors = of_faces[np.repeat(np.arange(faces), lengths)[places]]
    elif of_vertices.shape[1] or rest.any():
        sides.warnings.append("colours that are not RGB are left out")
    yield Part(points, corners[places], colors=colors)


def _next_line(file: BinaryIO) -> str:
    """Return the next line of the header that is not blank, without its comment."""
    for _ in range(_HEADER_LINES):
        line = file.readline(_HEADER_LINE).removeprefix(BOM).partition(b"#")[0].strip()
        if line:
            return line.decode("ascii", "replace")
    return ""
