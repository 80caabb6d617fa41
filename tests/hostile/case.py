"""Fuzzing case as plain data: the files for a reader, and their mutations."""

import os
from collections.abc import Mapping
from pathlib import Path

import msgspec

from gamba_warp.untrusted.names import inside

FORMAT = "gamba_warp.stress_files.1"


class Entry(msgspec.Struct, frozen=True):
    """File of a case.

    Attributes:
        data: the bytes of a file; for a link, its target.
        kind: "file"; "folder" instead of a file; "pipe" without a writer; "link"; "locked", a file
            without read permission.
    """

    data: bytes = b""
    kind: str = "file"


class Case(msgspec.Struct, frozen=True):
    """Reproducible case.

    Attributes:
        reader: name of a reader.
        seed: name of the valid files that it was made of.
        main: name of the file or folder passed to the reader; "" is the whole folder.
        files: content of the case's folder, by names with slashes.
        mutations: descriptions of the mutations, in order.
    """

    reader: str
    seed: str
    main: str
    files: dict[str, Entry]
    mutations: tuple[str, ...] = ()


def valid_case(reader: str, seed: str, main: str, files: Mapping[str, bytes]) -> Case:
    """Make a case of plain files without mutations."""
    return Case(reader, seed, main, {name: Entry(data) for name, data in files.items()})


def place_case(case: Case, folder: Path) -> Path:
    """Write the case's files into an empty folder; return the path for the reader.

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
    """Write a case and its outcome as JSON, the format of ``corpus/``."""
    ended = {"outcome": outcome, "text": text.encode("utf-8", "replace").decode()}
    content = {"format": FORMAT, **msgspec.to_builtins(case), **ended}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(msgspec.json.format(msgspec.json.encode(content)) + b"\n")


def read_case(path: Path) -> Case:
    """Read a file of ``write_case``."""
    return msgspec.json.decode(path.read_bytes(), type=Case)
