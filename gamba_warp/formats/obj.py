"""Meshes of OBJ files, with the materials of their MTL files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from ..color_spaces import to_linear
from ..errors import UserError
from .headers import BOM, Rows, Source, blocks_of, is_number, joined_rows, parse_numbers
from .materials import GREY, Material, SideFiles, plain
from .parts import Part, color_range, cut_polygons, to_rgba8

MAX_MATERIALS = 20_000  # of a file: each is a part
MAX_LIBRARIES = 100  # MTL files of a file
_DIGITS = 15  # of an index
_NO_NUMBER = re.compile(rb"-?1\.#(IND|INF|QNAN|SNAN)\d*")  # as Microsoft's libraries print them
_CORNER = re.compile(rb"-?0*[1-9]\d{0,14}(/(-?\d{1,15})?){0,2}")
_LEAST = {b"v": 3, b"vt": 1, b"vn": 3}  # numbers of a line at least, by its first word
# Statements that change neither shape nor colours.
_IGNORED = {"g", "o", "s", "mg", "lod", "bevel", "shadow_obj", "trace_obj"}


def read_obj(source: Source, sides: SideFiles) -> Iterator[Part]:
    """Yield a part for each material.

    Raises:
        UserError: a line of vertices or faces is malformed, or a face names a missing vertex.
    """
    path = source.path
    text = source.file.read().removeprefix(BOM).replace(b"\\\r\n", b" ")
    if text[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise UserError(f"{path}: text in UTF-16, but an .obj file must be UTF-8")
    text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\\\n", b" ")
    if b"1.#" in text:
        text = _NO_NUMBER.sub(b"nan", text)
    if b"#MRGB" in text:
        sides.warnings.append("the colours of ZBrush (#MRGB) are not read")
    statements = _Statements(path, text)
    del text
    for word in sorted(statements.unread - _IGNORED)[:9]:
        sides.omit(f"the statement {word} is not read")
    vertices, uvs, normals = map(joined_rows, statements.rows.values())
    points, colors = _vertices(vertices)
    # A texture may have one coordinate.
    vertex_uvs, vertex_normals = uvs.columns(0, 1), normals.columns(0, 1, 2)
    vertex_uvs[uvs.sizes < 2, 1] = 0.0
    corners, lengths = np.concatenate(statements.corners) - 1, np.concatenate(statements.lengths)
    places = cut_polygons(sides, points, corners[:, 0], lengths)
    beyond = corners >= [len(points), len(vertex_uvs), len(vertex_normals)]
    if beyond.any():
        sides.warnings.append("faces name texture coordinates or normals that are not there")
        corners[beyond] = -1
    at, used = np.transpose(statements.used)
    group = used[np.searchsorted(at, np.concatenate(statements.faces)) - 1]
    if (lengths != 3).any():
        group = np.repeat(group, np.maximum(lengths - 2, 0))
    ids, first = np.unique(group, return_index=True)
    if len(ids) > MAX_MATERIALS:
        raise UserError(f"{path}: uses {len(ids)} materials, over the limit of {MAX_MATERIALS}")
    names, library = [*statements.names], _library(statements.libraries[:MAX_LIBRARIES], sides)
    order = np.argsort(group, kind="stable")
    ends = np.searchsorted(group, ids, "right", sorter=order)
    for i in np.argsort(first):
        triangles = places[order[ends[i - 1] if i else 0 : ends[i]]]
        name = names[ids[i]]
        key = next((x for x in (name, _bare(name)) if x in library), None)
        material = None if key is None else _material(library[key], key, sides)
        part = Part(points, corners[triangles, 0], material)
        if len(vertex_normals) and (corners[triangles, 2] >= 0).all():
            part.normals = vertex_normals[corners[triangles, 2]]
        if len(vertex_uvs) and (at := corners[triangles, 1]).max(initial=-1) >= 0:
            part.uvs = np.where(at[..., None] >= 0, vertex_uvs[at], 0.0)
        if colors is not None and material is not None and material.texture is not None:
            sides.warnings.append("colours with a texture are not drawn")
        elif colors is not None:  # they stand for the material's
            part.colors = colors[part.faces]
            if material is not None:
                material.color[:3] = 1.0
        yield part


def _vertices(rows: Rows) -> tuple[np.ndarray, np.ndarray | None]:
    """Return positions ``[V, 3]``, and colours ``[V, 4]`` uint8 if one is not white."""
    points = rows.columns(0, 1, 2)
    if (homogeneous := rows.sizes == 4).any():
        w = np.where(homogeneous[:, None], rows.columns(3), 1.0)
        points /= np.where(w == 0, 1.0, w)
    if not (colored := rows.sizes >= 6).any():
        return points, None
    colors = np.full((len(points), 4), 255, np.uint8)
    colors[colored] = to_rgba8(rows.columns(3, 4, 5)[colored])
    return points, colors if (colors < 255).any() else None


class _Statements:
    """Statements of a file.

    Attributes:
        rows: numbers of the lines of ``v``, ``vt`` and ``vn``, by block.
        corners: by block ``[C, 3]`` int64, of each corner the indices of v, vt and vn from 1, or 0.
        lengths: by block ``[F]``, number of corners of each face.
        faces: by block ``[F]``, line of each face.
        names: numbers of the materials by name; 0 for faces without a material.
        used: lines of usemtl, and numbers of the materials.
        libraries: names of MTL files.
        unread: first words of other statements.
    """

    def __init__(self, path: Path, text: bytes) -> None:
        none = np.zeros(0, np.int64)
        self.rows = {word: [Rows(np.zeros(0), none)] for word in _LEAST}
        self.corners, self.lengths, self.faces = [np.zeros((0, 3), np.int64)], [none], [none]
        self.libraries, self.unread = list[str](), set[str]()
        self.names = {"": 0}
        self.used = [(-1, 0)]
        self._totals = np.zeros(3, np.int64)  # of v, vt and vn in the blocks before
        line = 0
        for block in blocks_of(text, str(path)):
            lines = block.removesuffix(b"\n").split(b"\n")
            if not self._read(path, lines, line):
                raise _invalid_line(path, lines, line)
            line += len(lines)

    def _read(self, path: Path, lines: list[bytes], start: int) -> bool:
        """Read a block whose first line has this number; return False if a line is invalid."""
        words: dict[bytes, list[bytes]] = {word: [] for word in (*_LEAST, b"f")}
        sizes: dict[bytes, list[int]] = {word: [] for word in words}  # words of each line
        faces, before = [], []  # lines of faces; numbers of v, vt and vn before each
        for number, line in enumerate(lines, start):
            word = next(iter(line.split(maxsplit=1)), b"")
            if word in words:
                more = line.partition(b"#")[0].split()[1:]
                words[word] += more
                sizes[word].append(len(more))
                if word == b"f":
                    faces.append(number)
                    before.append([len(sizes[other]) for other in _LEAST])
            elif word in (b"mtllib", b"usemtl"):
                name = line.strip()[len(word) :].decode("utf-8", "replace").strip()
                if word == b"mtllib":
                    self.libraries.append(name)
                else:
                    self.used.append((number, self.names.setdefault(name, len(self.names))))
            elif word.isalpha() and word.islower():
                self.unread.add(word[:30].decode())
        for word, least in _LEAST.items():
            values = parse_numbers(b" ".join(words[word]), len(words[word]))
            if values is None or min(sizes[word], default=least) < least:
                return False
            self.rows[word].append(Rows(values, np.array(sizes[word], np.int64)))
        corners, lengths = _corners(words[b"f"]), np.array(sizes[b"f"], np.int64)
        if corners is None:
            return False
        if (corners < 0).any():  # they count back from their own line
            totals = self._totals + np.array(before)
            corners += np.where(corners < 0, np.repeat(totals, lengths, axis=0) + 1, 0)
            if (corners < [1, 0, 0]).any():
                raise UserError(f"{path}: a face refers to a vertex before the first")
        self._totals += [len(sizes[word]) for word in _LEAST]
        self.corners.append(corners)
        self.lengths.append(lengths)
        self.faces.append(np.array(faces, np.int64))
        return True


def _corners(words: list[bytes]) -> np.ndarray | None:
    """Read the corners of faces: ``7``, ``7/8``, ``7//9`` or ``7/8/9``.

    Returns:
        ``[C, 3]`` int64, the indices as written, 0 where one is missing; None if one is invalid.
    """
    text = b" ".join(words) + b" "
    letters = np.frombuffer(text, np.uint8)
    slash = letters == ord("/")
    inside = (letters - np.uint8(ord("0")) < 10) | (letters == ord("-"))
    if not (inside | slash | (letters == ord(" "))).all() or b"///" in text:
        return None
    starts = np.flatnonzero(inside & ~np.append(False, inside[:-1]))
    indices = parse_numbers(text.replace(b"/", b" "), len(starts), np.int64)
    if indices is None or (np.abs(indices) >= 10**_DIGITS).any():
        return None
    # Steps from one number to the next: a slash, two, or none before the first of a corner.
    steps = slash[starts - 1].astype(np.int8) + (slash[starts - 1] & slash[starts - 2])
    heads = np.flatnonzero(steps == 0)
    if len(heads) != len(words):  # a corner begins with a slash
        return None
    within = np.arange(len(starts)) - np.repeat(heads, np.diff(heads, append=len(starts)))
    places = steps + np.where(within == 2, np.roll(steps, 1), 0)
    if (within > 2).any() or (places > 2).any():
        return None
    corners = np.zeros((len(heads), 3), np.int64)
    corners[np.cumsum(steps == 0) - 1, places] = indices
    return None if (corners[:, 0] == 0).any() else corners


def _invalid_line(path: Path, lines: list[bytes], before: int) -> UserError:
    """Return the error of the first invalid line of a block, ``before`` lines from the start."""
    for number, line in enumerate(lines, before + 1):
        words = line.partition(b"#")[0].split() or [b""]
        if words[0] == b"f":
            valid = all(_CORNER.fullmatch(word) for word in words[1:])
        else:
            least = _LEAST.get(words[0], 0)
            valid = words[0] not in _LEAST or len(words) > least and all(map(is_number, words[1:]))
        if not valid:
            shown = b" ".join(words)[:60].decode("ascii", "replace")
            return UserError(f"{path}: line {number}, '{shown}', is not a valid vertex or face")
    return UserError(f"{path}: not a valid .obj file")


def _bare(name: str) -> str:
    """Return a name without a trailing comment; some programs write a # in names."""
    return name.partition(" #")[0].strip()


