"""Pretrained weights: where they are kept, and how they are fetched and unpacked."""

from __future__ import annotations

import io
import os
import pickle
import pickletools
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import UserError, first_line
from ..untrusted.arrays import plain_array

_MAX_PICKLE = 512 << 20  # bytes; that of LPIPS takes 59 MB
_MAX_MEMO = 1_000_000  # values that a pickle may number: room is taken up to the largest number


def cache_folder() -> Path:
    """The folder ``$GAMBA_CACHE``, else the system's place for caches; it may not be there yet.

    That is ``~/.cache/gamba_warp`` on Linux, and everywhere if it is there; else
    ``~/Library/Caches/gamba_warp`` on macOS, ``%LOCALAPPDATA%``'s ``gamba_warp/Cache`` on Windows.

    Raises:
        UserError: there is no home folder, and the variable is not set.
    """
    chosen = os.environ.get("GAMBA_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    try:
        wanted = Path.home() / ".cache" / "gamba_warp"
    except RuntimeError as error:
        raise UserError("there is no home folder; let GAMBA_CACHE name one for weights") from error
    if sys.platform != "linux" and not wanted.is_dir():
        from platformdirs import user_cache_path

        return user_cache_path("gamba_warp", appauthor=False)
    return wanted


@contextmanager
def pip_download(requirement: str, digest: str, source: bool = False) -> Iterator[Path]:
    """Fetches one release with pip, from whichever index pip is set up for.

    pip compares the digest before it looks into the file. For a source archive it then asks the
    package's own ``setup.py`` for metadata, so code of that very release is run.

    Args:
        requirement: name and version, ``name==1.2.3``.
        digest: SHA-256 of the one archive or wheel that is right.
        source: whether the source archive is taken, and not a wheel.

    Yields:
        The archive, in a temporary folder that is removed when the context ends.

    Raises:
        UserError: pip is missing or fails; the message carries pip's own last line.
    """
    name = requirement.split("==")[0]
    with tempfile.TemporaryDirectory() as folder:
        pins = Path(folder) / "pins.txt"
        pins.write_text(f"{requirement} --hash=sha256:{digest}\n", encoding="utf-8")
        files = Path(folder) / "files"
        files.mkdir()
        form = ["--no-binary" if source else "--only-binary", name]
        arguments = ["download", "--disable-pip-version-check", "--require-hashes", "--no-deps"]
        result = subprocess.run(
            [sys.executable, "-m", "pip", *arguments, *form, "-d", str(files), "-r", str(pins)],
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
        )
        found = sorted(files.iterdir())
        if result.returncode or len(found) != 1:
            lines = [line for line in result.stderr.splitlines() if line.strip()]
            reason = lines[-1].strip() if lines else f"exit code {result.returncode}"
            raise UserError(f"pip cannot fetch {requirement}: {reason}")
        yield found[0]


class _Dtype:
    """Stands for ``numpy.dtype``: a pickle's numbers about a type do not reach numpy."""

    def __init__(self, name: str, *_: object) -> None:
        self.name, self.order = name, "="

    def __setstate__(self, state: tuple) -> None:
        self.order = state[1]


class _Array:
    """Stands for an array until all its parts are there and ``plain_array`` has made it of them."""

    def __init__(self, *_: object) -> None:
        self.value: np.ndarray | None = None

    def __setstate__(self, state: tuple) -> None:
        _, shape, dtype, columns_first, data = state
        self.value = plain_array(data, dtype.order + dtype.name, shape, columns_first)


class _Unpickler(pickle.Unpickler):
    """An unpickler of arrays that calls nothing but the two stand-ins of this module."""

    def find_class(self, module: str, name: str) -> Any:
        if name == "_reconstruct" and module.endswith("multiarray"):
            return _Array
        if (module, name) == ("numpy", "dtype"):
            return _Dtype
        if (module, name) == ("numpy", "ndarray"):
            return name  # the argument of ``_reconstruct``, which nobody asks
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in this file")


def _check_sizes(data: bytes) -> None:
    """Refuses a pickle that states more than it holds, before memory is taken for it."""
    for code, argument, _ in pickletools.genops(data):  # a ValueError where bytes are missing
        if "PUT" in code.name and isinstance(argument, int) and argument > _MAX_MEMO:
            raise pickle.UnpicklingError(f"it numbers {argument} values")


def _unwrapped(value: Any, done: dict[int, Any]) -> Any:
    """The containers with arrays for their stand-ins; each is copied once, however often it is met.

    What holds itself goes too deep, which is a RecursionError.
    """
    if id(value) not in done:
        if isinstance(value, _Array) and value.value is not None:
            done[id(value)] = value.value
        elif isinstance(value, dict) and all(type(key) is str for key in value):
            done[id(value)] = {key: _unwrapped(item, done) for key, item in value.items()}
        elif isinstance(value, (list, tuple)):
            done[id(value)] = [_unwrapped(item, done) for item in value]
        else:
            raise pickle.UnpicklingError(f"it holds a {type(value).__name__.strip('_')}")
    return done[id(value)]


def load_numpy_pickle(file: BinaryIO, name: str) -> Any:
    """Reads a pickle of nested dicts and lists of arrays of plain numbers; all else is refused.

    numpy is not asked to unpickle: it would believe the numbers that describe an array's type.

    Args:
        file: open for reading bytes.
        name: what to call it in an error.

    Raises:
        UserError: not a pickle, truncated, larger than ``_MAX_PICKLE``, or it holds anything else.
    """
    try:
        data = file.read(_MAX_PICKLE + 1)
        if len(data) > _MAX_PICKLE:
            raise pickle.UnpicklingError(f"over {_MAX_PICKLE >> 20} MB")
        _check_sizes(data)
        return _unwrapped(_Unpickler(io.BytesIO(data)).load(), {})
    except Exception as error:  # a damaged pickle calls what it has with what it likes
        reason = first_line(error)
        raise UserError(f"{name}: not a pickle of numpy arrays ({reason})") from error
