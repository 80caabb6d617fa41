"""A child process that reads hostile cases, one after the other, and judges what comes of each.

It has limits of memory and of file sizes, sees through Python's audit events what is opened and
started, and compares the folders around the case before and after. Only Linux has what it needs:
the command refuses elsewhere.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from pathlib import Path

from ..errors import UserError
from . import sound
from .case import Case, write_case
from .readers import READERS
from .verdict import Verdict

MOST_MEMORY = 2 << 30  # bytes that reading may take
_SLACK = 1 << 30  # bytes above it until allocations fail
_LARGEST_FILE = 1 << 30
_FOREIGN = ("/etc/passwd", "/dev/zero", "/dev/stdin", "/etc/hosts")
_STARTS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect")
# Python itself, for readers that start a child of their own; platform.uname asks the system.
_HARMLESS = (sys.executable, "uname")
_CHANGES = ("os.remove", "os.rename", "os.rmdir", "os.symlink", "os.link", "shutil.rmtree")


class Watch:
    """Notes what Python opens, removes and starts while a case is read.

    Attributes:
        found: what was noted, one line each.

    Args:
        base: folder of all that a child writes.
        box: folder in it of the case; only this may be read and written.
    """

    def __init__(self, base: Path, box: Path) -> None:
        self._base, self._allowed = f"{base}/", (f"{box}/", f"{base}/scratch")
        self._named: tuple[str, ...] = ()
        self._active = False
        self.found: list[str] = []
        sys.addaudithook(self._note)

    @contextlib.contextmanager
    def over(self, named: list[Path]) -> Iterator[None]:
        """Watches while a case is read.

        Args:
            named: files that may be links: the user named them, or the folder that they lie in.
        """
        self.found, self._named, self._active = [], tuple(map(str, named)), True
        try:
            yield
        finally:
            self._active = False

    def _note(self, event: str, arguments: tuple) -> None:
        if not self._active:
            return
        if event == "open" or event in _CHANGES:
            path = arguments[0]
            if isinstance(path, (str, bytes, os.PathLike)):
                self._active = False  # what follows opens nothing, but may be audited itself
                try:
                    self._check(event, os.fsdecode(path))
                finally:
                    self._active = True
        elif event in _STARTS:
            started = str(arguments[0])
            if started not in _HARMLESS:
                self.found.append(f"{event} {started[:80]}")

    def _check(self, event: str, path: str) -> None:
        if not os.path.isabs(path):  # it may count from an open folder, which the event leaves out
            return
        path = os.path.normpath(path)
        inside = path.startswith(self._base)
        if path.startswith(self._allowed):
            real = path if path in self._named or event != "open" else os.path.realpath(path)
            if not real.startswith((self._base, "/tmp/")) or not real.startswith(self._allowed):
                self.found.append(f"{event} of {real[:80]} by a link")
        elif inside or path in _FOREIGN or event in _CHANGES and not path.startswith("/tmp"):
            self.found.append(f"{event} of {path.removeprefix(self._base)[:80]}")


class Child:
    """Reads cases in a folder of its own.

    Args:
        base: an empty folder.
    """

    def __init__(self, base: Path) -> None:
        self.base, self.box = base, base / "outer" / "box"
        for name in ("canary", "outer/canary", "outer/box", "here", "scratch"):
            (base / name).mkdir(parents=True)
        for folder in (base / "canary", base / "outer" / "canary"):
            (folder / "kept.txt").write_text("kept\n", encoding="utf-8")
            (folder / "kept.png").write_bytes(b"kept")
        os.chdir(base / "here")
        tempfile.tempdir = str(base / "scratch")
        self._watch = Watch(base, self.box)
        self._around = self._listing(base, self.box)

    @staticmethod
    def _listing(folder: Path, without: Path | None = None) -> dict[str, tuple]:
        """Size and time of all that is in a folder."""
        found = {}
        for place, folders, files in os.walk(folder):
            here = Path(place)
            if here == without or here.name == "scratch":
                folders.clear()
                continue
            for name in (*folders, *files):
                state = (here / name).lstat()
                told = (state.st_mode, state.st_size, state.st_mtime_ns)
                found[f"{place}/{name}"] = told[:1] if name in folders else told
        return found

    def run(self, case: Case) -> Verdict:
        """Runs one case."""
        shutil.rmtree(self.box)
        files, out = self.box / "in", self.box / "out"
        files.mkdir(parents=True)
        out.mkdir()
        path = write_case(case, files)
        before = self._listing(files)
        _limit_memory()
        start, taken, printed = time.perf_counter(), _reset_peak(), os.fstat(1).st_size
        with self._watch.over([path, *(files / name for name in case.files)]):
            outcome, text = _attempt(case, path, files, out)
        seconds, peak = time.perf_counter() - start, _peak() - taken
        sys.stdout.flush()
        if outcome in ("sound", "refused"):
            found = [*self._watch.found]
            if self._listing(files) != before:
                found.append("its own files were changed")
            if self._listing(self.base, self.box) != self._around:
                found.append("files beside it were changed")
                self._around = self._listing(self.base, self.box)
            if found:
                outcome, text = "outside", found[0]
            elif peak > MOST_MEMORY:
                outcome, text = "memory", f"{peak >> 20} MB"
        # Verdicts are kept with the code: they name the files and no folder of a machine.
        text = text.replace(f"{files}{os.sep}", "").replace(str(self.base), "")
        return Verdict(outcome, text, seconds, peak, os.fstat(1).st_size > printed)


def _attempt(case: Case, path: Path, files: Path, out: Path) -> tuple[str, str]:
    """The outcome of reading, and a line about it."""
    reader = READERS[case.reader]
    try:
        result = reader.read(path, out)
        wrong = reader.sound(result, path, out)
    except UserError as error:
        if _has_memory_error(error):
            return "memory", str(error)
        wrong = sound.error(error, files, list(case.files))
        return ("line", f"{wrong}: {str(error)[:200]!r}") if wrong else ("refused", str(error))
    except MemoryError as error:
        return "memory", _where(error)
    except BaseException as error:  # SystemExit and a reader's own KeyboardInterrupt too
        return ("memory" if _has_memory_error(error) else "exception"), _where(error)
    return ("unsound", wrong) if wrong else ("sound", "")


def _has_memory_error(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError) or "DefaultCPUAllocator" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def _where(error: BaseException) -> str:
    """The kind of an exception, our line that it came through, and its words."""
    frames = traceback.extract_tb(error.__traceback__)
    others = ("/hostile/", "site-packages", "lib/python")
    ours = [f for f in frames if not any(part in f.filename for part in others)]
    last = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "?"
    words = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__} at {last}: {words[0][:160]}"


def _status(name: str) -> int:
    """Bytes that the kernel states of this process under a name."""
    with open("/proc/self/status", "rb") as file:
        for line in file:
            if line.startswith(name.encode()):
                return int(line.split()[1]) << 10
    return 0


def _limit_memory() -> None:
    """Bounds what is allocated from here on; libraries that came meanwhile are not counted."""
    import resource

    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    soft = _status("VmData:") + MOST_MEMORY + _SLACK
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _reset_peak() -> int:
    """Starts the measurement of the largest memory anew; returns the memory taken now, bytes."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
    return _status("VmRSS:")


