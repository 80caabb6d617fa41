"""A hostile case as plain data: the files that a reader is given, and how they came about."""

import os
from collections.abc import Mapping
from pathlib import Path

import msgspec

from gamba_warp.untrusted.names import inside

FORMAT = "gamba_warp.stress_files.1"


class Entry(msgspec.Struct, frozen=True):
    """What lies at one name of a case.

    Attributes:
        data: the bytes of a file; of a link, the name that it points to.
        kind: "file"; "folder" in a file's place; "pipe" that nobody writes to; "link"; "locked", a
            file that may not be read.
    """

    data: bytes = b""
    kind: str = "file"


class Case(msgspec.Struct, frozen=True):
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
    files: dict[str, Entry]
    mutations: tuple[str, ...] = ()


def sound_case(reader: str, seed: str, main: str, files: Mapping[str, bytes]) -> Case:
    """A case of plain files to which nothing was done."""
    return Case(reader, seed, main, {name: Entry(data) for name, data in files.items()})


def place_case(case: Case, folder: Path) -> Path:
    """Puts the case's files into an empty folder; returns the path that the reader is pointed at.

    Raises:
        UserError: a name leaves the folder.
    """
    for name, entry in case.files.items():
        path = inside(folder, name, "case")
        path.parent.mkdir(parents=True, exist_ok=True)
        if entry.kind == "folder":
            path.mkdir(exist_ok=True)
        elif entry.kind == "pipe":
            os.mkfifo(path)
        elif entry.kind == "link":
            path.symlink_to(entry.data.decode("utf-8", "replace"))
        else:
            path.write_bytes(entry.data)
            path.chmod(0 if entry.kind == "locked" else 0o644)
    return folder / case.main if case.main else folder


def write_case(case: Case, path: Path, outcome: str = "", text: str = "") -> None:
    """Writes a case as JSON, with how it ended: what ``corpus/`` keeps."""
    ended = {"outcome": outcome, "text": text.encode("utf-8", "replace").decode()}
    content = {"format": FORMAT, **msgspec.to_builtins(case), **ended}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(msgspec.json.format(msgspec.json.encode(content)) + b"\n")


def read_case(path: Path) -> Case:
    """Reads what ``write_case`` wrote."""
    return msgspec.json.decode(path.read_bytes(), type=Case)
