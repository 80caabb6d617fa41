"""Untrusted ``.npy`` files: small arrays of numbers of a known shape, read without numpy.load.

``numpy.load`` trusts the content: it opens zip files, and allocates the size stated by the header.
"""

from __future__ import annotations

import io
import math
import re
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from ..errors import UserError
from .documents import read_bytes

MAX_BYTES = 1 << 20
_NUMBERS = re.compile("[<>|=](?:[iu][1248]|f(?:[248]|12|16))")
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_array(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Read an array of finite numbers.

    Args:
        path: file, at most ``MAX_BYTES``; any kind of integers or floats, of any byte order.
        shape: the required shape.

    Returns:
        float64 array of that shape.

    Raises:
        UserError: the file cannot be read, is not a ``.npy`` file of numbers, has another shape, or
            non-finite numbers.
    """
    try:
        array = _parse(read_bytes(path, MAX_BYTES), shape)
    except UserError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise UserError(f"{path}: cannot be read ({reason})") from error
    if not np.isfinite(array).all():
        raise UserError(f"{path}: not all of its numbers are finite")
    return array


def _parse(data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    file = io.BytesIO(data)
    try:
        header = _HEADERS[npy.read_magic(file)]
        stated, columns_first, dtype = header(file)
    except Exception as error:  # numpy uses Python's parser, which raises a dozen types
        raise UserError("its array header is invalid") from error
    wanted = "x".join(map(str, shape))
    if tuple(stated) != shape:
        got = "x".join(map(str, stated))[:40] or "a single number"
        raise UserError(f"expected {wanted} numbers, its header states {got}")
    array = plain_array(data[file.tell() :], dtype.str, shape, columns_first)
    with np.errstate(over="ignore", invalid="ignore"):
        return array.astype(np.float64)


def plain_array(data: bytes, dtype: str, shape: tuple[int, ...], columns_first: bool) -> np.ndarray:
    """Make an array of numbers from bytes, with all arguments untrusted.

    Args:
        data: bytes of the array.
        dtype: in numpy's notation: byte order, kind and bytes, ``<f4``.
        shape: shape of the array.
        columns_first: True if the first index runs fastest.

    Returns:
        Read-only array that shares the bytes.

    Raises:
        UserError: the type is not a plain integer or float, or the number of bytes does not match
            the shape.
    """
    if not isinstance(dtype, str) or not _NUMBERS.fullmatch(dtype):
        raise UserError(f"it holds {str(dtype)[:40]}, not numbers")
    if not isinstance(data, bytes) or not all(type(n) is int and n >= 0 for n in shape):
        raise UserError("its bytes or its shape have the wrong type")
    if len(data) != int(dtype[2:]) * math.prod(shape):
        stated = "x".join(map(str, shape))[:40]
        raise UserError(f"expected {stated} numbers, it holds {len(data)} bytes of them")
    return np.ndarray(shape, dtype, data, order="F" if columns_first else "C")
