"""Headers and elements of ``.ply`` files, checked against the file's size before they are read."""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ..errors import UserError
from .headers import (
    MAX_FILE,
    MAX_VALUES,
    Rows,
    Source,
    check_lines,
    compare_sizes,
    read_rows,
)

MAX_HEADER = 1 << 16  # bytes
MAX_SPLATS = 4 << 30  # bytes of a file of Gaussians; 17 million with all their harmonics
MAX_DIGITS = 18  # of a count, so that it fits 64 bits
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}  # format to numpy's byte order
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
# Words of packed Gaussians. One of the names is enough, so that a file without the others is not
# taken for a point cloud.
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_GAUSSIANS = {"opacity", "scale_0", "rot_0", "f_dc_0", *WORDS}
# On its own line; a comment may contain it.
_END = re.compile(rb"[\r\n]end_header[ \t]*(\r?\n|\r)")


class PlyProperty(NamedTuple):
    """One property of an element, a number or a list of numbers."""

    name: str  # in lower case; some programs write Red Green Blue
    kind: str  # numpy's type of the number, or of each number in the list, without byte order
    length: str = ""  # numpy's type of the list's length; empty for a number


class PlyElement(NamedTuple):
    """One element: ``count`` rows of the same properties."""

    name: str
    count: int
    properties: list[PlyProperty]

    def least_bytes(self) -> int:
        """Return the bytes of all rows if their lists are empty."""
        return self.count * sum(np.dtype(x.length or x.kind).itemsize for x in self.properties)


class PlyHeader(NamedTuple):
    """Content of a header."""

    format: str  # "ascii", a key of ``ORDERS``, or an unknown word; "none" without a format
    comments: list[str]
    elements: list[PlyElement]  # in the order of their data
    start: int  # position of the first byte of the data

    @property
    def has_faces(self) -> bool:
        """True for a mesh, of polygons or of strips."""
        return any(x.name in ("face", "tristrips") and x.count for x in self.elements)

    @property
    def has_gaussians(self) -> bool:
        """True for Gaussians, packed or not."""
        names = {item.name for element in self.elements for item in element.properties}
        return not self.has_faces and not names.isdisjoint(_GAUSSIANS)


class PlyList(NamedTuple):
    """A property whose values are lists."""

    values: np.ndarray  # [M], all lists one after the other
    lengths: np.ndarray  # [N] int64, of each row's list


Columns = dict[str, np.ndarray | PlyList]  # an element's, by the names of its properties


class PlyData(NamedTuple):
    """Content of a file: its header, and by element and property ``[N]`` numbers or lists."""

    header: PlyHeader
    elements: dict[str, Columns]

    def numbers(self, *names: str) -> np.ndarray | None:
        """Return properties of the vertices, ``[N, C]`` float64; None if one is missing."""
        columns = [self.elements.get("vertex", {}).get(name) for name in names]
        if not all(isinstance(column, np.ndarray) for column in columns):
            return None
        return np.stack([np.asarray(column, np.float64) for column in columns], 1)


def _read_header(path: Path, file: BinaryIO) -> PlyHeader:
    """Read the header at the start of a file, and leave the file's position undefined.

    Raises:
        UserError: not a ``.ply`` file, the header has no end, or a line is malformed.
        OSError: the file cannot be read.
    """
    head = file.read(MAX_HEADER)
    if not head.startswith(b"ply"):
        raise UserError(f"{path}: not a .ply file")
    end = _END.search(head)
    if end is None:
        raise UserError(f"{path}: the .ply header has no end")
    start = end.end()
    if b"\n" not in head[: end.start() + 1]:  # lines end with CR alone, and LF would be data
        start = head.index(b"\r", end.start() + 1) + 1
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
                is_list = words[1:2] == ["list"]
                kinds = [TYPES.get(word, "") for word in words[1 + is_list : -1]]
                if len(kinds) != 1 + is_list or not all(kinds):
                    text = f"property '{' '.join(words[1:])[:80]}'"
                    raise UserError(f"{path}: {text} is neither a number nor a list of numbers")
                item = PlyProperty(words[-1].lower(), kinds[-1], kinds[0] if is_list else "")
                elements[-1].properties.append(item)
    return PlyHeader(layout, comments, elements, start)


