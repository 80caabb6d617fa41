"""Untrusted JSON files: bounded in size and depth, decoded into declared types."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from ..errors import UserError

MAX_BYTES = 64 << 20  # a file of 100,000 views takes 60 MB; ours take a few kB
MAX_DEPTH = 32  # levels of lists and objects; ours have up to 6
MAX_LINE = 1 << 20  # bytes of a line of JSON Lines; ours have a few hundred, or a few thousand

Kind = TypeVar("Kind")


def read_bytes(path: str | Path, limit: int = MAX_BYTES) -> bytes:
    """Read a whole file of at most ``limit`` bytes.

    Raises:
        UserError: it is missing, not a plain file (a folder, a pipe, a device), unreadable, or too
            large.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise UserError(f"{path}: not a plain file")
        with open(path, "rb") as file:
            data = file.read(limit + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise UserError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > limit:
        raise UserError(f"{path}: over {limit >> 20} MB, the limit for such a file")
    return data


def read_document(path: str | Path, kind: type[Kind], limit: int = MAX_BYTES) -> Kind:
    """Read a JSON file as a value of ``kind``.

    Args:
        path: file, UTF-8.
        kind: expected type: a ``msgspec.Struct``, a dataclass, or a type such as
            ``dict[str, Any]``. Ranges and lengths are declared with ``msgspec.Meta``.
        limit: largest size, bytes.

    Raises:
        UserError: as for ``read_bytes`` and ``parse_document``.
    """
    return parse_document(read_bytes(path, limit), kind, str(path))


def parse_document(data: bytes | str, kind: type[Kind], source: str) -> Kind:
    """Decode JSON text as a value of ``kind``; NaN and infinity are not JSON and raise.

    Args:
        data: the text, UTF-8, with or without a byte order mark.
        kind: as for ``read_document``.
        source: origin of the text, for the error message.

    Raises:
        UserError: the text is not JSON, nested deeper than ``MAX_DEPTH``, or not of ``kind``; the
            message gives the position in the document.
    """
    try:
        text = (data.encode() if isinstance(data, str) else data).removeprefix(b"\xef\xbb\xbf")
        value = msgspec.json.decode(text)
        if isinstance(value, (dict, list)):
            check_depth(value, source)
        return msgspec.json.decode(text, type=kind)
    except msgspec.ValidationError as error:
        raise UserError(f"{source}: {error}") from error
    except RecursionError as error:
        raise UserError(f"{source}: nested deeper than {MAX_DEPTH} levels") from error
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise UserError(f"{source}: not valid JSON ({error})") from error


def read_lines(path: str | Path, kind: type[Kind]) -> Iterator[Kind]:
    """Yield the lines of a JSON Lines file, skipping those that ``parse_document`` rejects.

    A killed process may leave an incomplete line.

    Args:
        path: file, UTF-8.
        kind: of each line, as for ``read_document``.

    Raises:
        UserError: the file is missing, not a plain file, or unreadable.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: {'not a plain file' if path.exists() else 'no such file'}")
    try:
        with open(path, "rb") as file:
            while data := file.readline(MAX_LINE):
                try:
                    line = parse_document(data, kind, str(path))
                except UserError:
                    continue
                yield line
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error


def value_of(text: str) -> Any:
    """Parse an option's text as JSON; return the text itself if it is not JSON."""
    try:
        return parse_document(text, object, "")
    except UserError:
        return text


def check_depth(value: Any, source: str, left: int = MAX_DEPTH) -> None:
    """Check that lists and dictionaries are nested at most ``MAX_DEPTH`` levels.

    Raises:
        UserError: the value is nested deeper.
    """
    if left < 0:
        raise UserError(f"{source}: nested deeper than {MAX_DEPTH} levels")
    for item in value.values() if isinstance(value, dict) else value:
        if isinstance(item, (dict, list)):
            check_depth(item, source, left - 1)
