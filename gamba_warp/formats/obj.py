"""Meshes of OBJ files, with the materials of their MTL files."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import UserError
from .headers import open_shape
from .materials import GREY, Material, SideFiles, plain, to_linear
from .parts import Part, color_range, cut_polygons, to_rgba8

MAX_MATERIALS = 20_000  # of a file: each is a part
MAX_LIBRARIES = 100  # MTL files of a file
_DIGITS = 15  # of an index
_NO_NUMBER = re.compile(rb"-?1\.#(IND|INF|QNAN|SNAN)\d*")  # as Microsoft's libraries print them
# Statements that change neither shape nor colours.
_IGNORED = {"g", "o", "s", "mg", "lod", "bevel", "shadow_obj", "trace_obj"}


def read_obj(path: Path, sides: SideFiles) -> Iterator[Part]:
    """Yield a part for each material.

    Raises:
        UserError: a line of vertices or faces is malformed, or a face names a missing vertex.
    """
    with open_shape(path) as (file, _):
        text = file.read().removeprefix(b"\xef\xbb\xbf").replace(b"\\\r\n", b" ")
    if text[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise UserError(f"{path}: text in UTF-16, an .obj file is in UTF-8")
    text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\\\n", b" ")
    text = _NO_NUMBER.sub(b"nan", text)
    statements = _Statements(path, text)
    for word in sorted(statements.unread)[:9]:
        sides.omit(f"the statement {word} is not read")
    if b"#MRGB" in text:
        sides.warnings.append("the colours of ZBrush (#MRGB) are not read")
    points = np.array(statements.points).reshape(-1, 3)
    vertex_uvs = np.array(statements.uvs).reshape(-1, 2)
    vertex_normals = np.array(statements.normals).reshape(-1, 3)
    corners = np.array(statements.corners, np.int64).reshape(-1, 3) - 1
    lengths = np.array(statements.lengths, np.int64)
    places = cut_polygons(sides, points, corners[:, 0], lengths)
    beyond = corners >= [len(points), len(vertex_uvs), len(vertex_normals)]
    if beyond.any():
        sides.warnings.append("faces name texture coordinates or normals that are not there")
        corners[beyond] = -1
    vertex_colors = None
    if statements.colors:
        vertex_colors = np.full((len(points), 4), 255, np.uint8)
        vertex_colors[statements.colored] = to_rgba8(np.array(statements.colors).reshape(-1, 3))
        vertex_colors = vertex_colors if (vertex_colors < 255).any() else None
    names = {name: number for number, name in enumerate(dict.fromkeys(statements.materials))}
    if len(names) > MAX_MATERIALS:
        raise UserError(f"{path}: uses {len(names)} materials, over the limit of {MAX_MATERIALS}")
    named = np.array([names[name] for name in statements.materials], np.int64)
    group = np.repeat(named, lengths)[places[:, 0]]
    order = np.argsort(group, kind="stable")
    library = _library(statements.libraries[:MAX_LIBRARIES], sides)
    for name, number in names.items():
        first, last = np.searchsorted(group, [number, number + 1], sorter=order)
        if first == last:
            continue
        at, uvs, normals = np.moveaxis(corners[places[order[first:last]]], -1, 0)
        used, faces = np.unique(at, return_inverse=True)
        own = next((x for x in (name, _bare(name)) if x in library), None)
        material = None if own is None else _material(library[own], own, sides)
        part = Part(points[used], faces.reshape(-1, 3), material)
        if (normals >= 0).all():
            part.normals = vertex_normals[normals]
        if (uvs >= 0).any():
            part.uvs = np.where(uvs[..., None] >= 0, vertex_uvs[uvs], 0.0)
        if vertex_colors is not None and material is not None and material.texture is not None:
            sides.warnings.append("colours beside a texture are not drawn")
        elif vertex_colors is not None:  # they stand for the material's
            part.colors = vertex_colors[at]
            if material is not None:
                material.color[:3] = 1.0
        yield part


class _Statements:
    """Statements of a file."""

    def __init__(self, path: Path, text: bytes) -> None:
        self.points, self.uvs, self.normals = array("d"), array("d"), array("d")
        self.colored, self.colors = array("q"), array("d")  # vertices with colours
        # Of each corner the indices of v, vt and vn from 1, or 0; of each face its corners.
        self.corners, self.lengths = array("q"), array("q")
        self.materials: list[str] = []  # of each face
        self.libraries: list[str] = []
        self.unread: set[str] = set()
        known: dict[bytes, list[int]] = {}
        material = ""
        for number, line in enumerate(text.split(b"\n"), 1):
            words = line.split()
            word = words[0] if words else b"#"
            try:
                if word in (b"v", b"vt", b"vn", b"f"):
                    if b"#" in line:
                        words = line.partition(b"#")[0].split()
                    if word == b"f":
                        for corner in words[1:]:
                            self.corners.extend(known.get(corner) or self._corner(corner, known))
                        self.lengths.append(len(words) - 1)
                        self.materials.append(material)
                    else:
                        self._numbers(word, [*map(float, words[1:])], b"_" in line)
                elif word in (b"usemtl", b"mtllib"):
                    name = line.strip()[7:].decode("utf-8", "replace").strip()
                    if word == b"mtllib":
                        self.libraries.append(name)
                    else:
                        material = name
                elif word.isalpha() and word.islower():
                    self.unread.add(word[:30].decode())
            except ValueError as error:
                shown = b" ".join(words)[:60].decode("ascii", "replace")
                message = f"line {number}, '{shown}', is not a valid vertex or face"
                raise UserError(f"{path}: {message}") from error
            except IndexError as error:
                raise UserError(f"{path}: a face names a vertex before the first") from error
        self.unread -= _IGNORED

    def _numbers(self, word: bytes, numbers: list[float], wrong: bool) -> None:
        """Add a line of numbers. Raises ValueError if they are too few."""
        if wrong or len(numbers) < (1 if word == b"vt" else 3):
            raise ValueError
        if word == b"vt":
            self.uvs.extend([*numbers, 0.0][:2])  # a texture may have one coordinate
        elif word == b"vn":
            self.normals.extend(numbers[:3])
        else:
            if len(numbers) >= 6:
                self.colored.append(len(self.points) // 3)
                self.colors.extend(numbers[3:6])
            w = numbers[3] if len(numbers) == 4 else 1.0  # homogeneous coordinates
            self.points.extend([x / w for x in numbers[:3]] if w else numbers[:3])

    def _corner(self, word: bytes, known: dict[bytes, list[int]]) -> list[int]:
        """Return the three indices of a corner. Raises ValueError, IndexError if one is invalid."""
        parts = word.split(b"/")
        digits = [part.removeprefix(b"-") for part in parts]
        if len(parts) > 3 or not parts[0] or int(parts[0]) == 0:
            raise ValueError
        if not all((part.isdigit() and len(part) <= _DIGITS) or not part for part in digits):
            raise ValueError
        numbers = [int(part or 0) for part in parts] + [0] * (3 - len(parts))
        if b"-" not in word:
            known[word] = numbers
            return numbers
        # Negative ones count back from their own line.
        totals = len(self.points) // 3, len(self.uvs) // 2, len(self.normals) // 3
        numbers = [n + total + 1 if n < 0 else n for n, total in zip(numbers, totals)]
        if min(n for n, part in zip(numbers, parts) if part) < 0 or numbers[0] < 1:
            raise IndexError
        return numbers


def _bare(name: str) -> str:
    """Return a name without a comment behind it; names of some programs have a # themselves."""
    return name.partition(" #")[0].strip()