def parse_ply(source: Source) -> PlyData:
    """Read every element of an open ``.ply`` file, text or binary.

    Raises:
        UserError: not a ``.ply`` file, too large, it holds less or more than its header states, a
            word is not a number, or a name is given twice.
    """
    path, file, size = source
    header = _read_header(path, file)
    _check_header(path, header)
    source.check(MAX_SPLATS if header.has_gaussians else MAX_FILE)
    file.seek(header.start)
    says = ", ".join(f"{element.count} {element.name}" for element in header.elements)
    if header.format == "ascii":
        text, first, columns = file.read(), 0, {}
        text = text if b"\n" in text else text.replace(b"\r", b"\n")
        rows = read_rows(text, str(path))
        for element in header.elements:
            count = element.count if element.properties else 0
            columns[element.name] = _from_text(path, rows.part(first, count), element)
            first += count
        if first < len(rows.sizes):
            raise UserError(f"{path}: invalid header, more lines follow than {says}")
        return PlyData(header, columns)
    least = sum(element.least_bytes() for element in header.elements)
    compare_sizes(path, says, least, size - header.start, exact=False)
    data, at = file.read(), 0
    elements: dict[str, Columns] = {}
    for element in header.elements:
        elements[element.name], at = _from_bytes(path, data, at, element, ORDERS[header.format])
    if data[at:].strip(b"\r\n"):
        raise UserError(f"{path}: invalid header, {says} take {at} bytes but {len(data)} follow")
    return PlyData(header, elements)


def _check_header(path: Path, header: PlyHeader) -> None:
    if header.format not in ("ascii", *ORDERS):
        raise UserError(f"{path}: .ply format is {header.format}, neither binary nor ascii")
    for element in header.elements:
        names = [item.name for item in element.properties]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"{path}: {element.name} property {name} occurs twice")
        if any(item.length.startswith("f") for item in element.properties):
            raise UserError(f"{path}: the length of a list in {element.name} is not an integer")
    names = [element.name for element in header.elements]
    if len({*names}) < len(names):
        raise UserError(f"{path}: the .ply header has a duplicate element")


def spread(starts: np.ndarray, lengths: np.ndarray, step: int = 1) -> np.ndarray:
    """Return ``[M]`` places of all items of lists that start at ``starts``, ``step`` apart."""
    ends = np.cumsum(lengths)
    within = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - lengths, lengths)
    return np.repeat(starts, lengths) + within * step


def _from_text(path: Path, rows: Rows, element: PlyElement) -> Columns:
    """Return the element's columns from its rows, or as many as there are."""
    items, source = element.properties, f"{path}: {element.name}"
    count = element.count if items else 0
    check_lines(path, f"{count} {element.name},", count, len(rows.sizes))
    if not any(item.length for item in items):
        table = rows.table(source, (len(items),))
        return {item.name: _typed(path, table[:, i], item) for i, item in enumerate(items)}
    values, sizes = rows
    spans, ends = [], np.cumsum(sizes)
    at = ends - sizes
    for item in items:
        lengths = np.ones(count, np.int64)
        if item.length:
            stated = np.where(at < ends, values.take(at, mode="clip"), 0)
            bad = ~((stated >= 0) & (stated <= len(values)) & (stated == np.rint(stated)))
            if bad.any():
                raise UserError(f"{source} has a list of length {stated[bad][0]:g}")
            lengths, at = stated.astype(np.int64), at + 1
        spans.append((at, lengths))
        at = at + lengths
    if (at != ends).any():
        row = (at != ends).argmax()
        wanted = sizes[row] + at[row] - ends[row]
        raise UserError(f"{source} has a row of {sizes[row]} numbers, not {wanted}")
    return {
        item.name: _column(item, _typed(path, values[spread(start, lengths)], item), lengths)
        for item, (start, lengths) in zip(items, spans)
    }


