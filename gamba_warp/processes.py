"""Commands in child processes, with their exit, run time and peak memory."""

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

LOOK = 0.1  # seconds between two polls of a process
GAMBA = (sys.executable, "-m", "gamba_warp")


@dataclass(frozen=True)
class End:
    """Result of a process.

    Attributes:
        code: exit code, 128 + n for signal n.
        seconds: its run time.
        peak_memory: peak memory in bytes; None if the system does not report it.
    """

    code: int
    seconds: float
    peak_memory: int | None

    @property
    def stopped(self) -> bool:
        """True if a signal asked it to stop."""
        return self.code - 128 in (signal.SIGINT, *end_signals())


class Child:
    """A running child in its own process group; it ends with this process."""

    def __init__(
        self,
        command: Sequence[str],
        output: IO[bytes] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Start the process.

        Args:
            command: words, such as ``[*GAMBA, "export", ..]``.
            output: receives stdout and stderr, and stdin is empty; None: it inherits all three.
            environment: variables added to those of this process.

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
        """Make the child die with its parent; runs in the child."""
        import ctypes

        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # 1: PR_SET_PDEATHSIG
        if os.getppid() != self._parent:
            os._exit(1)

    def poll(self) -> End | None:
        """Return how it ended; None while it runs."""
        if self._process.returncode is None:
            number, status, usage = os.wait4(self._process.pid, os.WNOHANG)
            if number:
                self._process.returncode = os.waitstatus_to_exitcode(status)
                # In bytes on macOS, else in KiB.
                self._memory = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        code = self._process.returncode
        if code is None:
            return None
        seconds = time.monotonic() - self._started
        return End(code if code >= 0 else 128 - code, seconds, self._memory)

    def ask(self, number: int) -> None:
        """Send a signal to its process group."""
        with contextlib.suppress(OSError):
            os.killpg(self._process.pid, number)

    def kill(self) -> None:
        """Kill its process group, if it runs, and wait until it is gone."""
        if self._process.returncode is not None:
            return
        self.ask(signal.SIGKILL)
        self._process.kill()  # at least the process itself; does nothing if it is gone
        self._process.wait()

    def wait(self, look: Callable[[], None], seconds: float = math.inf) -> End | None:
        """Wait for its end; kill it on a timeout or an exception.

        Args:
            look: called every tenth of a second.
            seconds: time limit.

        Returns:
            How it ended; None if it was killed.
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
    """Collect the signals that ask this process to stop in the yielded list.

    An ignored SIGHUP stays ignored (``end_signals``).

    Args:
        insist: interrupt at once on a SIGINT after another signal.
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