def _library(lines: list[str], sides: SideFiles) -> dict[str, dict[str, str]]:
    """Return the statements of each material of the MTL files, by their keywords in lower case."""
    found: dict[str, dict[str, str]] = {}
    for line in dict.fromkeys(lines):
        options: dict[str, str] = {}
        for text in _library_texts(line, sides):
            for row in text.decode("utf-8-sig", "replace").splitlines():
                word, *rest = row.split(maxsplit=1) or [""]
                if word.lower() == "newmtl":
                    options, name = {}, " ".join(rest).strip()
                    found[name] = options
                    found.setdefault(_bare(name), options)
                elif rest:
                    options[word.lower()] = rest[0].strip()
    return found


def _library_texts(line: str, sides: SideFiles) -> list[bytes]:
    """Read the file of a line, whose name may have blanks, or else the files of its words."""
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
    if color is not None and color_range(color) > 1:
        sides.warnings.append(f"the colour of {name[:60]} goes to 255")
        color = color / 255
    picture = options.get("map_kd", options.get("map_ka"))
    if light is not None and light.any():
        if color is not None and not color.any() and picture is None:
            sides.warnings.append("light of a surface is drawn as its colour, shaded")
            color, picture = light, options.get("map_ke")
        else:
            sides.warnings.append("light of a surface beside its base colour is not drawn")
    texture = sides.picture(picture) if picture else None
    if texture is not None:
        color = np.ones(3)
        mask = sides.picture(options["map_d"], profiled=False) if "map_d" in options else None
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
