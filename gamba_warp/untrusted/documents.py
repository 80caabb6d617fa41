"""JSON files of strangers: bounded in size and depth, decoded into declared types, or one line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar, overload

import msgspec

from ..errors import UserError

MAX_BYTES = 64 << 20  # a file of 100,000 views takes 60 MB; ours take a few kB
MAX_DEPTH = 32  # levels of lists and objects; ours have up to 6
MAX_LINE = 1 << 20  # bytes of a line of JSON Lines; ours have a few hundred, or a few thousand

Kind = TypeVar("Kind")


def read_bytes(path: str | Path, limit: int = MAX_BYTES) -> bytes:
    """Reads a whole file that is not larger than ``limit`` bytes.

    Raises:
        UserError: it is missing, is no plain file (a folder, a pipe, a device), cannot be read, or
            is too large.
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


@overload
def read_document(path: str | Path, kind: type[Kind], limit: int = MAX_BYTES) -> Kind: ...
@overload
def read_document(path: str | Path, kind: Any, limit: int = MAX_BYTES) -> Any: ...
def read_document(path: str | Path, kind: Any, limit: int = MAX_BYTES) -> Any:
    """Reads a JSON file as a value of ``kind``.

    Args:
        path: file, UTF-8.
        kind: what it must hold: a ``msgspec.Struct``, a dataclass, or a type such as
            ``dict[str, Any]``. Ranges and lengths are declared with ``msgspec.Meta``.
        limit: largest size, bytes.

    Raises:
        UserError: as for ``read_bytes`` and ``parse_document``.
    """
    return parse_document(read_bytes(path, limit), kind, str(path))


@overload
def parse_document(data: bytes | str, kind: type[Kind], source: str) -> Kind: ...
@overload
def parse_document(data: bytes | str, kind: Any, source: str) -> Any: ...
def parse_document(data: bytes | str, kind: Any, source: str) -> Any:
    """Decodes JSON text as a value of ``kind``; NaN and infinity are no JSON and are refused.

    Args:
        data: the text, UTF-8, with or without a byte order mark.
        kind: as for ``read_document``.
        source: where the text comes from, for the error's message.

    Raises:
        UserError: it is not JSON, is nested deeper than ``MAX_DEPTH``, or is not of ``kind``; the
            message says where in the document.
    """
    try:
        text = data.encode() if isinstance(data, str) else data
        check_depth(msgspec.json.decode(text.removeprefix(b"\xef\xbb\xbf")), source)
        return msgspec.json.decode(text.removeprefix(b"\xef\xbb\xbf"), type=kind)
    except msgspec.ValidationError as error:
        raise UserError(f"{source}: {error}") from error
    except RecursionError as error:
        raise UserError(f"{source}: nested deeper than {MAX_DEPTH} levels") from error
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise UserError(f"{source}: not valid JSON ({error})") from error


@overload
def read_lines(path: str | Path, kind: type[Kind]) -> Iterator[Kind]: ...
@overload
def read_lines(path: str | Path, kind: Any) -> Iterator[Any]: ...
def read_lines(path: str | Path, kind: Any) -> Iterator[Any]:
    """The whole lines of a JSON Lines file; what ``parse_document`` refuses is passed over.

    A process that was killed leaves a line that is cut off.

    Args:
        path: file, UTF-8.
        kind: of each line, as for ``read_document``.

    Raises:
        UserError: the file is missing, is no plain file, or cannot be read.
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
    """The value that an option's text means as JSON; the text itself where that is no JSON."""
    try:
        return parse_document(text, Any, "")
    except UserError:
        return text


def check_depth(value: Any, source: str) -> None:
    """Refuses nested lists and dictionaries of more than ``MAX_DEPTH`` levels.

    Raises:
        UserError: it is nested deeper.
    """
    level, depth = [value], 0
    while level:
        if depth > MAX_DEPTH:
            raise UserError(f"{source}: nested deeper than {MAX_DEPTH} levels")
        inner: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                inner.extend(v for v in item.values() if isinstance(v, (dict, list)))
            elif isinstance(item, (list, tuple)):
                inner.extend(v for v in item if isinstance(v, (dict, list)))
        level, depth = inner, depth + 1
