"""Meshes of OBJ files, and the materials of the MTL files that they name."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import UserError
from ..images import open_picture
from .headers import open_shape
from .materials import GREY, Material, SideFiles, plain, to_linear
from .parts import Part, to_rgba8
from .polygons import cut_polygons

MAX_MATERIALS = 20_000  # of a file: each is a part
MAX_LIBRARIES = 100  # MTL files of a file

# Digits, and blanks between numbers, can be read in one way only: the time is linear in the line.
_EXPONENT = rb"(?:[eE][-+]?\d+)?"
_FINITE = rb"(?:\d+(?:\.\d*)?|\.\d+)" + _EXPONENT
_NUMBER = rb"[-+]?(?:" + _FINITE + rb"|[nN][aA][nN]|[iI][nN][fF])(?= |$)"
_CORNER = rb"-?0{0,9}[1-9]\d{0,14}(?:/-?\d{0,15}){0,2}(?= |$)"
_BAD = re.compile(
    rb"(?m)^(?:vn? (?!(?: *" + _NUMBER + rb"){3,} *$)|vt (?!(?: *" + _NUMBER + rb")+ *$)"
    rb"|f (?!(?: *" + _CORNER + rb")+ *$)).*"
)
_COMMENT = re.compile(rb"(?m)^((?:v|vt|vn|f) [^\n#]*(?<= ))#.*")
_UNREAD = re.compile(rb"(?m)^(?!(?:v|vt|vn|f|g|o|s|usemtl|mtllib)(?: |$))([a-z]\w{0,30})(?: |$)")


def read_obj(path: Path, sides: SideFiles) -> Iterator[Part]:
    """Yields a part for each material.

    Raises:
        UserError: a line of vertices or faces is none, or a face names a vertex that is not there.
    """
    with open_shape(path) as (file, _):
        text = _plain_lines(file.read())
    bad = _BAD.search(text)
    if bad:
        line = " ".join(bad[0][:60].decode("ascii", "replace").split())
        number = text.count(b"\n", 0, bad.start()) + 1
        raise UserError(f"{path}: line {number}, '{line}', is no vertex or face")
    for word in sorted({*_UNREAD.findall(text)})[:9]:
        sides.warnings.append(f"the statement {word.decode()} is not read")
    if b"#MRGB" in text:
        sides.warnings.append("the colours of ZBrush (#MRGB) are not read")
    lines = _Lines(text)
    points, flat, straight, painted = _vertices(lines)
    corners, lengths, face_lines = _corners(path, lines, (len(points), len(flat), len(straight)))
    places = cut_polygons(sides, points, corners[:, 0], lengths)
    beyond = corners >= [len(points), len(flat), len(straight)]
    if beyond.any():
        sides.warnings.append("faces name texture coordinates or normals that are not there")
        corners[beyond] = -1

    # The material of a face is the last that a line before it names.
    uses = lines.starting(b"usemtl ")
    names = ["", *(lines.rest(line, 7) for line in uses)]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    if len(numbers) > MAX_MATERIALS:
        raise UserError(
            f"{path}: uses {len(numbers) - 1} materials, over the limit of {MAX_MATERIALS}"
        )
    named = np.array([numbers[name] for name in names])
    group = np.repeat(named[np.searchsorted(uses, face_lines)], lengths)[places[:, 0]]
    order = np.argsort(group, kind="stable")
    library = _library(lines, sides)
    for name, number in numbers.items():
        first, last = np.searchsorted(group, [number, number + 1], sorter=order)
        if first == last:
            continue
        at, uvs, normals = np.moveaxis(corners[places[order[first:last]]], -1, 0)
        used, faces = np.unique(at, return_inverse=True)
        part = Part(points[used], faces.reshape(-1, 3))
        if name in library:
            part.material = _material(library[name], name, sides)
        if (normals >= 0).all() and len(straight):
            part.normals = straight[normals]
        if (uvs >= 0).any():
            part.uvs = np.where(uvs[..., None] >= 0, flat[uvs], 0.0)
        if painted is not None:
            _paint(part, painted[at], sides)
        yield part


def _plain_lines(text: bytes) -> bytes:
    """Without a byte order mark, comments behind numbers, and blanks before them; LF ends lines."""
    text = text.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = text.translate(bytes.maketrans(b"\t\v\f", b"   ")).replace(b"\\\n", b" ")
    if text.startswith(b" ") or b"\n " in text:
        text = re.sub(rb"(?m)^ +", b"", text)
    return _COMMENT.sub(rb"\1", text) if b"#" in text else text


class _Lines:
    """A text, of whose lines those of one kind are found without a loop."""

    def __init__(self, text: bytes) -> None:
        self.text = text + b"\n" + bytes(8)  # so that any line can be compared with a word
        self.letters = np.frombuffer(self.text, np.uint8)
        self.ends = np.flatnonzero(self.letters == ord("\n")) + 1
        self.starts = np.concatenate([[0], self.ends[:-1]])

    def starting(self, word: bytes) -> np.ndarray:
        """The numbers of the lines that start with a word."""
        found = np.ones(len(self.starts), bool)
        for at, letter in enumerate(word):
            found &= self.letters[self.starts + at] == letter
        return np.flatnonzero(found)

    def rest(self, line: int, start: int) -> str:
        """A line from one of its letters on."""
        text = self.text[self.starts[line] + start : self.ends[line]]
        return text.decode("utf-8", "replace").strip()

    def body(self, lines: np.ndarray, word: bytes) -> bytes:
        """The given lines, all of which start with a word, without it."""
        chosen = np.zeros(len(self.starts), bool)
        chosen[lines] = True
        sizes = self.ends - self.starts
        letters = self.letters[: self.ends[-1]][np.repeat(chosen, sizes)].copy()
        begins = np.cumsum(sizes[lines]) - sizes[lines]
        for at in range(len(word)):
            letters[begins + at] = ord(" ")
        return letters.tobytes()

    def numbers(self, word: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All numbers of the lines that start with a word; where each line's begin; how many."""
        body = self.body(self.starting(word), word)
        counts = _words(body)[0]
        return np.fromstring(body, sep=" "), np.cumsum(counts) - counts, counts


