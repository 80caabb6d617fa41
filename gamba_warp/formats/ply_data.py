"""All elements of a ``.ply`` file as arrays: what the header states is there, every number."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import UserError
from .headers import MAX_VALUES, compare_sizes, lines_of, open_shape, read_table
from .ply_header import ORDERS, PlyElement, PlyHeader, PlyProperty, read_ply_header

_ROWS = 100_000  # rows of text with lists that are read at once


class PlyList(NamedTuple):
    """A property whose values are lists.

    Attributes:
        values: ``[M]``, all lists one after the other.
        lengths: ``[N]`` int64, of each row's list.
    """

    values: np.ndarray
    lengths: np.ndarray


class PlyData(NamedTuple):
    """What a file holds.

    Attributes:
        header: what it states.
        elements: by name, each property's ``[N]`` numbers, or lists.
    """

    header: PlyHeader
    elements: dict[str, dict[str, np.ndarray | PlyList]]

    def numbers(self, element: str, names: tuple[str, ...]) -> np.ndarray | None:
        """``[N, C]`` float64, properties of an element; None where one of them is not there."""
        found = [self.elements.get(element, {}).get(name) for name in names]
        if not all(isinstance(column, np.ndarray) for column in found):
            return None
        return np.stack([np.asarray(column, np.float64) for column in found], 1)


def read_ply(path: Path) -> PlyData:
    """Reads every element of a ``.ply`` file, text or binary.

    Nothing is allocated by what the header says before the file's size is known to fit it.

    Raises:
        UserError: it is no ``.ply`` file, holds less or more than its header states, a word is no
            number, or a name is given twice.
    """
    with open_shape(path) as (file, size):
        header = read_ply_header(path, file)
        _check_names(path, header)
        file.seek(header.start)
        says = ", ".join(f"{element.count} {element.name}" for element in header.elements)
        elements: dict[str, dict[str, np.ndarray | PlyList]] = {}
        if header.format == "ascii":
            lines = lines_of(file, str(path))
            for element in header.elements:
                elements[element.name] = _from_text(path, lines, element)
            if next(lines, None) is not None:
                raise UserError(f"{path}: false header, more lines follow than {says}")
            return PlyData(header, elements)
        if header.format not in ORDERS:
            raise UserError(f"{path}: the .ply header states no format")
        least = sum(element.count * element.least_bytes() for element in header.elements)
        compare_sizes(path, says, least, size - header.start, exact=False)
        data, at = file.read(), 0
    for element in header.elements:
        elements[element.name], at = _from_bytes(path, data, at, element, ORDERS[header.format])
    compare_sizes(path, says, at, len(data))
    return PlyData(header, elements)


def _check_names(path: Path, header: PlyHeader) -> None:
    for element in header.elements:
        names = [item.name for item in element.properties]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise UserError(f"{path}: {element.name} property {twice} is given twice")
        if any(item.length.startswith("f") for item in element.properties):
            raise UserError(f"{path}: the length of a list in {element.name} is a fraction")
    names = [element.name for element in header.elements]
    if len(set(names)) < len(names):
        raise UserError(f"{path}: the .ply header has an element twice")


def _from_text(
    path: Path, lines: Iterator[str], element: PlyElement
) -> dict[str, np.ndarray | PlyList]:
    """The element's columns, from as many lines as it has rows."""
    items, count = element.properties, element.count
    if not items or not count:
        return {item.name: _empty(item) for item in items}
    lists = [item for item in items if item.length]
    parts, left = [], count
    while left:
        step = left if not lists else min(left, _ROWS)
        rows = islice(lines, step)
        table = _text_rows(path, list(rows), element) if lists else _text_table(path, rows, element)
        there = table[1]
        if there < step:
            raise UserError(
                f"{path}: truncated or false header, {count} {element.name}, "
                f"but {count - left + there} lines follow"
            )
        parts.append(table[0])
        left -= step
    return {item.name: _joined([part[item.name] for part in parts]) for item in items}


