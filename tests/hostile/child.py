"""Runs fuzzing cases in a child process and judges the outcomes.

The child has limits of memory and of file sizes, monitors opened files and started processes by
Python's audit events, and compares the folders around the case before and after. Linux only.
"""

import contextlib
import functools
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from gamba_warp.errors import UserError
from gamba_warp.untrusted.children import Failed, run_each

from . import checks
from .case import Case, place_case
from .readers import READERS

GOOD = {
    "sound": "read, with a valid result",
    "refused": "refused with one line that names the file",
}
BAD = {
    "exception": "an exception that is no UserError: the user would see a traceback",
    "line": "refused, but with several lines, an over-long one, or one that names no file",
    "unsound": "accepted, but not finite, out of range, or different from the file",
    "outside": "something outside the case's folder was opened, changed or started",
    "memory": "over 2 GB were taken or asked for",
    "hang": "no end within the time limit",
    "death": "the process died",
}
SECONDS = 20.0  # for a case
_FIRST = 180.0  # for the first case of a kind in a child, including its imports
_MAX_MEMORY = 2 << 30  # bytes for reading a case
_SLACK = 1 << 30  # bytes above it until allocations fail
_LARGEST_FILE = 1 << 30
_FOREIGN = ("/etc/passwd", "/dev/zero", "/dev/stdin", "/etc/hosts")
_STARTS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect")
# Python itself, for readers with their own child; platform.uname runs a program.
_HARMLESS = (sys.executable, "uname")
_CHANGES = ("os.remove", "os.rename", "os.rmdir", "os.symlink", "os.link", "shutil.rmtree")


class Verdict(NamedTuple):
    """Outcome of a case: one of ``GOOD`` or ``BAD``, and a line about it."""

    outcome: str
    text: str = ""

    @property
    def bad(self) -> bool:
        """True if the case failed."""
        return self.outcome in BAD

    def signature(self) -> str:
        """Key of equal failures of a reader: the text without numbers and names."""
        text = self.text.split(": ")[0] if self.outcome == "exception" else self.text
        return f"{self.outcome}: " + re.sub(r"['\"/].*?(['\"]|$)|\d+", "#", text)[:60]


def run_case(case: Case, base: Path, seconds: float = _FIRST) -> Verdict:
    """Run one case in a child process, reused by the next; ``base`` is a folder for it."""
    [(_, verdict)] = run_each(functools.partial(judge, base), [case], seconds=seconds)
    if isinstance(verdict, Failed):
        return Verdict("hang" if "took more than" in verdict.reason else "death", verdict.reason)
    return verdict


