"""Meshes of OBJ files, and the materials of the MTL files that they name."""

from __future__ import annotations

import io
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import UserError
from ..images import open_picture, to_rgba
from .headers import open_shape
from .materials import GREY, Material, SideFiles, plain, to_linear
from .parts import Part, cut_polygons, to_rgba8

MAX_MATERIALS = 20_000  # of a file: each is a part
MAX_LIBRARIES = 100  # MTL files of a file
_DIGITS = 15  # of an index
# Statements that change neither shape nor colours.
_PASSED = {"g", "o", "s", "mg", "lod", "bevel", "shadow_obj", "trace_obj"}


def read_obj(path: Path, sides: SideFiles) -> Iterator[Part]:
    """Yields a part for each material.

    Raises:
        UserError: a line of vertices or faces is none, or a face names a vertex that is not there.
    """
    with open_shape(path) as (file, _):
        text = file.read().removeprefix(b"\xef\xbb\xbf").replace(b"\\\r\n", b" ")
    text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\\\n", b" ")
    found = _Statements(path, text)
    for word in sorted(found.unread)[:9]:
        sides.omit(f"the statement {word} is not read")
    if b"#MRGB" in text:
        sides.warnings.append("the colours of ZBrush (#MRGB) are not read")
    points = np.array(found.points).reshape(-1, 3)
    flat = np.array(found.flat).reshape(-1, 2)
    straight = np.array(found.straight).reshape(-1, 3)
    corners = np.array(found.corners, np.int64).reshape(-1, 3) - 1
    lengths = np.array(found.lengths, np.int64)
    places = cut_polygons(sides, points, corners[:, 0], lengths)
    beyond = corners >= [len(points), len(flat), len(straight)]
    if beyond.any():
        sides.warnings.append("faces name texture coordinates or normals that are not there")
        corners[beyond] = -1
    painted = None
    if found.colors:
        painted = np.full((len(points), 4), 255, np.uint8)
        painted[found.painted] = to_rgba8(np.array(found.colors).reshape(-1, 3))
        painted = painted if (painted < 255).any() else None
    names = {name: number for number, name in enumerate(dict.fromkeys(found.materials))}
    if len(names) > MAX_MATERIALS:
        raise UserError(f"{path}: uses {len(names)} materials, over the limit of {MAX_MATERIALS}")
    named = np.array([names[name] for name in found.materials], np.int64)
    group = np.repeat(named, lengths)[places[:, 0]]
    order = np.argsort(group, kind="stable")
    library = _library(found.libraries[:MAX_LIBRARIES], sides)
    for name, number in names.items():
        first, last = np.searchsorted(group, [number, number + 1], sorter=order)
        if first == last:
            continue
        at, uvs, normals = np.moveaxis(corners[places[order[first:last]]], -1, 0)
        used, faces = np.unique(at, return_inverse=True)
        part = Part(points[used], faces.reshape(-1, 3))
        if name in library:
            part.material = _material(library[name], name, sides)
        if (normals >= 0).all():
            part.normals = straight[normals]
        if (uvs >= 0).any():
            part.uvs = np.where(uvs[..., None] >= 0, flat[uvs], 0.0)
        if painted is not None and part.material is not None and part.material.texture is not None:
            sides.warnings.append("colours beside a texture are not drawn")
        elif painted is not None:  # they stand for the material's
            part.colors = painted[at]
            if part.material is not None:
                part.material.color[:3] = 1.0
        yield part