def _empty(item: PlyProperty) -> np.ndarray | PlyList:
    none = np.zeros(0, item.kind)
    return PlyList(none, np.zeros(0, np.int64)) if item.length else none


def _joined(columns: list) -> np.ndarray | PlyList:
    if len(columns) == 1:
        return columns[0]
    if isinstance(columns[0], PlyList):
        return PlyList(*(np.concatenate(parts) for parts in zip(*columns)))
    return np.concatenate(columns)


def _text_table(path: Path, rows: Iterator[str], element: PlyElement) -> tuple[dict, int]:
    items = element.properties
    table = read_table(rows, f"{path}: {element.name}", (len(items),))
    columns = {item.name: _typed(path, table[:, i], item) for i, item in enumerate(items)}
    return columns, len(table)


def _text_rows(path: Path, rows: list[str], element: PlyElement) -> tuple[dict, int]:
    """Columns of lines with lists, whose rows may differ in length; and how many there were."""
    words: list[str] = []
    spans: dict[str, list[tuple[int, int]]] = {item.name: [] for item in element.properties}
    for row in rows:
        if "_" in row:  # which Python allows within a number
            raise UserError(f"{path}: {element.name}: {row.strip()[:40]!r} is no number")
        split = row.split()
        at, base = 0, len(words)
        for item in element.properties:
            length = 1
            if item.length:
                word = split[at] if at < len(split) else ""
                if not word.isdecimal() or len(word) > 9:
                    raise UserError(f"{path}: {element.name} has a list of length '{word[:20]}'")
                length, at = int(word), at + 1
            spans[item.name].append((base + at, length))
            at += length
        if at != len(split):
            raise UserError(f"{path}: {element.name} has a row of {len(split)} numbers, not {at}")
        words += split
    try:
        flat = np.array([float(word) for word in words])
    except ValueError as error:
        raise UserError(f"{path}: {element.name}: {str(error)[:100]}") from error
    columns: dict[str, np.ndarray | PlyList] = {}
    for item in element.properties:
        starts, lengths = np.array(spans[item.name], np.int64).reshape(-1, 2).T
        values = _typed(path, flat[_each(starts, lengths, 1)], item)
        columns[item.name] = PlyList(values, lengths) if item.length else values
    return columns, len(rows)


def _typed(path: Path, values: np.ndarray, item: PlyProperty) -> np.ndarray:
    """Numbers of a text as the property's type. Raises UserError where they do not fit it."""
    kind = np.dtype(item.kind)
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(kind)
    limits = np.iinfo(kind)
    fits = (values >= limits.min) & (values <= limits.max)  # which NaN does not
    if item.length:  # an index; a colour may be 0.7
        fits &= values == np.rint(values)
    if not fits.all():
        raise UserError(f"{path}: a value of {item.name} is {values[~fits][0]:g}")
    return values.astype(kind)


def _each(starts: np.ndarray, lengths: np.ndarray, step: int) -> np.ndarray:
    """``[M]`` the places of all items of lists that start at ``starts``, ``step`` apart."""
    ends = np.cumsum(lengths)
    within = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - lengths, lengths)
    return np.repeat(starts, lengths) + within * step


