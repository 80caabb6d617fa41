"""One command of a row as its own process: its end, its time, the most memory that it took."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import one_line
from ..kernels.runtime.system import end_signals

GAMBA = [sys.executable, "-m", "gamba_warp"]
_TAIL = 1 << 14  # bytes of a log that are searched for what went wrong


@dataclass(frozen=True)
class End:
    """How a command ended.

    Attributes:
        code: exit code, 128 + n for signal n.
        seconds: how long it ran.
        peak_memory: most bytes of memory that it held; None where the system does not say.
    """

    code: int
    seconds: float
    peak_memory: int | None

    @property
    def stopped(self) -> bool:
        """Whether somebody asked it to stop; the same command goes on from there."""
        return self.code - 128 in (signal.SIGINT, *end_signals())


class Child:
    """A command that runs, in a process group of its own; it ends with this process."""

    def __init__(self, words: list[str], log: Path, threads: int) -> None:
        """Starts it; both its outputs are appended to a file.

        Args:
            words: of the command, without ``gamba``.
            log: the file.
            threads: threads of each library that it uses.

        Raises:
            OSError: the file cannot be written, or the process cannot be started.
        """
        number = str(threads)
        environment = {**os.environ, "OMP_NUM_THREADS": number, "MKL_NUM_THREADS": number}
        # A progress bar writes ten lines a second, and nobody looks.
        environment["TQDM_MININTERVAL"] = "30"
        self._parent = os.getpid()
        own: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "linux":
            own["preexec_fn"] = self._end_with_parent
        self._started = time.monotonic()
        with open(log, "ab") as output:
            output.write(f"$ gamba {' '.join(words)}\n".encode(errors="replace"))
            output.flush()
            self._process = subprocess.Popen(
                [*GAMBA, *words],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                **own,
            )

    def _end_with_parent(self) -> None:
        """In the child: a kill of this process is no reason to train on without it."""
        import ctypes

        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # 1: PR_SET_PDEATHSIG
        if os.getppid() != self._parent:
            os._exit(1)

    def poll(self) -> End | None:
        """How it ended; None while it runs."""
        memory = None
        if hasattr(os, "wait4"):
            number, status, usage = os.wait4(self._process.pid, os.WNOHANG)
            if number == 0:
                return None
            code = self._process.returncode = os.waitstatus_to_exitcode(status)
            # Bytes on macOS, 1,024 of them elsewhere.
            memory = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        else:
            code = self._process.poll()
            if code is None:
                return None
        seconds = time.monotonic() - self._started
        return End(code if code >= 0 else 128 - code, seconds, memory)

    def ask(self, at_once: bool = False) -> None:
        """Asks it, and all processes that it started, to end; ``at_once``: leaves it no choice."""
        with contextlib.suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(self._process.pid, signal.SIGKILL if at_once else signal.SIGTERM)
            elif at_once:
                self._process.kill()
            else:
                self._process.terminate()

    def kill(self) -> None:
        """Ends it at once, and waits until it is gone."""
        self.ask(at_once=True)
        while self._process.returncode is None and self.poll() is None:
            time.sleep(0.02)


@contextlib.contextmanager
def stop_requests() -> Iterator[list[int]]:
    """Collects the signals that ask this process to stop, in the yielded list."""
    received: list[int] = []
    old = {
        number: signal.signal(number, lambda number, frame: received.append(number))
        for number in (signal.SIGINT, *end_signals())
    }
    try:
        yield received
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


def why(code: int, log: Path) -> str:
    """Says in one line why a command failed, from its exit code and its outputs.

    Args:
        code: as ``End`` has it.
        log: the file of its outputs.
    """
    try:
        with open(log, "rb") as file:
            file.seek(max(0, log.stat().st_size - _TAIL))
            text = file.read().decode(errors="replace")
    except OSError:
        text = ""
    mark = "\n$ gamba "
    if mark in f"\n{text}":  # of its own run alone
        text = f"\n{text}".rpartition(mark)[2].partition("\n")[2]
    lines = [line.strip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    told = [line for line in lines if line.startswith(("gamba: ", "failed: "))]
    if code > 128:
        number = code - 128
        name = signal.Signals(number).name if number in {*signal.Signals} else "unknown"
        memory = ", perhaps for want of memory" if name == "SIGKILL" else ""
        return f"died of signal {number} ({name}){memory}"
    if told:
        return one_line(told[-1].removeprefix("gamba: "), 300)
    return one_line(f"exit code {code}: {lines[-1] if lines else 'it said nothing'}", 300)