class Watch:
    """Records files opened and removed, and processes started, while a case is read.

    Args:
        base: folder for all files of a child.
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
        """Record during the body; ``named`` may be links, named by the user or in such a folder."""
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
                self._active = False  # the following may trigger audit events itself
                try:
                    self._check(event, os.fsdecode(path))
                finally:
                    self._active = True
        elif event in _STARTS and str(arguments[0]) not in _HARMLESS:
            self.found.append(f"{event} {str(arguments[0])[:80]}")

    def _check(self, event: str, path: str) -> None:
        if not os.path.isabs(path):  # may be relative to an open folder, unknown to the event
            return
        path = os.path.normpath(path)
        if path.startswith(self._allowed):
            real = path if path in self._named or event != "open" else os.path.realpath(path)
            if not real.startswith(self._allowed):
                self.found.append(f"{event} of {real[:80]} by a link")
        elif path.startswith(self._base) or path in _FOREIGN:
            self.found.append(f"{event} of {path.removeprefix(self._base)[:80]}")
        elif event in _CHANGES and not path.startswith("/tmp"):
            self.found.append(f"{event} of {path[:80]}")


class _Place:
    """Folders of a child: canaries around a box for cases, and a folder for its own files.

    Attributes:
        seen: readers with kinds of valid files whose imports are done.
    """

    def __init__(self, base: Path) -> None:
        import torch
        from tqdm import tqdm

        self.base, self.box = base, base / "outer" / "box"
        self.seen: set[tuple[str, str]] = set()
        for name in ("canary", "outer/canary", "outer/box", "here", "scratch"):
            (base / name).mkdir(parents=True)
        for folder in (base / "canary", base / "outer" / "canary"):
            (folder / "kept.txt").write_text("kept\n", encoding="utf-8")
            (folder / "kept.png").write_bytes(b"kept")
        tempfile.tempdir = str(base / "scratch")
        for stream in (0, 1, 2):  # output of a library is not a failure
            os.dup2(os.open(os.devnull, os.O_RDWR), stream)
        # Two readers start their own children, which a daemon must not.
        multiprocessing.current_process()._config["daemon"] = False
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
        resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, hard))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        torch.set_num_threads(1)
        tqdm.set_lock(threading.RLock())  # its own would outlive a killed child, as a semaphore
        self.watch = Watch(base, self.box)
        self.around = self.listing(base, self.box)

    @staticmethod
    def listing(folder: Path, without: Path | None = None) -> dict[str, tuple]:
        """Size and time of all files in a folder."""
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


@functools.cache
def _place(base: Path) -> _Place:
    return _Place(base / str(os.getpid()))


def judge(base: Path, case: Case) -> Verdict:
    """Read a case in this process."""
    place = _place(base)
    os.chdir(place.base / "here")
    shutil.rmtree(place.box)
    files, out = place.box / "in", place.box / "out"
    files.mkdir(parents=True)
    out.mkdir()
    path = place_case(case, files)
    before = place.listing(files)
    # Limit allocations from here on; libraries loaded before are not counted.
    most = resource.getrlimit(resource.RLIMIT_DATA)[1]
    soft = _status("VmData:") + _MAX_MEMORY + _SLACK
    resource.setrlimit(resource.RLIMIT_DATA, (soft, most))
    with contextlib.suppress(OSError):  # resets the peak of memory
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
    taken, start = _status("VmRSS:"), time.monotonic()
    with place.watch.over([path, *(files / name for name in case.files)]):
        outcome, text = _attempt(case, path, files, out)
    kind = case.reader, case.seed
    late = time.monotonic() - start > SECONDS and kind in place.seen
    peak = _status("VmHWM:") - taken
    place.seen.add(kind)
    if outcome in GOOD:
        found = [*place.watch.found]
        if place.listing(files) != before:
            found.append("its own files were changed")
        if place.listing(place.base, place.box) != place.around:
            found.append("files beside it were changed")
            place.around = place.listing(place.base, place.box)
        if found:
            outcome, text = "outside", found[0]
        elif peak > _MAX_MEMORY:
            outcome, text = "memory", f"{peak >> 20} MB"
        elif late:
            outcome, text = "hang", f"over {SECONDS:g} s"
    # Verdicts are stored in the repository, so they must not contain folders of a machine.
    return Verdict(outcome, text.replace(f"{files}{os.sep}", "").replace(str(place.base), ""))


def _attempt(case: Case, path: Path, files: Path, out: Path) -> tuple[str, str]:
    """Return the outcome of reading, and a line about it."""
    reader = READERS[case.reader]
    try:
        result = reader.read(path, out)
        try:
            reader.check(result, path, out)
        except AssertionError as wrong:
            return "unsound", str(wrong)
        return "sound", ""
    except UserError as error:
        if _has_memory_error(error):
            return "memory", str(error)
        try:
            checks.check_message(error, files, list(case.files))
        except AssertionError as wrong:
            return "line", f"{wrong}: {str(error)[:200]!r}"
        return "refused", str(error)
    except BaseException as error:  # SystemExit and a reader's own KeyboardInterrupt too
        return ("memory" if _has_memory_error(error) else "exception"), _where(error)


def _has_memory_error(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError) or "DefaultCPUAllocator" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def _where(error: BaseException) -> str:
    """Type of an exception, the last line of our code in its traceback, and its message."""
    frames = traceback.extract_tb(error.__traceback__)
    others = (str(Path(__file__).parent), "site-packages", "lib/python")
    ours = [f for f in frames if not any(part in f.filename for part in others)]
    last = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "?"
    words = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__} at {last}: {words[0][:160]}"


def _status(name: str) -> int:
    """Bytes in this process's status by the kernel, by name."""
    with open("/proc/self/status", "rb") as file:
        for line in file:
            if line.startswith(name.encode()):
                return int(line.split()[1]) << 10
    return 0
