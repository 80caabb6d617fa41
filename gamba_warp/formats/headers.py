"""Checks shared by the readers of shapes: stated counts against the size, tables of numbers."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import UserError

MAX_FILE = 1 << 30  # bytes of a shape
SLACK = 2  # bytes after the end: a line end
MAX_LINE = 1 << 16  # letters: a point with a few hundred numbers
MAX_VALUES = 60_000_000  # numbers of one file; 480 MB as float64
_BOM = b"\xef\xbb\xbf"
# str.split treats four control characters as blanks; here they become other than ASCII.
_STRICT = bytes(0xFF if 0x1C <= number <= 0x1F else number for number in range(256))


@contextmanager
def open_shape(path: Path, limit: int = MAX_FILE) -> Iterator[tuple[BinaryIO, int]]:
    """Open a shape file of at most ``limit`` bytes; yield it and its size in bytes.

    Raises:
        UserError: it is missing, not a plain file, empty or too large, cannot be read, or the body
            runs out of memory.
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
            f"{path}: truncated or false header, {says} take {wanted} bytes but {there} follow"
        )
    if exact and there > wanted + SLACK:
        raise UserError(f"{path}: false header, {says} take {wanted} bytes but {there} follow")


def check_lines(path: Path, says: str, wanted: int, there: int) -> None:
    """Raise UserError if not as many lines are there as a header states by the words ``says``."""
    if there != wanted:
        raise UserError(f"{path}: truncated or false header, {says} but {there} lines follow")


def lines_of(file: BinaryIO, source: str, comments: str = "") -> Iterator[str]:
    """Yield the lines of a text file that are neither blank nor, with ``comments``, begin with it.

    Raises:
        UserError: a line is longer than ``MAX_LINE``.
    """
    first = True
    while line := file.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise UserError(f"{source}: a line of more than {MAX_LINE} letters")
        # Other characters than ASCII become one that no number has.
        line = (line.removeprefix(_BOM) if first else line).translate(_STRICT)
        text = line.decode("ascii", "replace")
        first = False
        if not text.isspace() and text and not (comments and text.lstrip().startswith(comments)):
            yield text


def read_table(lines: Iterable[str], source: str, columns: tuple[int, ...] = ()) -> np.ndarray:
    """Read lines of numbers as ``[N, C]`` float64; NaN and infinity are numbers here.

    Args:
        lines: one row each.
        source: named in errors.
        columns: allowed numbers of columns; empty: any.

    Raises:
        UserError: a word is not a number, the rows differ in their number of columns, or there are
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


def read_rows(lines: Iterable[str], source: str) -> tuple[np.ndarray, np.ndarray]:
    """Read rows of different lengths: ``[M]`` float64 of all rows, ``[N]`` int64 their lengths.

    Raises:
        UserError: as for ``read_table``.
    """
    sizes = []

    def words() -> Iterator[str]:
        for line in lines:
            row = line.split()
            sizes.append(len(row))
            yield from row

    numbers = read_table(words(), source, (1,))[:, 0]
    return numbers, np.array(sizes, np.int64)
