"""What the page's visitors gave and got: files in a folder for each of them, for a while."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import UserError

KEPT = 3600  # seconds that files, pictures and results are kept, once nothing is done with them
MAX_KEPT = 1 << 30  # bytes of all files together; at least the largest --max-upload-mb
MAX_OWN = (
    1 << 28
)  # bytes of one visitor's files; one file of the largest --max-upload-mb may be more


class Shelf:
    """Files of visitors below one folder: ``folder / visitor / chance / name``.

    Files of a visitor who is here stay, but for those that visitor's own new ones displace.

    Args:
        folder: it is there, and belongs to this process alone.
        limit: bytes of all files together.
        own: bytes of one visitor's files.

    Attributes:
        limit: as given.
        own: as given.
    """

    def __init__(self, folder: Path, limit: int = MAX_KEPT, own: int = MAX_OWN) -> None:
        self._folder, self.limit, self.own = folder.resolve(), limit, own
        self._here: Counter[str] = Counter()
        self._sweeping = threading.Lock()

    @contextmanager
    def visited(self, visitor: str) -> Iterator[int]:
        """A request of a visitor, who is here until it is answered; yields how many there are."""
        self._here[visitor] += 1
        try:
            yield self._here[visitor]
        finally:
            self._here[visitor] -= 1
            if not self._here[visitor]:
                del self._here[visitor]

    def place(self, visitor: str, coming: int = 0) -> Path:
        """A new folder of a visitor, whose name nobody else can guess.

        Args:
            visitor: who it is for.
            coming: bytes that there is to be room for.

        Raises:
            UserError: files of visitors who are here leave no room.
        """
        with self._sweeping:
            if self._sweep(visitor, coming) > self.limit:
                raise UserError("the files of others who are here leave no room; try again later")
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

    def sweep(self) -> None:
        """Removes what visitors who are gone left long ago."""
        with self._sweeping:
            self._sweep()

    def _sweep(self, visitor: str = "", coming: int = 0) -> int:
        """Makes room for a visitor, the oldest files first; returns the bytes of all together."""
        found = []
        for path in self._folder.glob("*/*/*"):
            try:
                state = path.lstat()
            except FileNotFoundError:  # its writer has renamed it
                continue
            found.append((state.st_mtime, state.st_size, path, path.parents[1].name))
        total = coming + sum(size for _, size, _, _ in found)
        mine = coming + sum(size for _, size, _, owner in found if owner == visitor)
        for when, size, path, owner in sorted(found):
            gone, own = owner not in self._here, owner == visitor
            old = gone and time.time() - when > KEPT
            if old or (total > self.limit and (gone or own)) or (own and mine > self.own):
                total -= size
                mine -= size if own else 0
                path.unlink(missing_ok=True)
                if not os.listdir(path.parent):
                    path.parent.rmdir()
        return total
