"""Code shared by the readers of shapes: stated counts against the size, numbers in a text."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from ..errors import UserError

MAX_FILE = 1 << 30  # bytes of a shape
SLACK = 2  # bytes after the end: a line end
MAX_COLUMNS = 1024  # of a table; descriptors of shape have up to 640
MAX_VALUES = 60_000_000  # numbers of one file; 480 MB as float64
BOM = b"\xef\xbb\xbf"
_BLOCK = 1 << 22  # bytes of a text that are read at once


class Source(NamedTuple):
    """An open file of a shape, at its start."""

    path: Path
    file: BinaryIO
    size: int  # bytes

    def head(self, count: int) -> bytes:
        """Return the first bytes, and leave the file at its start."""
        head = self.file.read(count)
        self.file.seek(0)
        return head

    def check(self, limit: int = MAX_FILE) -> None:
        """Raise UserError if the file has more bytes than the limit."""
        if self.size > limit:
            raise UserError(f"{self.path}: over {limit >> 20} MB, the limit for a shape")


@contextmanager
def open_shape(path: Path, limit: int = MAX_FILE) -> Iterator[Source]:
    """Open a shape file of at most ``limit`` bytes.

    Raises:
        UserError: it is missing, not a plain file, empty or too large, cannot be read, or the body
            runs out of memory.
    """
    try:
        if "\0" in str(path) or (path.exists() and not (path.is_file() or path.is_dir())):
            raise UserError(f"{path}: not a plain file")
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size == 0:
                raise UserError(f"{path}: the file is empty, not a {path.suffix} file")
            source = Source(path, file, size)
            source.check(limit)
            yield source
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}") from error
    except MemoryError as error:
        raise UserError(f"{path}: not enough memory for it") from error


def compare_sizes(path: Path, says: str, wanted: int, there: int, exact: bool = True) -> None:
    """Compare the bytes that a header states with those that follow it.

    Args:
        path: named in errors.
        says: content of the header, in words.
        wanted: bytes that it takes.
        there: bytes that follow.
        exact: also refuse more than ``SLACK`` bytes beyond ``wanted``.

    Raises:
        UserError: there are too few bytes, or too many.
    """
    if there < wanted:
        raise UserError(
            f"{path}: truncated or invalid header, {says} take {wanted} bytes but {there} follow"
        )
    if exact and there > wanted + SLACK:
        raise UserError(f"{path}: invalid header, {says} take {wanted} bytes but {there} follow")


def check_lines(path: Path, says: str, wanted: int, there: int) -> None:
    """Raise UserError unless a file has the number of lines that its header states (``says``)."""
    if there != wanted:
        raise UserError(f"{path}: truncated or invalid header, {says} but {there} lines follow")


def blocks_of(text: bytes, source: str) -> Iterator[bytes]:
    """Yield a text in parts of whole lines, which bounds the memory of intermediate results.

    Raises:
        UserError: a line is longer than a part.
    """
    at = 0
    while at < len(text):
        end = text.find(b"\n", at + _BLOCK, at + 2 * _BLOCK) + 1
        if not end and len(text) > at + 2 * _BLOCK:
            raise UserError(f"{source}: a line of more than {_BLOCK} characters")
        yield text[at : end or len(text)]
        at = end or len(text)


def parse_numbers(text: bytes, count: int, kind: Any = np.float64) -> np.ndarray | None:
    """Return the ``count`` words of a text as numbers ``[count]``; None if one is not a number."""
    if count == 0:
        return np.zeros(0, kind)
    try:
        numbers = np.fromstring(text, kind, sep=" ")
    except ValueError:
        return None
    # "1-2" is one word but two numbers; older releases of numpy stop at an invalid word.
    return numbers if len(numbers) == count else None


class Rows(NamedTuple):
    """Rows of numbers."""

    values: np.ndarray  # [M] float64, of all rows one after the other
    sizes: np.ndarray  # [N] int64, how many each row has

    def columns(self, *indices: int) -> np.ndarray:
        """Return these numbers of each row, ``[N, C]`` float64; undefined for shorter rows."""
        width = int(self.sizes[0]) if len(self.sizes) else 0
        if max(indices) < width and (self.sizes == width).all():
            return self.values.reshape(-1, width)[:, indices]
        at = (np.cumsum(self.sizes) - self.sizes)[:, None] + np.array(indices, np.int64)
        return np.append(self.values, 0.0).take(at, mode="clip")

    def part(self, first: int, count: int) -> Rows:
        """Return ``count`` rows from the ``first`` on."""
        start, sizes = self.sizes[:first].sum(), self.sizes[first : first + count]
        return Rows(self.values[start : start + sizes.sum()], sizes)

    def table(self, source: str, columns: tuple[int, ...] = ()) -> np.ndarray:
        """Return rows of one length as ``[N, C]`` float64.

        Args:
            source: named in errors.
            columns: allowed numbers of columns; empty: any.

        Raises:
            UserError: the rows differ in their length, or have another.
        """
        if not len(self.sizes):
            return np.zeros((0, columns[0] if columns else 0))
        count = int(self.sizes[0])
        if (columns and count not in columns) or count > MAX_COLUMNS:
            wanted = " or ".join(map(str, columns)) or f"{MAX_COLUMNS} at most"
            raise UserError(f"{source}: {count} columns in the first row, expected {wanted}")
        if (self.sizes != count).any():
            row = (self.sizes != count).argmax()
            change = f"changed from {count} to {self.sizes[row]} at row {row + 1}"
            raise UserError(f"{source}: the number of columns {change}")
        return self.values.reshape(-1, count)


def parse_rows(text: bytes) -> Rows | None:
    """Return the rows of a text, one a line, empty for a blank one; None if a word is no number."""
    lines = text.removesuffix(b"\n").split(b"\n") if text else []
    sizes = np.array([len(line.split()) for line in lines], np.int64)
    values = parse_numbers(text, int(sizes.sum()))
    return None if values is None else Rows(values, sizes)


def read_rows(text: bytes, source: str, comments: bool = False) -> Rows:
    """Read the rows of a text that are not blank; NaN and infinity are numbers here.

    Args:
        text: as in the file.
        source: named in errors.
        comments: leave out what follows a ``#`` in its line.

    Raises:
        UserError: a word is not a number, there are more than ``MAX_VALUES`` numbers, or as for
            ``blocks_of``.
    """
    parsed = [Rows(np.zeros(0), np.zeros(0, np.int64))]
    left = MAX_VALUES
    for block in blocks_of(text.removeprefix(BOM), source):
        block = without_comments(block) if comments else block
        rows = parse_rows(block)
        if rows is None:
            raise _no_number(block, source, sum(len(rows.sizes) for rows in parsed))
        left -= len(rows.values)
        if left < 0:
            raise UserError(f"{source}: over {MAX_VALUES} numbers, the limit for one file")
        parsed.append(Rows(rows.values, rows.sizes[rows.sizes > 0]))
    return joined_rows(parsed)


def joined_rows(parts: list[Rows]) -> Rows:
    """Return the rows of one part or more, one after the other."""
    return Rows(*(np.concatenate(arrays) for arrays in zip(*parts)))


def _no_number(block: bytes, source: str, before: int) -> UserError:
    """Return the error of the first word that is not a number, ``before`` rows from the start."""
    rows = (line.split() for line in block.split(b"\n") if not line.isspace() and line)
    words = ((word, row) for row, line in enumerate(rows, before + 1) for word in line)
    word, row = next((pair for pair in words if not is_number(pair[0])), (b"", before))
    shown = word[:60].decode("ascii", "replace")
    return UserError(f"{source}: could not convert '{shown}' of row {row} to a number")


def without_comments(text: bytes) -> bytes:
    """Return a text without what follows a ``#`` in its line."""
    return re.sub(rb"#[^\n]*", b"", text) if b"#" in text else text


def is_number(word: bytes) -> bool:
    """Return True if a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return b"_" not in word