class _Statements:
    """Statements of a file, line by line."""

    def __init__(self, path: Path, text: bytes) -> None:
        self.points, self.flat, self.straight = array("d"), array("d"), array("d")
        self.painted, self.colors = array("q"), array("d")  # vertices with colours
        # Of each corner the numbers of v, vt and vn from 1, 0 for none; of each face their number.
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
                message = f"{path}: line {number}, '{shown}', is no vertex or face"
                raise UserError(message) from error
            except IndexError as error:
                raise UserError(f"{path}: a face names a vertex before the first") from error
        self.unread -= _PASSED

    def _numbers(self, word: bytes, numbers: list[float], wrong: bool) -> None:
        """Takes a line of numbers. Raises ValueError where they are too few."""
        if wrong or len(numbers) < (1 if word == b"vt" else 3):
            raise ValueError
        if word == b"vt":
            self.flat.extend([*numbers, 0.0][:2])  # a texture may have one coordinate
        elif word == b"vn":
            self.straight.extend(numbers[:3])
        else:
            if len(numbers) >= 6:
                self.painted.append(len(self.points) // 3)
                self.colors.extend(numbers[3:6])
            self.points.extend(numbers[:3])

    def _corner(self, word: bytes, known: dict[bytes, list[int]]) -> list[int]:
        """The three numbers of a corner. Raises ValueError, IndexError where one is none."""
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
        # They count back from their own line.
        totals = len(self.points) // 3, len(self.flat) // 2, len(self.straight) // 3
        numbers = [n + total + 1 if n < 0 else n for n, total in zip(numbers, totals)]
        if min(n for n, part in zip(numbers, parts) if part) < 0 or numbers[0] < 1:
            raise IndexError
        return numbers


def _library(lines: list[str], sides: SideFiles) -> dict[str, dict[str, str]]:
    """Statements of each material of the MTL files, by their keywords in lower case."""
    found: dict[str, dict[str, str]] = {}
    for line in dict.fromkeys(lines):
        options: dict[str, str] = {}
        for text in _library_texts(line, sides):
            for row in text.decode("utf-8-sig", "replace").splitlines():
                word, *rest = row.split(maxsplit=1) or [""]
                if word.lower() == "newmtl":
                    options = found[" ".join(rest).strip()] = {}
                elif rest:
                    options[word.lower()] = rest[0].strip()
    return found


def _library_texts(line: str, sides: SideFiles) -> list[bytes]:
    """The files of a line of names: of one name, which may have blanks, or of several."""
    words = line.split()[:MAX_LIBRARIES]
    texts, reasons = [], []
    for name in (line, *(words if len(words) > 1 else ())):
        try:
            texts.append(sides.read(name))
        except UserError as error:
            reasons.append(str(error))
        if texts and name == line:
            return texts
    sides.warnings += reasons[1:] if texts else reasons[:1]
    return texts


def _material(options: dict[str, str], name: str, sides: SideFiles) -> Material:
    """A material of an MTL file: a texture in place of a colour, light where it is black."""
    color, light = _color(options, "kd"), _color(options, "ke")
    picture = options.get("map_kd")
    if light is not None and light.any():
        if color is not None and not color.any() and picture is None:
            color, picture = light, options.get("map_ke")
        else:
            sides.warnings.append("light of a surface beside its base colour is not drawn")
    texture = sides.picture(picture) if picture else None
    if texture is not None:
        color = np.ones(3)
        if "map_d" in options:
            _mask(texture, options["map_d"], sides)
    elif color is None:
        color = np.full(3, GREY)
    opacity = _opacity(options)
    if opacity < 1 / 255:
        sides.warnings.append(f"the material {name[:60]} would be invisible: it is drawn opaque")
        opacity = 1.0
    return Material(plain(np.append(to_linear(color), opacity)), texture)


def _color(options: dict[str, str], word: str) -> np.ndarray | None:
    """Three display values; None without them. One value stands for three."""
    try:
        values = [float(value) for value in options.get(word, "").split()[:3]]
    except ValueError:  # the name of a file of spectra
        return None
    return np.array(values * 3)[:3] if values else None


def _opacity(options: dict[str, str]) -> float:
    """MTL's ``d`` (1 is opaque) or ``Tr`` (0 is opaque)."""
    for word in ("d", "tr"):
        try:
            value = float(options[word].split()[-1])
        except (KeyError, IndexError, ValueError):
            continue
        return float(np.clip(value if word == "d" else 1 - value, 0, 1))
    return 1.0


def _mask(texture: np.ndarray, name: str, sides: SideFiles) -> None:
    """Gives a texture the alpha of MTL's ``map_d``: that picture's alpha, or its grey."""
    shown = " ".join(name[:100].split())
    try:
        with open_picture(io.BytesIO(sides.read(name)), shown) as image:
            rgba = Image.fromarray(to_rgba(image, shown, profiled=False))
            alpha = rgba.getchannel("A")
            if alpha.getextrema()[0] == 255:
                alpha = rgba.convert("L")
            texture[..., 3] = np.asarray(alpha.resize((texture.shape[1], texture.shape[0])))
    except UserError as error:
        sides.warnings.append(str(error))
