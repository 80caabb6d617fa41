"""Names that strangers' files give: of a place inside a folder, or nothing."""

from __future__ import annotations

import os
import re
import sys
import unicodedata
from pathlib import Path, PurePosixPath, PureWindowsPath

from ..errors import UserError

MAX_NAME = 200  # bytes of one part, below the 255 of most file systems, so that suffixes fit
MAX_PATH = 1024  # bytes of the whole name
# What Windows takes for something else than the name of a file: a stream of it, a device.
_NOT_ON_WINDOWS = re.compile(r'.*([<>:"|?*]|[. ]$)|(con|prn|aux|nul|com\d|lpt\d) *(\..*)?$', re.I)


def inside(folder: str | Path, name: object, source: str) -> Path:
    """The path of a name that must stay inside a folder.

    Args:
        folder: where the name counts from; it need not exist.
        name: as an archive, a catalogue or a dataset gives it, parts parted by slashes; what does
            not exist yet is fine.
        source: the file, and the field in it, that gives the name, for the error's message.

    Returns:
        ``folder / name``, without ``.`` parts.

    Raises:
        UserError: no text, empty, absolute, with a drive, a ``..`` part, a backslash or a control
            character, over-long, on Windows also a name that it does not allow, or its way goes
            through a link that leaves the folder.
    """
    path = Path(folder).joinpath(*parts_of(name, source))
    try:
        base, real = os.path.realpath(folder), os.path.realpath(path)
        leaves = os.path.commonpath([base, real]) != base  # on Windows, an error for two drives
    except (OSError, ValueError) as error:
        raise UserError(f"{source}: the name {name!r} cannot be followed") from error
    if leaves:
        raise UserError(f"{source}: {name!r} is a link that leaves {folder}")
    return path


def plain_name(name: object, source: str) -> str:
    """A name that is one part of a path, fit for a new file or folder of ours.

    Raises:
        UserError: as for ``inside``; also where it has several parts or begins with a dot.
    """
    parts = parts_of(name, source)
    if len(parts) != 1 or parts[0] != name:
        raise UserError(f"{source}: the name {name!r} is not that of one file")
    if parts[0].startswith("."):
        raise UserError(f"{source}: the name {name!r} begins with a dot")
    return parts[0]


def parts_of(name: object, source: str) -> tuple[str, ...]:
    """The parts of a relative name, of which nothing need exist.

    Raises:
        UserError: as for ``inside``, links excepted.
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
    if sys.platform == "win32" and any(_NOT_ON_WINDOWS.match(part) for part in parts):
        raise UserError(f"{source}: Windows has no files of the name {shown!r}")
    return parts
