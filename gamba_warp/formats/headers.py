"""What readers of shapes share: counts that a file states against its size, and rows of numbers.

A file that lies is refused unread. In a text every row has the same columns, and
every word is a number.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, TypeVar

import msgspec
import numpy as np

from ..errors import UserError
from ..untrusted.documents import parse_document

MAX_FILE = 1 << 30  # bytes of a shape
SLACK = 2  # bytes after the end: a line end
MAX_ZEROS = 1 << 24  # bytes of all accessors that no bytes of the file stand behind
MAX_LINE = 1 << 16  # letters: a point with a few hundred numbers
MAX_VALUES = 60_000_000  # numbers of one file; 480 MB as float64
# Extensions that pack triangles; a reader without them sees zeros.
_PACKED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression"}
_BOM = b"\xef\xbb\xbf"
# str takes four control signs for blanks, which are none in a file: they become no ASCII.
_STRICT = bytes(0xFF if 0x1C <= number <= 0x1F else number for number in range(256))

Count = Annotated[int, msgspec.Meta(ge=0, le=MAX_FILE)]


class _Buffer(msgspec.Struct):
    byteLength: Count
    uri: str | None = None


class View(msgspec.Struct):
    """A part of a buffer of a glTF document."""

    buffer: Count
    byteLength: Count
    byteOffset: Count = 0
    byteStride: Annotated[int, msgspec.Meta(ge=1, le=252)] | None = None


class Accessor(msgspec.Struct):
    """The numbers in a view of a glTF document."""

    count: Count
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    bufferView: Count | None = None
    byteOffset: Count = 0
    sparse: Any = None
    normalized: bool = False

    def row_bytes(self) -> int:
        """Bytes of one value."""
        one = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}[self.componentType]
        parts = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
        return one * parts[self.type]


class Gltf(msgspec.Struct):
    """The parts of a glTF document that say how many bytes are where."""

    buffers: list[_Buffer] = []
    bufferViews: list[View] = []
    accessors: list[Accessor] = []
    extensionsRequired: list[str] = []


Tree = TypeVar("Tree", bound=Gltf)


@contextmanager
def open_shape(path: Path, limit: int = MAX_FILE) -> Iterator[tuple[BinaryIO, int]]:
    """Opens a shape file for reading; gives it and its size in bytes.

    Raises:
        UserError: it is missing, no plain file, empty or over ``limit`` bytes, cannot be read, or
            what is read of it does not fit the memory.
    """
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise UserError(f"{path}: not a plain file")
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size == 0:
                raise UserError(f"{path}: the file is empty, not a {path.suffix} file")
            if size > limit:
                raise UserError(f"{path}: over {limit >> 20} MB, the limit for a shape")
            yield file, size
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise UserError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    except MemoryError as error:
        raise UserError(f"{path}: not enough memory for it") from error


def compare_sizes(path: Path, says: str, wanted: int, there: int, exact: bool = True) -> None:
    """Compares the bytes that a header promises with those that follow it.

    Args:
        path: named in errors.
        says: what the header states.
        wanted: bytes of that.
        there: bytes that follow.
        exact: whether more than ``SLACK`` bytes beyond ``wanted`` are refused, too.

    Raises:
        UserError: there are too few bytes, or too many.
    """
    if there < wanted:
        raise UserError(
            f"{path}: truncated or false header, {says} take {wanted} bytes but {there} follow"
        )
    if exact and there > wanted + SLACK:
        raise UserError(f"{path}: false header, {says} take {wanted} bytes but {there} follow")


def check_counts(path: Path) -> None:
    """Compares what an .stl, .off, .glb or .gltf file says it holds with its size.

    Nothing is allocated by what the file says, so that a header of 10^12 vertices costs nothing.
    Files of other kinds state no counts, or are read without trust in them, and pass; only that
    they are plain files of bounded size is checked.

    Raises:
        UserError: the file holds less or more than it says, or its header is broken.
    """
    with open_shape(path) as (file, size):
        check = _CHECKS.get(path.suffix.lower())
        if check is None:
            return
        try:
            check(path, file, size)
        except (struct.error, IndexError) as error:
            raise UserError(f"{path}: broken header ({error})") from error


def _check_stl(path: Path, file: BinaryIO, size: int) -> None:
    head = file.read(84)
    head += file.read(1 << 12)
    if head.lstrip().startswith(b"solid") and b"facet" in head:
        # Every facet is closed and has three vertices, and the solid has an end.
        text = (head + file.read()).lower()
        ends, vertices = text.count(b"endfacet"), text.count(b"vertex")
        begun = text.count(b"facet") - ends
        if not begun == ends == vertices / 3 or b"endsolid" not in text:
            says = f"{begun} facets, {ends} of them with an end, and {vertices} vertices"
            raise UserError(f"{path}: truncated or false, {says}")
        return
    if len(head) < 84:
        raise UserError(f"{path}: {size} bytes are too few for an .stl file")
    count = struct.unpack("<I", head[80:84])[0]
    compare_sizes(path, f"{count} faces", 50 * count, size - 84)


def _check_off(path: Path, file: BinaryIO, size: int) -> None:
    lines = (line.split("#")[0].split() for line in lines_of(file, str(path), comments="#"))
    words = next(lines, [])
    counts = words[1:] or next(lines, [])
    if not words or not words[0].endswith("OFF") or not all(w.isdecimal() for w in counts[:2]):
        raise UserError(f"{path}: broken header, not OFF and numbers of vertices and faces")
    rows = [int(word[:18]) for word in counts[:2]]
    if len(rows) < 2:
        raise UserError(f"{path}: broken header, not OFF and numbers of vertices and faces")
    says = f"{rows[0]} vertices and {rows[1]} faces"
    found = 0
    for found, words in enumerate(lines, 1):
        if found <= rows[0]:
            whole = len(words) >= 3
        else:
            whole = words[0].isdecimal() and len(words) > int(words[0][:18])
        if not whole:
            raise UserError(f"{path}: row {found} is not whole: {' '.join(words)[:40]}")
    if found != sum(rows):
        raise UserError(f"{path}: truncated or false header, {says}, but {found} lines follow")


def read_glb(path: Path, file: BinaryIO, size: int, kind: type[Tree]) -> tuple[Tree, bytes]:
    """Reads a .glb file, and compares what it says it holds with its size.

    Args:
        path: named in errors.
        file: at its start.
        size: of the file, bytes.
        kind: of the document.

    Returns:
        The document, and the bytes of the first chunk that is another.

    Raises:
        UserError: the file holds less or more than it says, or its header is broken.
        struct.error, IndexError: likewise.
    """
    magic, version, length = struct.unpack("<4sII", file.read(12))
    if magic != b"glTF":
        raise UserError(f"{path}: not a .glb file")
    if version != 2:
        raise UserError(f"{path}: cannot be read as a mesh (version {version} of .glb, not 2)")
    compare_sizes(path, "its header and chunks", length, size)
    text, binary = None, b""
    while (at := file.tell()) + 8 <= size:
        chunk, is_text = struct.unpack("<I4s", file.read(8))
        compare_sizes(path, f"a chunk at byte {at}", chunk, size - at - 8, exact=False)
        data = file.read(chunk)
        if is_text == b"JSON" and text is None:
            text = data
        else:
            binary = binary or data
    if text is None:
        raise UserError(f"{path}: no JSON chunk")
    # Padded with blanks; some writers pad with zeros.
    tree = parse_document(text.rstrip(b"\0 "), kind, str(path))
    for number, buffer in enumerate(tree.buffers):
        if buffer.uri is None:
            compare_sizes(path, f"buffer {number}", buffer.byteLength, len(binary), exact=False)
    _check_accessors(path, tree)
    return tree, binary


def _check_accessors(path: Path, tree: Gltf) -> None:
    """Each view against its buffer, each accessor against its view.

    trimesh compares the buffers' stated lengths with their real ones where a view is taken.
    """
    if packed := _PACKED & {*tree.extensionsRequired}:
        raise UserError(f"{path}: packed by {min(packed)}, which is not read; unpack it first")
    for number, view in enumerate(tree.bufferViews):
        there = tree.buffers[view.buffer].byteLength - view.byteOffset
        compare_sizes(path, f"the bytes of view {number}", view.byteLength, there, exact=False)
    zeros = total = 0
    for number, accessor in enumerate(tree.accessors):
        size = accessor.row_bytes()
        total += accessor.count * size
        says = f"{accessor.count} values of accessor {number}"
        if accessor.sparse is not None:
            raise UserError(f"{path}: accessor {number} is sparse, which is not read")
        if accessor.bufferView is None:  # zeros, until an extension fills them
            zeros += accessor.count * size
            compare_sizes(path, says, zeros, MAX_ZEROS, exact=False)
            continue
        view = tree.bufferViews[accessor.bufferView]
        step = view.byteStride or size
        wanted = (accessor.count - 1) * step + size if accessor.count else 0
        there = view.byteLength - accessor.byteOffset
        compare_sizes(path, says, wanted, there, exact=False)
    if total > MAX_FILE:
        raise UserError(f"{path}: its accessors take {total >> 20} MB, over {MAX_FILE >> 20}")


def lines_of(file: BinaryIO, source: str, comments: str = "") -> Iterator[str]:
    """Yields the lines of a text file that are not blank, of bounded length.

    Args:
        file: where the text begins.
        source: named in errors.
        comments: a line that begins with it is passed over; empty: there are no comments.

    Raises:
        UserError: a line is longer than ``MAX_LINE``.
    """
    first = True
    while line := file.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise UserError(f"{source}: a line of more than {MAX_LINE} letters")
        # What is not ASCII becomes a sign that no number has.
        line = (line.removeprefix(_BOM) if first else line).translate(_STRICT)
        text = line.decode("ascii", "replace")
        first = False
        if not text.isspace() and text and not (comments and text.lstrip().startswith(comments)):
            yield text


def read_table(lines: Iterable[str], source: str, columns: tuple[int, ...] = ()) -> np.ndarray:
    """Reads lines of numbers as ``[N, C]`` float64; NaN and infinity are numbers here.

    Args:
        lines: one row each.
        source: named in errors.
        columns: the numbers of columns that are allowed; empty: any.

    Raises:
        UserError: a word is no number, the rows differ in their number of columns, or there are
            more than ``MAX_VALUES`` numbers.
    """
    lines = iter(lines)
    first = next(lines, None)
    if first is None:
        return np.zeros((0, columns[0] if columns else 0))
    count = len(first.split())
    if columns and count not in columns:
        wanted = " or ".join(map(str, columns))
        raise UserError(f"{source}: {count} columns in the first row, expected {wanted}")
    most = MAX_VALUES // count
    try:
        table = np.loadtxt(islice(chain([first], lines), most + 1), comments=None, ndmin=2)
    except ValueError as error:
        # "...; use `usecols` to select a subset" is advice for programmers.
        reason = re.split(r"[;\n]", str(error))[0].rstrip(".")
        raise UserError(f"{source}: {reason[:200]}") from error
    if len(table) > most:
        raise UserError(f"{source}: over {MAX_VALUES} numbers, the limit for one file")
    return table


_CHECKS = {
    ".stl": _check_stl,
    ".off": _check_off,
    ".glb": lambda path, file, size: read_glb(path, file, size, Gltf),
    ".gltf": lambda path, file, size: _check_accessors(
        path, parse_document(file.read(), Gltf, str(path))
    ),
}
