"""Untrusted file names, which must stay inside a folder."""

from __future__ import annotations

import os
import unicodedata
from pathlib import Path, PurePosixPath, PureWindowsPath

from ..errors import UserError

MAX_NAME = 200  # bytes of one part, below the 255 of most file systems, so that suffixes fit
MAX_PATH = 1024  # bytes of the whole name


def inside(folder: str | Path, name: object, source: str) -> Path:
    """Return the path of a name that must stay inside a folder.

    Args:
        folder: base folder; need not exist.
        name: name from an archive, a catalogue or a dataset, separated by slashes; need not exist.
        source: the file and field with the name, for the error message.

    Returns:
        ``folder / name``, without ``.`` parts.

    Raises:
        UserError: the name is not text, empty, absolute, too long, has a drive, a ``..`` part, a
            backslash or a control character, or passes through a link that leaves the folder.
    """
    path = Path(folder).joinpath(*parts_of(name, source))
    base, real = os.path.realpath(folder), os.path.realpath(path)
    if os.path.commonpath([base, real]) != base:
        raise UserError(f"{source}: {name!r} is a link that leaves {folder}")
    return path


class Within:
    """``inside`` for many names of one folder: each of its subfolders is listed once.

    A listed name that is not a link needs no further system call; ``inside`` follows others.
    """

    def __init__(self, folder: str | Path) -> None:
        """Nothing is read yet."""
        self._folder = Path(folder)
        self._plain: dict[tuple[str, ...], set[str]] = {}

    def path(self, name: object, source: str) -> Path:
        """Return the path of a name. Arguments, result and errors as in ``inside``."""
        parts = parts_of(name, source)
        above = parts[:-1]
        if above not in self._plain:
            self._plain[above] = self._list(above, source)
        if parts[-1] in self._plain[above]:
            return self._folder.joinpath(*parts)
        return inside(self._folder, name, source)

    def _list(self, above: tuple[str, ...], source: str) -> set[str]:
        """Names in a subfolder except links; empty if it is missing or leaves the folder."""
        try:
            folder = inside(self._folder, "/".join(above), source) if above else self._folder
            with os.scandir(folder) as entries:
                return {entry.name for entry in entries if not entry.is_symlink()}
        except (UserError, OSError):
            return set()


def plain_name(name: object, source: str) -> str:
    """Check a name for a new file or folder: a single part of a path.

    Raises:
        UserError: as for ``inside``; also if it has several parts or begins with a dot.
    """
    parts = parts_of(name, source)
    if len(parts) != 1 or parts[0] != name:
        raise UserError(f"{source}: the name {name!r} is not a plain file name")
    if parts[0].startswith("."):
        raise UserError(f"{source}: the name {name!r} begins with a dot")
    return parts[0]


def parts_of(name: object, source: str) -> tuple[str, ...]:
    """Split a relative name, which need not exist, into its parts.

    Raises:
        UserError: as for ``inside``, except for links.
    """
    if not isinstance(name, str) or not name.strip():
        raise UserError(f"{source}: the name of a file is {repr(name)[:80]}, not text")
    shown = name if len(name) <= 80 else f"{name[:77]}..."
    if any(unicodedata.category(letter) in ("Cc", "Zl", "Zp") for letter in name):
        raise UserError(f"{source}: the name {shown!r} has a control character")
    try:
        sizes = [len(part.encode()) for part in (name, *PurePosixPath(name).parts)]
    except UnicodeEncodeError as error:
        raise UserError(f"{source}: the name {shown!r} is not UTF-8") from error
    if sizes[0] > MAX_PATH or max(sizes[1:], default=0) > MAX_NAME:
        raise UserError(f"{source}: the name {shown!r} is too long")
    if name.startswith("/") or "\\" in name or PureWindowsPath(name).drive:
        raise UserError(f"{source}: the name {shown!r} is not relative with slashes")
    parts = PurePosixPath(name).parts
    if ".." in parts or not parts:
        raise UserError(f"{source}: the name {shown!r} leaves its folder")
    return parts
