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
    if not _NUMBERS.fullmatch(dtype.str):
        raise UserError(f"it holds {dtype.str[:40]}, not numbers")
    body = data[file.tell() :]
    if len(body) != dtype.itemsize * math.prod(shape):
        raise UserError(f"expected {wanted} numbers, it holds {len(body)} bytes of them")
    array = np.ndarray(shape, dtype, body, order="F" if columns_first else "C")
    with np.errstate(over="ignore", invalid="ignore"):
        return array.astype(np.float64)
