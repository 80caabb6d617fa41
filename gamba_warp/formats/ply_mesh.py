"""Meshes of ``.ply`` files: polygons with normals, colours and textures."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from ..errors import UserError
from .materials import Material, SideFiles
from .parts import Part, cut_polygons, strip_faces, to_rgba8
from .ply_data import Columns, PlyData, PlyList

_CORNERS = ("vertex_indices", "vertex_index")
# Names of the channels of a colour, and of texture coordinates.
_RGBA = ("red", "green", "blue", "alpha")
_CHANNELS = (_RGBA, tuple(f"diffuse_{name}" for name in _RGBA), ("r", "g", "b", "a"))
_UVS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_TEXTURE = re.compile(r"TextureFile\s+(.*)", re.I)


def ply_parts(data: PlyData, sides: SideFiles) -> Iterator[Part]:
    """Yield the one part of a file's content.

    Raises:
        UserError: vertices without a position, or faces without corners.
    """
    path = sides.path
    vertices, faces = data.elements.get("vertex", {}), data.elements.get("face", {})
    points = data.numbers("x", "y", "z")
    strips = {} if faces else data.elements.get("tristrips", {})
    found = [(faces or strips).get(name) for name in _CORNERS]
    lists = [x for x in found if isinstance(x, PlyList)]
    if points is None or not lists:
        raise UserError(f"{path}: its vertices have no x, y and z, or its faces no indices")
    for name in data.elements:
        if name not in ("vertex", "tristrips" if strips else "face"):
            sides.omit(f"the element {name[:60]} is not read")
    given, lengths = lists[0]
    if strips:
        given = np.insert(given.astype(np.int64), np.cumsum(lengths), -1)
        given = strip_faces(given).reshape(-1)
        lengths = np.full(len(given) // 3, 3)
    places = cut_polygons(sides, points, given, lengths)
    corners = given.astype(np.int64)[places]
    normals, colors = data.numbers("nx", "ny", "nz"), _colors(vertices)
    if colors is not None:
        colors = colors[corners]
    elif (of_faces := _colors(faces)) is not None:
        colors = of_faces[np.repeat(np.arange(len(lengths)), lengths)[places]]
    uvs, of_corners = None, faces.get("texcoord")
    names = next((pair for pair in _UVS if {*pair} <= vertices.keys()), None)
    if isinstance(of_corners, PlyList) and (of_corners.lengths == 2 * lengths).all():
        uvs = of_corners.values.reshape(-1, 2)[places]
    elif names is not None and (found := data.numbers(*names)) is not None:
        uvs = found[corners]
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
