"""All elements of a ``.ply`` file as arrays: what the header states is there, every number."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from .headers import MAX_FILE, MAX_VALUES, compare_sizes, lines_of, open_shape, read_table
from .ply_header import ORDERS, PlyElement, PlyHeader, PlyProperty, read_ply_header


def spread(starts: np.ndarray, lengths: np.ndarray, step: int = 1) -> np.ndarray:
    """``[M]`` the places of all items of lists that start at ``starts``, ``step`` apart."""
    ends = np.cumsum(lengths)
    within = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - lengths, lengths)
    return np.repeat(starts, lengths) + within * step


class PlyList(NamedTuple):
    """A property whose values are lists.

    Attributes:
        values: ``[M]``, all lists one after the other.
        lengths: ``[N]`` int64, of each row's list.
    """

    values: np.ndarray
    lengths: np.ndarray


Columns = dict[str, np.ndarray | PlyList]  # an element's, by the names of its properties


class PlyData(NamedTuple):
    """What a file holds.

    Attributes:
        header: what it states.
        elements: by name, each property's ``[N]`` numbers, or lists.
    """

    header: PlyHeader
    elements: dict[str, Columns]

    def numbers(self, element: str, names: tuple[str, ...]) -> np.ndarray | None:
        """``[N, C]`` float64, properties of an element; None where one of them is not there."""
        found = [self.elements.get(element, {}).get(name) for name in names]
        if not all(isinstance(column, np.ndarray) for column in found):
            return None
        return np.stack([np.asarray(column, np.float64) for column in found], 1)


def read_ply(path: Path, limit: int = MAX_FILE) -> PlyData:
    """Reads every element of a ``.ply`` file, text or binary.

    Nothing is allocated by what the header says before the file's size is known to fit it.

    Args:
        path: the file.
        limit: largest size, bytes.

    Raises:
        UserError: it is no ``.ply`` file, holds less or more than its header states, a word is no
            number, or a name is given twice.
    """
    with open_shape(path, limit) as (file, size):
        header = read_ply_header(path, file)
        _check_header(path, header)
        file.seek(header.start)
        says = ", ".join(f"{element.count} {element.name}" for element in header.elements)
        if header.format == "ascii":
            lines = lines_of(file, str(path))
            found = {element.name: _from_text(path, lines, element) for element in header.elements}
            if next(lines, None) is not None:
                raise UserError(f"{path}: false header, more lines follow than {says}")
            return PlyData(header, found)
        least = sum(element.count * element.least_bytes() for element in header.elements)
        compare_sizes(path, says, least, size - header.start, exact=False)
        data, at = file.read(), 0
    elements: dict[str, Columns] = {}
    for element in header.elements:
        elements[element.name], at = _from_bytes(path, data, at, element, ORDERS[header.format])
    if data[at:].strip(b"\r\n"):
        raise UserError(f"{path}: false header, {says} take {at} bytes but {len(data)} follow")
    return PlyData(header, elements)


def _check_header(path: Path, header: PlyHeader) -> None:
    if header.format not in ("ascii", *ORDERS):
        raise UserError(f"{path}: .ply format is {header.format}, neither binary nor ascii")
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


def _from_text(path: Path, lines: Iterator[str], element: PlyElement) -> Columns:
    """The element's columns, from as many lines as it has rows."""
    items, count, source = element.properties, element.count, f"{path}: {element.name}"
    ends = [0]  # of the rows, among all numbers

    def words() -> Iterator[str]:
        for line in islice(lines, count if items else 0):
            row = line.split()
            ends.append(ends[-1] + len(row))
            yield from row

    with_lists = any(item.length for item in items)
    if with_lists:  # whose rows may differ in length
        table = read_table(words(), source, (1,))
    else:
        table = read_table(islice(lines, count if items else 0), source, (len(items),))
    there = len(ends) - 1 if with_lists else len(table)
    if items and there < count:
        raise UserError(
            f"{path}: truncated or false header, {count} {element.name}, but {there} lines follow"
        )
    if not with_lists:
        return {item.name: _typed(path, table[:, i], item) for i, item in enumerate(items)}
    flat = table[:, 0]
    numbers: Any = flat.data  # quicker than numpy's scalars

    def length_at(at: int) -> int:
        length = numbers[at] if at < len(flat) else -1.0
        if not 0 <= length <= len(flat) or not length.is_integer():
            raise UserError(f"{source} has a list of length {length:g}")
        return int(length)

    steps = [(1, 1, length_at) if item.length else (0, 1, None) for item in items]
    starts, lengths, _ = _walk(ends[:-1], 0, steps)
    wanted, got = starts[-1] + lengths[-1] - ends[:-1], np.diff(ends)
    if (wanted != got).any():
        row = (wanted != got).argmax()
        raise UserError(f"{source} has a row of {got[row]} numbers, not {wanted[row]}")
    return {
        item.name: _column(item, _typed(path, flat[spread(start, length, 1)], item), length)
        for item, start, length in zip(items, starts, lengths)
    }


