"""A hostile case as plain data: the files that a reader is given, and how they came about."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from ..errors import UserError
from ..untrusted.documents import read_document
from ..untrusted.names import inside

FORMAT = "gamba_warp.stress_files.1"
Kind = Literal["file", "folder", "pipe", "link", "locked"]


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """What lies at one name of a case.

    Attributes:
        kind: a file, a folder in a file's place, a pipe that nobody writes to, a symbolic link, or
            a file that may not be read.
        data: the bytes of a file; of a link, the name that it points to.
    """

    kind: Kind = "file"
    data: bytes = b""


@dataclass(frozen=True)
class Case:
    """All that is needed to run a case again.

    Attributes:
        reader: name of a reader.
        seed: name of the sound files that it was made of.
        main: name of the file or folder that the reader is pointed at; "" is the whole folder.
        files: what lies in the case's folder, by names with slashes.
        mutations: what was done to the sound files, in order.
    """

    reader: str
    seed: str
    main: str
    files: Mapping[str, Entry]
    mutations: tuple[str, ...] = ()

    def size(self) -> int:
        """The bytes of all files together."""
        return sum(len(entry.data) for entry in self.files.values())


def sound_case(reader: str, seed: str, main: str, files: Mapping[str, bytes]) -> Case:
    """A case of plain files to which nothing was done."""
    return Case(reader, seed, main, {name: Entry(data=data) for name, data in files.items()})


def write_case(case: Case, folder: Path) -> Path:
    """Puts the case's files into a folder, which must be there and empty.

    Returns:
        The path that the reader is pointed at.

    Raises:
        UserError: a name leaves the folder, or cannot be written.
    """
    try:
        for name, entry in case.files.items():
            path = inside(folder, name, "case")
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_entry(entry, path)
    except OSError as error:
        raise UserError(f"{folder}: the case cannot be written ({error.strerror})") from error
    return folder / case.main if case.main else folder


def _write_entry(entry: Entry, path: Path) -> None:
    if entry.kind == "folder":
        path.mkdir(exist_ok=True)
    elif entry.kind == "pipe":
        os.mkfifo(path)
    elif entry.kind == "link":
        path.symlink_to(entry.data.decode("utf-8", "replace"))
    else:
        path.write_bytes(entry.data)
        if entry.kind == "locked":
            path.chmod(0)


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """An entry in JSON; the bytes are in base64."""

    kind: Kind
    data: str


_Name = Annotated[str, msgspec.Meta(max_length=1024)]


class _Stored(msgspec.Struct, forbid_unknown_fields=True):
    """The file of a case."""

    format: Literal["gamba_warp.stress_files.1"]
    reader: _Name
    seed: _Name
    main: _Name
    files: Annotated[dict[_Name, _File], msgspec.Meta(max_length=1000)]
    mutations: Annotated[list[str], msgspec.Meta(max_length=1000)] = msgspec.field(
        default_factory=list
    )
    outcome: str = ""
    text: str = ""
    versions: dict[str, str] = msgspec.field(default_factory=dict)


def stored_case(case: Case, outcome: str, text: str, versions: dict[str, str]) -> dict:
    """The content of a file that ``read_case`` reads.

    Args:
        case: the case.
        outcome: how it ended.
        text: a line about that.
        versions: versions by name of what decides the outcome.
    """
    files = {
        name: {"kind": entry.kind, "data": base64.b64encode(entry.data).decode()}
        for name, entry in case.files.items()
    }
    return {
        "format": FORMAT,
        "reader": case.reader,
        "seed": case.seed,
        "main": case.main,
        "files": files,
        "mutations": list(case.mutations),
        "outcome": outcome,
        "text": text.encode("utf-8", "replace").decode(),
        "versions": versions,
    }


def read_case(path: str | Path, readers: Mapping[str, object]) -> Case:
    """Reads a case from its file.

    Args:
        path: JSON, as ``stored_case`` gives it.
        readers: the readers of this version, by name.

    Raises:
        UserError: missing, not of this format, of a reader that this version does not have, or a
            name in it leaves the case's folder.
    """
    stored = read_document(path, _Stored)
    if stored.reader not in readers:
        raise UserError(f"{path}: this version has no reader '{stored.reader[:80]}'")
    files = {}
    for name, item in stored.files.items():
        inside(Path(path).parent, name, f"{path}: files")
        try:
            data = base64.b64decode(item.data, validate=True)
        except ValueError as error:
            raise UserError(f"{path}: the bytes of {name} are not base64") from error
        files[name] = Entry(kind=item.kind, data=data)
    if stored.main:
        inside(Path(path).parent, stored.main, f"{path}: main")
    return Case(stored.reader, stored.seed, stored.main, files, tuple(stored.mutations))
