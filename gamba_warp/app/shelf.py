"""What the page's visitors gave and got: files in a folder for each of them, for a while."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from pathlib import Path

from ..errors import UserError

KEPT = 3600  # seconds that files, pictures and results are kept, once nothing is done with them
MAX_KEPT = 1 << 30  # bytes of all files together; at least the largest --max-upload-mb


class Shelf:
    """Files of visitors below one folder: ``folder / visitor / chance / name``.

    Args:
        folder: it is there, and belongs to this process alone.
        limit: bytes of all files together; those that came first go.

    Attributes:
        limit: as given.
    """

    def __init__(self, folder: Path, limit: int = MAX_KEPT) -> None:
        self._folder, self.limit = folder.resolve(), limit
        self._sweeping = threading.Lock()

    def place(self, visitor: str) -> Path:
        """A new folder of a visitor, whose name nobody else can guess."""
        self.sweep()
        own = self._folder / visitor
        own.mkdir(mode=0o700, exist_ok=True)
        return Path(tempfile.mkdtemp(dir=own))

    def file(self, path: str, visitor: str) -> Path:
        """A file that a visitor names.

        Raises:
            UserError: it is not this visitor's; the message is the same whether it is there or not.
        """
        own = self._folder / visitor
        try:  # by its letters first; then no part of the way may be a link, or ``..``
            mine = Path(path).is_relative_to(own) and os.path.realpath(path) == path
            if mine and os.path.isfile(path):
                return Path(path)
        except (OSError, ValueError):  # too long, or with a NUL
            pass
        raise UserError("this file is not here, or no longer; give the picture once more")

    def sweep(self, coming: int = 0) -> None:
        """Removes what is old, and the oldest until there is room for some more bytes."""
        with self._sweeping:
            found = []
            for path in self._folder.glob("*/*/*"):
                try:
                    state = path.lstat()
                except FileNotFoundError:  # its writer has renamed it
                    continue
                found.append((state.st_mtime, state.st_size, path))
            total = coming + sum(size for _, size, _ in found)
            for when, size, path in sorted(found):
                if time.time() - when <= KEPT and total <= self.limit:
                    break
                total -= size
                path.unlink(missing_ok=True)
                if not os.listdir(path.parent):
                    path.parent.rmdir()
