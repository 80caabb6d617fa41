"""The header of a ``.ply`` file: the elements that it states, and where their data begin."""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ..errors import UserError

MAX_HEADER = 1 << 16  # bytes
_END = re.compile(rb"[\r\n]end_header[ \t]*\r?\n")  # a line of its own; a comment may say it
MAX_DIGITS = 18  # of a count, so that it fits 64 bits
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}  # format to numpy's byte order
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}


class PlyProperty(NamedTuple):
    """One property of an element, a number or a list of numbers.

    Attributes:
        name: as the header gives it.
        kind: numpy's type of the number, or of each number in the list, without byte order.
        length: numpy's type of the list's length; empty for a number.
    """

    name: str
    kind: str
    length: str = ""

    def least_bytes(self) -> int:
        """Bytes of the number, or of an empty list."""
        return np.dtype(self.length or self.kind).itemsize


class PlyElement(NamedTuple):
    """One element: ``count`` rows of the same properties."""

    name: str
    count: int
    properties: list[PlyProperty]

    def least_bytes(self) -> int:
        """Bytes of one row, its lists empty."""
        return sum(item.least_bytes() for item in self.properties)


class PlyHeader(NamedTuple):
    """What a header states.

    Attributes:
        format: "ascii", a key of ``ORDERS``, or what stands there; "none" without a format.
        comments: the text of each comment.
        elements: in the order of their data.
        start: position of the first byte of the data.
    """

    format: str
    comments: list[str]
    elements: list[PlyElement]
    start: int


def read_ply_header(path: Path, file: BinaryIO) -> PlyHeader:
    """Reads the header at the start of a file.

    Args:
        path: named in errors.
        file: at its start; afterwards at some place behind the header.

    Raises:
        UserError: it is no ``.ply`` file, its header does not end, or a line is not understood.
        OSError: the file cannot be read.
    """
    head = file.read(MAX_HEADER)
    if not head.startswith(b"ply"):
        raise UserError(f"{path}: not a .ply file")
    end = _END.search(head)
    if end is None:
        raise UserError(f"{path}: the .ply header has no end")
    layout, comments = "none", []
    elements: list[PlyElement] = []
    for line in head[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        match words[:1]:
            case ["format"] if layout == "none" and len(words) > 1:
                layout = words[1]
            case ["comment"]:
                comments.append(line.partition(" ")[2].strip())
            case ["element"]:
                if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > MAX_DIGITS:
                    raise UserError(
                        f"{path}: the .ply header says '{' '.join(words)[:80]}', "
                        f"expected 'element {words[1] if len(words) > 1 else 'NAME'} COUNT'"
                    )
                elements.append(PlyElement(words[1], int(words[2]), []))
            case ["property"]:
                if not elements:
                    raise UserError(f"{path}: the .ply header has a property before any element")
                elements[-1].properties.append(_property(path, words))
    return PlyHeader(layout, comments, elements, end.end())


def _property(path: Path, words: list[str]) -> PlyProperty:
    kinds = words[2:-1] if words[1:2] == ["list"] else words[1:-1]
    wanted = 2 if words[1:2] == ["list"] else 1
    if len(kinds) != wanted or any(kind not in TYPES for kind in kinds):
        text = " ".join(words[1:])[:80]
        raise UserError(f"{path}: property '{text}' is not a plain number or a list of such")
    length = TYPES[kinds[0]] if wanted == 2 else ""
    return PlyProperty(words[-1], TYPES[kinds[-1]], length)