def _library(lines: list[str], sides: SideFiles) -> dict[str, dict[str, str]]:
    """Return the statements of each material of the MTL files, by their keywords in lower case."""
    library: dict[str, dict[str, str]] = {}
    for line in dict.fromkeys(lines):
        options: dict[str, str] = {}
        for text in _library_texts(line, sides):
            for row in text.decode("utf-8-sig", "replace").splitlines():
                word, *values = row.split(maxsplit=1) or [""]
                if word.lower() == "newmtl":
                    options, name = {}, " ".join(values).strip()
                    library[name] = options
                    library.setdefault(_bare(name), options)
                elif values:
                    options[word.lower()] = values[0].strip()
    return library


def _library_texts(line: str, sides: SideFiles) -> list[bytes]:
    """Read the file that a line names, with any blanks, else one file for each word."""
    words = _bare(line).split()[:MAX_LIBRARIES]
    texts, reasons = [], []
    for name in dict.fromkeys((line, _bare(line), *words)):
        try:
            texts.append(sides.read(name))
        except UserError as error:
            reasons.append(str(error))
        if texts and name == line:
            return texts
    sides.warnings += reasons[1:] if texts else reasons[:1]
    return texts


def _material(options: dict[str, str], name: str, sides: SideFiles) -> Material:
    """Return a material of an MTL file: a texture replaces the colour, light replaces black."""
    color, light = _color(options, "kd"), _color(options, "ke")
    if color is None and "kd" in options:
        sides.warnings.append(f"the colour of {name[:60]} is not read: Kd {options['kd'][:60]}")
    if color is not None and color_range(color) > 1:
        sides.warnings.append(f"the colour of {name[:60]} goes to 255")
        color = color / 255
    file = options.get("map_kd", options.get("map_ka"))
    if light is not None and light.any():
        if color is not None and not color.any() and file is None:
            sides.warnings.append("emission of a surface is drawn as its base colour, shaded")
            color, image = light, options.get("map_ke")
        else:
            sides.warnings.append("emission of a surface with a base colour is not drawn")
    texture = sides.image(file) if file else None
    if texture is not None:
        color = np.ones(3)
        mask = sides.image(options["map_d"], profiled=False) if "map_d" in options else None
        if mask is not None:  # its alpha, or its grey
            image = Image.fromarray(mask)
            alpha = image.getchannel("A") if mask[..., 3].min() < 255 else image.convert("L")
            texture[..., 3] = np.asarray(alpha.resize((texture.shape[1], texture.shape[0])))
    elif color is None:
        color = np.full(3, GREY)
    # "d" is 1 where opaque, "Tr" is 0; the number stands last, behind options.
    opaque, clear = (_numbers(options.get(word, "").split()[-1:]) for word in ("d", "tr"))
    opacity = np.clip([*opaque, *(1 - x for x in clear), 1.0][0], 0, 1)
    if opacity < 1 / 255:
        sides.warnings.append(f"the material {name[:60]} would be invisible: it is drawn opaque")
        opacity = 1.0
    return Material(plain(np.append(to_linear(color), opacity)), texture)


def _color(options: dict[str, str], word: str) -> np.ndarray | None:
    """Return three display values, None without them; one value stands for three."""
    values = _numbers(options.get(word, "").split()[:3])
    return np.array(values * 3)[:3] if values else None


def _numbers(words: list[str]) -> list[float]:
    """Return the words as numbers; none for others, such as the name of a file of spectra."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []
