"""Files of the page until the command ends."""

from __future__ import annotations

import tempfile
import threading
from contextlib import suppress
from pathlib import Path

MAX_TOTAL = 1 << 30  # bytes of all files together


class Store:
    """Folders below one folder, which gradio uses for uploads, too.

    Args:
        folder: exists, and belongs to this process only.
        limit: bytes of all files; beyond these, the oldest are removed.
    """

    def __init__(self, folder: Path, limit: int = MAX_TOTAL) -> None:
        self._folder, self._limit, self._lock = folder.resolve(), limit, threading.Lock()

    def new_folder(self) -> Path:
        """Make a new folder."""
        with self._lock:
            self._remove_oldest()
        return Path(tempfile.mkdtemp(dir=self._folder))

    def _remove_oldest(self) -> None:
        files = []
        for path in self._folder.glob("*/*"):
            with suppress(FileNotFoundError):  # renamed by its writer
                state = path.lstat()
                files.append((state.st_mtime, state.st_size, path))
        total = sum(size for _, size, _ in files)
        for _, size, path in sorted(files):
            if total <= self._limit:
                return
            total -= size
            path.unlink(missing_ok=True)
            with suppress(OSError):  # it has other files
                path.parent.rmdir()
