"""Meshes of OFF, STL and PLY files, a part each."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import UserError
from .headers import BOM, Source, blocks_of, check_lines, compare_sizes, read_rows
from .materials import Material, SideFiles
from .parts import Part, cut_polygons, strip_faces, to_rgba8
from .ply_data import Columns, PlyData, PlyList, spread

# Attributes of vertices: texture coordinates, colours, normals. Some files of ModelNet40 have the
# counts behind the word, without a blank.
_OFF_LINES, _OFF_LINE = 1000, 1 << 12  # lines of a header, and letters of one
_OFF = re.compile(r"(ST)?(C)?(N)?OFF(?![A-Z])\s*(.*)")
_STL_HEAD = 84  # bytes of a binary file before its faces: a text and their count
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_CORNERS = ("vertex_indices", "vertex_index")
# Names of the channels of a colour, and of texture coordinates.
_RGBA = ("red", "green", "blue", "alpha")
_CHANNELS = (_RGBA, tuple(f"diffuse_{name}" for name in _RGBA), ("r", "g", "b", "a"))
_UVS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_TEXTURE = re.compile(r"TextureFile\s+(.*)", re.I)


def read_off(source: Source, sides: SideFiles) -> Iterator[Part]:
    """Yield the one part of a file.

    Raises:
        UserError: it holds less or more than its header states, or a word is not a number.
    """
    path, file, _ = source
    header = _OFF.fullmatch(_next_line(file))
    counts = (header[4] or _next_line(file)).split() if header else []
    text = file.read()
    if header is None or len(counts) < 2 or not all(w.isdecimal() for w in counts[:2]):
        raise UserError(f"{path}: broken header, expected OFF and the vertex and face counts")
    count, faces = (int(word[:18]) for word in counts[:2])
    rows = read_rows(text, str(path), comments=True)
    check_lines(path, f"{count} vertices and {faces} faces,", count + faces, len(rows.sizes))
    table = rows.part(0, count).table(f"{path}: vertices")
    if count and table.shape[1] < 3:
        raise UserError(f"{path}: row 1 has too few numbers")
    values, sizes = rows.part(count, faces)
    starts = np.cumsum(sizes) - sizes
    lengths = values[starts]
    bad = ~((lengths >= 0) & (lengths < sizes) & (lengths == np.rint(lengths)))
    if bad.any():
        raise UserError(f"{path}: row {count + bad.argmax() + 1} has too few numbers")
    points, lengths = table[:, :3], lengths.astype(np.int64)
    corners = values[spread(starts + 1, lengths)]
    places = cut_polygons(sides, points, corners, lengths)
    corners = corners.astype(np.int64)
    of_vertices = table[:, 6 if header[3] else 3 : -2 if header[1] else None]
    extra = sizes - 1 - lengths  # numbers behind a face's corners: a colour, or its index in a list
    colors = None
    if of_vertices.shape[1] in (3, 4):
        colors = to_rgba8(of_vertices)[corners[places]]
    elif (extra >= 3).any():
        some, width = extra >= 3, 4 if (extra[extra >= 3] >= 4).all() else 3
        of_faces = np.full((faces, 4), 255, np.uint8)
        of_faces[some] = to_rgba8(values[(starts + 1 + lengths)[some, None] + np.arange(width)])
        colors = of_faces[np.repeat(np.arange(faces), lengths)[places]]
    elif of_vertices.shape[1] or extra.any():
        sides.warnings.append("colours that are not RGB are left out")
    yield Part(points, corners[places], colors=colors)


def _next_line(file: BinaryIO) -> str:
    """Return the next line of the header that is not blank, without its comment."""
    for _ in range(_OFF_LINES):
        line = file.readline(_OFF_LINE).removeprefix(BOM).partition(b"#")[0].strip()
        if line:
            return line.decode("ascii", "replace")
    return ""


def read_stl(source: Source, sides: SideFiles) -> Iterator[Part]:
    """Yield the one part of a file; its faces share no vertices.

    A file is text if it begins with "solid", without zero bytes, and does not have the length of
    the binary file that it would be.

    Raises:
        UserError: it holds less than it states, or a word is not a number.
    """
    path, file, size = source
    data = file.read()
    count = struct.unpack_from("<I", data, 80)[0] if size >= _STL_HEAD else -1
    start = data[: 1 << 12].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if size != _STL_HEAD + 50 * count and start.startswith(b"solid") and b"\0" not in start:
        corners = _text_corners(path, data, sides)
    else:
        if size < _STL_HEAD:
            raise UserError(f"{path}: {size} bytes are too few for an .stl file")
        compare_sizes(path, f"{count} faces", 50 * count, size - _STL_HEAD, exact=False)
        behind = size - _STL_HEAD - 50 * count
        if behind and not count:
            raise UserError(f"{path}: its header states no faces, but {behind} bytes follow")
        if behind:
            sides.omit(f"{behind} bytes behind the faces are left out")
        faces = np.frombuffer(data, _STL_FACE, count, _STL_HEAD)
        if b"COLOR=" in data[:80] or (faces["attribute"] & 0x8000).any():
            sides.warnings.append("the colours of an .stl file are not read")
        corners = faces["corners"].reshape(-1, 3)
    yield Part(corners.astype(np.float64), np.arange(len(corners)).reshape(-1, 3))


def _text_corners(path: Path, data: bytes, sides: SideFiles) -> np.ndarray:
    """Return ``[3 F, 3]``; keywords begin a line, in either case, as a name may be any words."""
    counts, rows = {b"facet": 0, b"endfacet": 0, b"endsolid": 0}, []
    text = data.removeprefix(BOM).replace(b"\r", b"\n").lower()
    for block in blocks_of(text, str(path)):
        for line in block.split(b"\n"):
            word, *more = line.split(maxsplit=1) or [b""]
            if word in counts:
                counts[word] += 1
            elif word == b"vertex":
                rows += more or [b""]
    points = read_rows(b"\n".join(rows), str(path)).table(str(path), (3,))
    begun, ends, last = counts.values()
    if not last and len(points):
        sides.omit("there is no endsolid: the end of the file may be missing")
    if not begun == ends == len(points) / 3:
        says = f"{begun} facets, {ends} of them with an end, and {len(points)} vertices"
        raise UserError(f"{path}: truncated or invalid, {says}")
    return points


def ply_parts(data: PlyData, sides: SideFiles) -> Iterator[Part]:
    """Yield the one part of a file's content.

    Raises:
        UserError: vertices without a position, or faces without corners.
    """
    path = sides.path
    vertices, faces = data.elements.get("vertex", {}), data.elements.get("face", {})
    points = data.numbers("x", "y", "z")
    strips = {} if faces else data.elements.get("tristrips", {})
    columns = [(faces or strips).get(name) for name in _CORNERS]
    lists = [x for x in columns if isinstance(x, PlyList)]
    if points is None or not lists:
        raise UserError(f"{path}: its vertices have no x, y and z, or its faces no indices")
    for name in data.elements:
        if name not in ("vertex", "tristrips" if strips else "face"):
            sides.omit(f"the element {name[:60]} is not read")
    indices, lengths = lists[0]
    if strips:
        indices = np.insert(indices.astype(np.int64), np.cumsum(lengths), -1)
        indices = strip_faces(indices).reshape(-1)
        lengths = np.full(len(indices) // 3, 3)
    places = cut_polygons(sides, points, indices, lengths)
    corners = indices.astype(np.int64)[places]
    normals, colors = data.numbers("nx", "ny", "nz"), _colors(vertices)
    if colors is not None:
        colors = colors[corners]
    elif (of_faces := _colors(faces)) is not None:
        colors = of_faces[np.repeat(np.arange(len(lengths)), lengths)[places]]
    uvs, of_corners = None, faces.get("texcoord")
    names = next((pair for pair in _UVS if {*pair} <= vertices.keys()), None)
    if isinstance(of_corners, PlyList) and (of_corners.lengths == 2 * lengths).all():
        uvs = of_corners.values.reshape(-1, 2)[places]
    elif names is not None and (vertex_uvs := data.numbers(*names)) is not None:
        uvs = vertex_uvs[corners]
    material = None
    files = [m[1].strip() for m in map(_TEXTURE.match, data.header.comments) if m]
    if files:
        texture = sides.image(files[0])
        if len({*files}) > 1:
            sides.warnings.append(f"one of {len({*files})} textures is read")
        if texture is not None:
            material = Material(np.ones(4, np.float32), texture)
            if colors is not None:
                sides.warnings.append("colours with a texture are not drawn")
                colors = None
    normals = None if normals is None else normals[corners]
    yield Part(points, corners, material, normals, uvs, colors)


def _colors(columns: Columns) -> np.ndarray | None:
    """Return ``[N, 4]`` uint8 RGBA of an element; None without colours."""
    for names in _CHANNELS:
        rgba = [columns.get(name) for name in names]
        rgba = rgba[: 3 if rgba[3] is None else 4]
        if all(isinstance(channel, np.ndarray) for channel in rgba):
            return to_rgba8(np.stack(rgba, 1))  # pyright: ignore[reportArgumentType, reportCallIssue]
    return None