def _peak() -> int:
    return _status("VmHWM:")


def _end_with_parent(base: str) -> None:
    """Waits until the parent is gone, however it ended; removes what the run has written, ends."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        shutil.rmtree(Path(base).parents[1], ignore_errors=True)
        os._exit(1)


def serve(connection: Connection, base: str, prepare: Callable[[], None] | None = None) -> None:
    """Runs cases that come through a connection, until the process is ended; first replies None.

    Args:
        connection: gives cases, takes verdicts.
        base: folder for the child's files, which is there and empty.
        prepare: called first, or None.
    """
    import resource

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's; it ends the children
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    threading.Thread(target=_end_with_parent, args=(base,), daemon=True).start()
    printed = os.open(Path(base) / "printed.txt", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(printed, stream)
    silent = os.open(os.devnull, os.O_RDONLY)
    os.dup2(silent, 0)
    if prepare is not None:
        prepare()
    inner = Path(base) / "work"
    inner.mkdir()
    import torch
    from tqdm import tqdm

    torch.set_num_threads(1)
    tqdm.set_lock(threading.RLock())  # its own would outlive a killed child, as a semaphore
    child = Child(inner)
    connection.send(None)
    while True:
        case: Case = connection.recv()
        connection.send(child.run(case))
        if os.fstat(1).st_size > 1 << 20:
            os.ftruncate(1, 0)
