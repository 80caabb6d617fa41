"""Atomic writes: a file is either whole or not there."""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import UserError

# The folder of a checkout: of this package, tests/ and starter/. An installed package has neither.
CHECKOUT = Path(__file__).resolve().parent.parent
_PART = 1 << 20  # bytes read at once of a file that may be larger than the memory


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yields a temporary path in the same folder; on success it replaces ``path``, else it goes.

    The temporary name keeps the suffix of ``path``, since many writers go by it.

    Raises:
        UserError: the folder or the file cannot be written.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent
        )
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # mkstemp makes 0600
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, value: object) -> None:
    """Writes ``value`` as indented JSON, atomically; NaN and infinity are refused."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text)


def output_folder(path: str | Path) -> Path:
    """Makes the folder, parents included, and checks that files can be made in it.

    Raises:
        UserError: it is a file, or cannot be made or written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise UserError(f"cannot write into {path}: {error.strerror}") from error
    return path


def sha256(path: str | Path) -> str:
    """The SHA-256 of a file, 64 hexadecimal digits.

    Raises:
        UserError: the file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            while part := file.read(_PART):
                digest.update(part)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    return digest.hexdigest()


def check_sha256(path: str | Path, want: str) -> None:
    """Compares a file's SHA-256, or as many of its leading digits as ``want`` has.

    Raises:
        UserError: the file cannot be read or has another content.
    """
    got = sha256(path)
    if not got.startswith(want):
        raise UserError(f"{path}: SHA-256 is {got[: len(want)]}, expected {want}")