def _column(item: PlyProperty, values: np.ndarray, lengths: np.ndarray) -> np.ndarray | PlyList:
    return PlyList(values, lengths) if item.length else values


def _typed(path: Path, values: np.ndarray, item: PlyProperty) -> np.ndarray:
    """Convert numbers of a text to the property's type. Raises UserError if they do not fit it."""
    kind = np.dtype(item.kind)
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(kind)
    limits = np.iinfo(kind)
    fits = (values >= limits.min) & (values <= limits.max)  # False for NaN
    if item.length:  # an index; a colour may be 0.7
        fits &= values == np.rint(values)
    if not fits.all():
        raise UserError(f"{path}: a value of {item.name} is {values[~fits][0]:g}")
    return values.astype(kind)


def _from_bytes(
    path: Path, data: bytes, at: int, element: PlyElement, order: str
) -> tuple[Columns, int]:
    """Return the element's columns, and the position of the next element."""
    items, count = element.properties, element.count
    if not items or not count:
        none = np.zeros(0, np.int64)
        return {item.name: _column(item, np.zeros(0, item.kind), none) for item in items}, at
    says, left = f"{count} {element.name}", len(data) - at
    compare_sizes(path, says, element.least_bytes(), left, exact=False)
    kinds = [np.dtype(order + item.kind) for item in items]
    layout = [
        (int(item.length[1:] or 0), item.length.startswith("i"), kind.itemsize)
        for item, kind in zip(items, kinds)
    ]
    byteorder = "little" if order == "<" else "big"

    def lengths_of_row(at: int) -> tuple[list[int], int]:
        """Return the length of each property's list (1 for a number), and the row's end."""
        lengths = []
        for head, signed, size in layout:
            length = 1
            if head:
                length = int.from_bytes(data[at : at + head], byteorder, signed=signed)
            if length < 0:
                raise UserError(f"{path}: invalid header, a list of {length} in {element.name}")
            lengths.append(length)
            at += head + length * size
        return lengths, at

    columns: Columns = {}
    # As a rule all lists of a property are as long as the first.
    lengths, end = lengths_of_row(at)
    if count * (end - at) <= left:
        fields = []
        for i, (item, kind, length) in enumerate(zip(items, kinds, lengths)):
            fields += [(f"n{i}", order + item.length)] if item.length else []
            fields += [(f"v{i}", kind, (length,))]
        rows = np.frombuffer(data, np.dtype(fields), count, at)
        if all((rows[f"n{i}"] == lengths[i]).all() for i, x in enumerate(items) if x.length):
            for i, item in enumerate(items):
                values = rows[f"v{i}"].reshape(-1) if item.length else rows[f"v{i}"][:, 0]
                columns[item.name] = _column(item, values, np.full(count, lengths[i], np.int64))
            return columns, at + count * (end - at)
    # Else only a row says where the next one begins.
    starts = np.empty(count, np.int64)
    for row in range(count):
        starts[row] = at
        at = lengths_of_row(at)[1]
    compare_sizes(path, says, at, len(data), exact=False)
    raw, total = np.frombuffer(data, np.uint8), 0

    def take(places: np.ndarray, kind: np.dtype) -> np.ndarray:
        return np.stack([raw[places + i] for i in range(kind.itemsize)], 1).view(kind)[:, 0]

    for item, kind in zip(items, kinds):
        each = np.ones(count, np.int64)
        if item.length:
            length = np.dtype(order + item.length)
            each, starts = take(starts, length).astype(np.int64), starts + length.itemsize
        total += each.sum()
        if total > MAX_VALUES:
            raise UserError(f"{path}: over {MAX_VALUES} numbers, the limit for one file")
        columns[item.name] = _column(item, take(spread(starts, each, kind.itemsize), kind), each)
        starts = starts + each * kind.itemsize
    return columns, at