def _words(body: bytes) -> tuple[np.ndarray, np.ndarray]:
    """The number of words of each line, and of each word the number of its slashes."""
    letters = np.frombuffer(body, np.uint8)
    blank = (letters == ord(" ")) | (letters == ord("\n"))
    begins = ~blank
    begins[1:] &= blank[:-1]
    words = np.cumsum(begins)
    totals = words[letters == ord("\n")]
    slashes = np.bincount(words[letters == ord("/")], minlength=words[-1] + 1 if len(words) else 1)
    return np.diff(totals, prepend=0), slashes[1:]


def _vertices(lines: _Lines) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Places ``[V, 3]``, texture coordinates ``[T, 2]``, normals ``[N, 3]``, colours or None."""
    numbers, begins, counts = lines.numbers(b"v ")
    points, painted = numbers[begins[:, None] + np.arange(3)], None
    if (some := counts >= 6).any():
        painted = np.full((len(points), 4), 255, np.uint8)
        painted[some] = to_rgba8(numbers[begins[some, None] + np.arange(3, 6)])
        painted = painted if (painted < 255).any() else None
    numbers, begins, counts = lines.numbers(b"vt ")
    second = (counts > 1).astype(np.int64)  # a texture may have one coordinate
    flat = np.stack([numbers[begins], numbers[begins + second] * second], 1)
    numbers, begins, _ = lines.numbers(b"vn ")
    return points, flat, numbers[begins[:, None] + np.arange(3)], painted


def _corners(
    path: Path, lines: _Lines, totals: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The faces' corners: their numbers of ``v``, ``vt`` and ``vn`` ``[M, 3]``, -1 for none.

    Also the number of corners of each face ``[P]``, and its line.
    """
    chosen = lines.starting(b"f ")
    body = lines.body(chosen, b"f ").replace(b"//", b"/0/")
    body = body.replace(b"/ ", b"/0 ").replace(b"/\n", b"/0\n")
    lengths, slashes = _words(body)
    numbers = np.fromstring(body.replace(b"/", b" "), np.int64, sep=" ")
    begins = np.cumsum(slashes + 1) - slashes - 1
    corners = np.zeros((len(begins), 3), np.int64)
    for column in range(3):
        there = slashes >= column
        corners[there, column] = numbers[begins[there] + column]
    if (corners < 0).any():  # they count back from their own line
        for column, word in enumerate((b"v ", b"vt ", b"vn ")):
            before = np.repeat(np.searchsorted(lines.starting(word), chosen), lengths)
            back = corners[:, column] < 0
            corners[back, column] += before[back] + 1
            if (corners[back, column] < 1).any():
                raise UserError(f"{path}: a face names a vertex before the first")
    return corners - 1, lengths, chosen


def _paint(part: Part, colors: np.ndarray, sides: SideFiles) -> None:
    """Gives a part the vertices' colours, which stand for the material's, but for a texture."""
    if part.material is None:
        part.colors = colors
    elif part.material.texture is not None:
        sides.warnings.append("colours beside a texture are not drawn")
    else:
        part.colors = colors
        part.material.color[:3] = 1.0


def _library(lines: _Lines, sides: SideFiles) -> dict[str, dict[str, str]]:
    """What the MTL files say: of each material, its statements by their words in lower case."""
    found: dict[str, dict[str, str]] = {}
    names = dict.fromkeys(lines.rest(line, 7) for line in lines.starting(b"mtllib "))
    for name in list(names)[:MAX_LIBRARIES]:
        for text in _library_texts(name, sides):
            options: dict[str, str] = {}
            for line in text.decode("utf-8-sig", "replace").splitlines():
                word, *rest = line.split(maxsplit=1) or [""]
                if word.lower() == "newmtl":
                    options = found[" ".join(rest).strip()] = {}
                elif rest:
                    options[word.lower()] = rest[0].strip()
    return found


def _library_texts(name: str, sides: SideFiles) -> list[bytes]:
    """The files of a line of names: of one name, which may have blanks, or of several."""
    try:
        return [sides.read(name)]
    except UserError as error:
        texts, reasons = [], [str(error)]
    words = name.split()[:MAX_LIBRARIES]
    for word in words if len(words) > 1 else ():
        try:
            texts.append(sides.read(word))
        except UserError as error:
            reasons.append(str(error))
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
    for word, sign in (("d", 1), ("tr", -1)):
        try:
            value = float(options[word].split()[-1])
        except (KeyError, IndexError, ValueError):
            continue
        return float(np.clip(value if sign > 0 else 1 - value, 0, 1))
    return 1.0


def _mask(texture: np.ndarray, name: str, sides: SideFiles) -> None:
    """Gives a texture the alpha of MTL's ``map_d``: that picture's alpha, or its grey."""
    shown = " ".join(name[:100].split())
    try:
        with open_picture(io.BytesIO(sides.read(name)), shown) as image:
            alpha = image.convert("RGBA").getchannel("A")
            if alpha.getextrema()[0] == 255:
                alpha = image.convert("L")
            texture[..., 3] = np.asarray(alpha.resize((texture.shape[1], texture.shape[0])))
    except UserError as error:
        sides.warnings.append(str(error))
