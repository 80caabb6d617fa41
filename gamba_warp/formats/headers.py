"""What readers of shapes share: counts that a file states against its size, and rows of numbers.

A file that lies is refused unread. In a text every row has the same columns, and
every word is a number.
"""

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
# str takes four control signs for blanks, which are none in a file: they become no ASCII.
_STRICT = bytes(0xFF if 0x1C <= number <= 0x1F else number for number in range(256))


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