def _column(item: PlyProperty, values: np.ndarray, lengths: np.ndarray) -> np.ndarray | PlyList:
    return PlyList(values, lengths) if item.length else values


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


def _walk(
    rows: Sequence[int | None],
    at: int,
    steps: Sequence[tuple[int, int, Callable[[int], int] | None]],
) -> tuple[np.ndarray, np.ndarray, int]:
    """Goes through rows with lists one by one: only a row says where the next one begins.

    Args:
        rows: where each begins, or None: where the one before it ends.
        at: where the first begins.
        steps: of each property, what the length of its list takes (0: it is no list), what a
            number takes, and what reads the length that stands at a place.

    Returns:
        ``[properties, rows]`` where the numbers begin and how many there are, and the end.
    """
    starts, lengths = [array("q") for _ in steps], [array("q") for _ in steps]
    parts = [
        (*step, start.append, length.append) for step, start, length in zip(steps, starts, lengths)
    ]
    for begin in rows:
        at = at if begin is None else begin
        for head, step, length_at, add_start, add_length in parts:
            length = length_at(at) if length_at else 1
            at += head
            add_start(at)
            add_length(length)
            at += length * step
    return np.array(starts), np.array(lengths), at


def _from_bytes(
    path: Path, data: bytes, at: int, element: PlyElement, order: str
) -> tuple[Columns, int]:
    """The element's columns and where the next element begins."""
    items, count = element.properties, element.count
    says, kinds = f"{count} {element.name}", [np.dtype(order + item.kind) for item in items]
    if not items or not count:
        none = np.zeros(0, np.int64)
        return {item.name: _column(item, np.zeros(0, item.kind), none) for item in items}, at
    compare_sizes(path, says, count * element.least_bytes(), len(data) - at, exact=False)

    byteorder = "little" if order == "<" else "big"

    def step(item: PlyProperty) -> tuple[int, int, Callable[[int], int] | None]:
        head, size = int(item.length[1:] or 0), np.dtype(item.kind).itemsize
        signed = item.length.startswith("i")

        def length_at(at: int) -> int:
            length = int.from_bytes(data[at : at + head], byteorder, signed=signed)
            if length < 0:
                raise UserError(f"{path}: false header, a list of {length} in {element.name}")
            return length

        return head, size, length_at if head else None

    steps = [step(item) for item in items]
    # As a rule all lists of a property are as long as the first.
    _, lengths, end = _walk([None], at, steps)
    compare_sizes(path, says, end, len(data), exact=False)
    if count * (end - at) <= len(data) - at:
        fields = []
        for i, item in enumerate(items):
            fields += [(f"n{i}", order + item.length)] if item.length else []
            fields += [(f"v{i}", kinds[i], (int(lengths[i, 0]),))]
        rows = np.frombuffer(data, np.dtype(fields), count, at)
        if all((rows[f"n{i}"] == lengths[i]).all() for i, x in enumerate(items) if x.length):
            columns: Columns = {}
            for i, item in enumerate(items):
                values, each = rows[f"v{i}"], np.repeat(lengths[i], count)
                values = values.reshape(-1) if item.length else values[:, 0]
                columns[item.name] = _column(item, values, each)
            return columns, at + count * (end - at)
    starts, lengths, end = _walk([None] * count, at, steps)
    compare_sizes(path, says, end, len(data), exact=False)
    if lengths.sum() > MAX_VALUES:
        raise UserError(f"{path}: over {MAX_VALUES} numbers, the limit for one file")
    raw, columns = np.frombuffer(data, np.uint8), {}
    for i, item in enumerate(items):
        places, size = spread(starts[i], lengths[i], steps[i][1]), steps[i][1]
        values = np.stack([raw[places + byte] for byte in range(size)], 1).view(kinds[i])[:, 0]
        columns[item.name] = _column(item, values, lengths[i])
    return columns, end
