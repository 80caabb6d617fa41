"""Temporary files of the page's visitors, in a folder for each."""

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

KEEP_SECONDS = 3600  # time that unused files, images and results are kept
MAX_TOTAL = 1 << 30  # bytes of all files together; at least the largest --max-upload-mb
MAX_PER_VISITOR = 1 << 28  # bytes; at least one file of --max-upload-mb is allowed


class VisitorFiles:
    """Files of visitors below one folder: ``folder / visitor / random / name``.

    Files of an active visitor stay, except when that visitor's own new ones displace them.

    Args:
        folder: exists, and belongs to this process only.
        limit: bytes of all files together.
        per_visitor: bytes of one visitor's files.

    Attributes:
        limit: as given.
        per_visitor: as given.
    """

    def __init__(
        self, folder: Path, limit: int = MAX_TOTAL, per_visitor: int = MAX_PER_VISITOR
    ) -> None:
        self._folder, self.limit, self.per_visitor = folder.resolve(), limit, per_visitor
        self._active: Counter[str] = Counter()
        self._sweeping = threading.Lock()

    @contextmanager
    def visited(self, visitor: str) -> Iterator[int]:
        """Mark a visitor or page as active during a request; yields its number of requests."""
        self._active[visitor] += 1
        try:
            yield self._active[visitor]
        finally:
            self._active[visitor] -= 1
            if not self._active[visitor]:
                del self._active[visitor]

    def is_active(self, visitor: str) -> bool:
        """Return True during a request of a visitor or page."""
        return visitor in self._active

    def new_folder(self, visitor: str, coming: int = 0) -> Path:
        """Make a new folder of a visitor with an unpredictable name.

        Args:
            visitor: its owner.
            coming: bytes to make room for.

        Raises:
            UserError: files of active visitors leave no room.
        """
        with self._sweeping:
            if self._sweep(visitor, coming) > self.limit:
                raise UserError("files of other active visitors leave no room; try again later")
            own = self._folder / visitor
            own.mkdir(mode=0o700, exist_ok=True)
            return Path(tempfile.mkdtemp(dir=own))

    def file(self, path: str, visitor: str) -> Path:
        """Return the path of a visitor's file.

        Raises:
            UserError: it is not this visitor's; the message does not tell if it exists.
        """
        own = self._folder / visitor
        try:  # first as text; then no component may be a link or ``..``
            mine = Path(path).is_relative_to(own) and os.path.realpath(path) == path
            if mine and os.path.isfile(path):
                return Path(path)
        except (OSError, ValueError):  # too long, or with a NUL
            pass
        raise UserError("this file is missing or has expired; give the image again")

    def sweep(self) -> None:
        """Remove expired files of inactive visitors."""
        with self._sweeping:
            self._sweep()

    def _sweep(self, visitor: str = "", coming: int = 0) -> int:
        """Make room for a visitor, the oldest files first; return the total bytes."""
        found = []
        for path in self._folder.glob("*/*/*"):
            try:
                state = path.lstat()
            except FileNotFoundError:  # renamed by its writer
                continue
            found.append((state.st_mtime, state.st_size, path, path.parents[1].name))
        total = coming + sum(size for _, size, _, _ in found)
        mine = coming + sum(size for _, size, _, owner in found if owner == visitor)
        for when, size, path, owner in sorted(found):
            gone, own = owner not in self._active, owner == visitor
            old = gone and time.time() - when > KEEP_SECONDS
            if old or (total > self.limit and (gone or own)) or (own and mine > self.per_visitor):
                total -= size
                mine -= size if own else 0
                path.unlink(missing_ok=True)
                if not os.listdir(path.parent):
                    path.parent.rmdir()
        return total