def _from_bytes(
    path: Path, data: bytes, at: int, element: PlyElement, order: str
) -> tuple[dict[str, np.ndarray | PlyList], int]:
    """The element's columns and where the next element begins."""
    items, count = element.properties, element.count
    if not items or not count:
        return {item.name: _empty(item) for item in items}, at
    says = f"{count} {element.name} with lists"
    compare_sizes(path, says, count * element.least_bytes(), len(data) - at, exact=False)
    lengths: dict[str, int] = {}
    place = at  # as a rule all lists of a property are as long as the first
    for item in items:
        place += item.least_bytes()
        if item.length:
            compare_sizes(path, says, place, len(data), exact=False)
            kind = np.dtype(order + item.length)
            lengths[item.name] = int(np.frombuffer(data, kind, 1, place - kind.itemsize)[0])
            if lengths[item.name] < 0:
                raise UserError(f"{path}: false header, a list of {lengths[item.name]}")
            place += lengths[item.name] * np.dtype(item.kind).itemsize
    if count * (place - at) <= len(data) - at:
        fields = []
        for i, item in enumerate(items):
            if item.length:
                fields += [(f"n{i}", order + item.length)]
            fields += [(f"v{i}", order + item.kind, (lengths.get(item.name, 1),))]
        rows = np.frombuffer(data, np.dtype(fields), count, at)
        if all((rows[f"n{i}"] == lengths[x.name]).all() for i, x in enumerate(items) if x.length):
            return {
                item.name: _uniform(rows[f"v{i}"], item) for i, item in enumerate(items)
            }, at + count * (place - at)
    return _walked(path, data, at, element, order)


def _uniform(values: np.ndarray, item: PlyProperty) -> np.ndarray | PlyList:
    if not item.length:
        return values[:, 0]
    return PlyList(values.reshape(-1), np.full(len(values), values.shape[1], np.int64))


def _walked(
    path: Path, data: bytes, at: int, element: PlyElement, order: str
) -> tuple[dict[str, np.ndarray | PlyList], int]:
    """As ``_from_bytes``, row by row, for lists that differ in length."""
    says = f"{element.count} {element.name} with lists"
    byteorder = "little" if order == "<" else "big"
    starts = np.empty((len(element.properties), element.count), np.int64)
    lengths = np.ones_like(starts)
    steps = [
        (i, np.dtype(item.length or "u1").itemsize if item.length else 0,
         item.length.startswith("i"), np.dtype(item.kind).itemsize)
        for i, item in enumerate(element.properties)
    ]  # fmt: skip
    for row in range(element.count):
        for i, head, signed, step in steps:
            length = 1
            if head:
                length = int.from_bytes(data[at : at + head], byteorder, signed=signed)
                if length < 0:
                    raise UserError(f"{path}: false header, a list of {length} in {element.name}")
                at += head
                lengths[i, row] = length
            starts[i, row] = at
            at += length * step
        if at > len(data):
            compare_sizes(path, says, at, len(data), exact=False)
    if lengths.sum() > MAX_VALUES:
        raise UserError(f"{path}: over {MAX_VALUES} numbers, the limit for one file")
    raw = np.frombuffer(data, np.uint8)
    columns: dict[str, np.ndarray | PlyList] = {}
    for i, item in enumerate(element.properties):
        kind = np.dtype(order + item.kind)
        places = _each(starts[i], lengths[i], kind.itemsize)
        taken = np.empty((len(places), kind.itemsize), np.uint8)
        for byte in range(kind.itemsize):
            taken[:, byte] = raw[places + byte]
        values = taken.view(kind)[:, 0]
        columns[item.name] = PlyList(values, lengths[i]) if item.length else values
    return columns, at


def triangles(path: Path, faces: PlyList, count: int) -> np.ndarray:
    """``[F, 3]`` int64 triangles of polygons, each as a fan around its first corner.

    Polygons of fewer than three corners have no area and give no triangle.

    Args:
        path: named in errors.
        faces: indices of vertices.
        count: of the vertices.

    Raises:
        UserError: an index is out of range.
    """
    indices, lengths = faces.values.astype(np.int64), faces.lengths
    bad = (faces.values < 0) | (faces.values >= count) | (indices != faces.values)
    if bad.any():
        raise UserError(f"{path}: a face names vertex {faces.values[bad][0]} of {count}")
    first = np.cumsum(lengths) - lengths
    fans = np.maximum(lengths - 2, 0)
    middle = _each(first + 1, fans, 1)
    corners = np.stack([np.repeat(first, fans), middle, middle + 1], 1)
    return indices[corners]
