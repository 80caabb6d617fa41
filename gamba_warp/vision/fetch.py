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
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import UserError, first_line
from ..kernels.runtime.cache import writable_folder

_MAX_PICKLE = 512 << 20  # bytes; that of LPIPS takes 59 MB
_MAX_MEMO = 1_000_000  # values that a pickle may number: room is taken up to the largest number


def cache_folder() -> Path:
    """The folder ``$GAMBA_CACHE``, else the system's place for caches; it may not be there yet.

    That is ``~/.cache/gamba_warp`` on Linux, and everywhere if it is there; else
    ``~/Library/Caches/gamba_warp`` on macOS, ``%LOCALAPPDATA%``'s ``gamba_warp/Cache`` on Windows.
    Where there is no home, or nothing can be made in it, a temporary folder.
    """
    chosen = os.environ.get("GAMBA_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    try:
        wanted = Path.home() / ".cache" / "gamba_warp"
        if sys.platform != "linux" and not wanted.is_dir():
            from platformdirs import user_cache_path

            wanted = user_cache_path("gamba_warp", appauthor=False)
    except RuntimeError:  # the system knows no home of this user
        wanted = None
    return wanted if wanted is not None and wanted.is_dir() else _usable(wanted)


@cache
def _usable(wanted: Path | None) -> Path:
    """``writable_folder``, asked and said once."""
    return writable_folder(wanted, "gamba-warp-weights")


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


class _NumpyUnpickler(pickle.Unpickler):
    """An unpickler that knows dense arrays only, so that a pickle can build no other object."""

    def find_class(self, module: str, name: str) -> Any:
        if name == "_reconstruct" and module.endswith("multiarray"):
            return _empty_array
        if (module, name) in {("numpy", "ndarray"), ("numpy", "dtype")}:
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in this file")


def _empty_array(*_: object) -> np.ndarray:
    """Stands for numpy's own, which takes memory by a shape; the true one comes with the bytes."""
    return np.empty(0)


def _check_sizes(data: bytes) -> None:
    """Refuses a pickle that states more than it holds, before memory is taken for it."""
    for code, argument, _ in pickletools.genops(data):  # a ValueError where bytes are missing
        if "PUT" in code.name and isinstance(argument, int) and argument > _MAX_MEMO:
            raise pickle.UnpicklingError(f"it numbers {argument} values")


def _check_arrays(value: Any, seen: set[int]) -> None:
    """Refuses arrays of Python objects anywhere in nested containers."""
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        raise pickle.UnpicklingError("it holds an array of objects")
    if isinstance(value, (dict, list, tuple)) and id(value) not in seen:
        seen.add(id(value))
        for item in value.values() if isinstance(value, dict) else value:
            _check_arrays(item, seen)


def load_numpy_pickle(file: BinaryIO, name: str) -> Any:
    """Reads a pickle of nested containers of numpy arrays; any other class is refused.

    Args:
        file: open for reading bytes.
        name: what to call it in an error.

    Raises:
        UserError: not a pickle, truncated, larger than ``_MAX_PICKLE``, or holds another class.
    """
    try:
        data = file.read(_MAX_PICKLE + 1)
        if len(data) > _MAX_PICKLE:
            raise pickle.UnpicklingError(f"over {_MAX_PICKLE >> 20} MB")
        _check_sizes(data)
        value = _NumpyUnpickler(io.BytesIO(data)).load()
        _check_arrays(value, set())
        return value
    except Exception as error:  # a damaged pickle calls what it has with what it likes
        reason = first_line(error)
        raise UserError(f"{name}: not a pickle of numpy arrays ({reason})") from error
