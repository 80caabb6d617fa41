"""Commands as processes of their own: their end, their time, the most memory that they took."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import IO

from .kernels.runtime.system import end_signals

LOOK = 0.1  # seconds between two looks at a process
GAMBA = (sys.executable, "-m", "gamba_warp")


@dataclass(frozen=True)
class End:
    """How a process ended.

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
        """Whether somebody asked it to stop."""
        return self.code - 128 in (signal.SIGINT, *end_signals())


class Child:
    """A process that runs, in a group of its own; it ends with this process."""

    def __init__(
        self,
        command: Sequence[str],
        output: IO[bytes] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Starts it.

        Args:
            command: words, such as ``[*GAMBA, "export", ..]``.
            output: gets both its outputs, and it reads nothing; None: it has those of this process.
            environment: variables beside those of this process.

        Raises:
            OSError: it cannot be started.
        """
        self._parent = os.getpid()
        self._memory: int | None = None
        self._started = time.monotonic()
        self._process = subprocess.Popen(
            command,
            stdin=None if output is None else subprocess.DEVNULL,
            stdout=output,
            stderr=None if output is None else subprocess.STDOUT,
            env={**os.environ, **(environment or {})},
            start_new_session=True,
            preexec_fn=self._end_with_parent if sys.platform == "linux" else None,
        )

    def _end_with_parent(self) -> None:
        """In the child: a kill of this process is no reason to go on without it."""
        import ctypes

        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # 1: PR_SET_PDEATHSIG
        if os.getppid() != self._parent:
            os._exit(1)

    def poll(self) -> End | None:
        """How it ended; None while it runs."""
        if self._process.returncode is not None or not hasattr(os, "wait4"):
            self._process.poll()
        else:
            number, status, usage = os.wait4(self._process.pid, os.WNOHANG)
            if number:
                self._process.returncode = os.waitstatus_to_exitcode(status)
                # Bytes on macOS, 1,024 of them elsewhere.
                self._memory = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        code = self._process.returncode
        if code is None:
            return None
        seconds = time.monotonic() - self._started
        return End(code if code >= 0 else 128 - code, seconds, self._memory)

    def ask(self, number: int) -> None:
        """Sends a signal to it and to all processes that it started; Windows has only an end."""
        with contextlib.suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(self._process.pid, number)
            else:
                self._process.terminate()

    def kill(self) -> None:
        """Ends it with all that it started, if it runs, and waits until it is gone."""
        if self._process.returncode is not None:
            return
        if hasattr(os, "killpg"):
            self.ask(signal.SIGKILL)
        elif sys.platform == "win32":
            # By its whole path: Windows would look in the working directory before its own folders.
            root = os.environ.get("SystemRoot", "C:\\Windows")
            taskkill = os.path.join(root, "System32", "taskkill.exe")
            words = [taskkill, "/F", "/T", "/PID", str(self._process.pid)]
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                subprocess.run(words, capture_output=True, timeout=30)
        self._process.kill()  # does nothing if it is gone; else at least the process itself ends
        self._process.wait()

    def wait(self, look: Callable[[], None], seconds: float = math.inf) -> End | None:
        """Waits for its end, and ends it when its time is up or something is raised.

        Args:
            look: called every tenth of a second.
            seconds: time limit.

        Returns:
            How it ended, None if it was ended.
        """
        until = time.monotonic() + seconds
        try:
            while (end := self.poll()) is None and time.monotonic() < until:
                time.sleep(LOOK)
                look()
            return end
        finally:
            self.kill()


@contextlib.contextmanager
def stop_requests(insist: bool = False) -> Iterator[list[int]]:
    """Collects the signals that ask this process to stop, in the yielded list.

    A SIGHUP that is ignored stays so (``end_signals``).

    Args:
        insist: whether a SIGINT after another signal interrupts at once.
    """
    received: list[int] = []

    def note(number: int, frame: object) -> None:
        if insist and received and number == signal.SIGINT:
            raise KeyboardInterrupt
        received.append(number)

    old = {number: signal.signal(number, note) for number in (signal.SIGINT, *end_signals())}
    try:
        yield received
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
