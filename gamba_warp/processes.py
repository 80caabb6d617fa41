"""Commands in child processes, and requests to stop."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import IO

from .kernels.runtime.system import end_signals

LOOK = 0.1  # seconds between two polls of a process
GAMBA = (sys.executable, "-m", "gamba_warp")


def end_with_parent(parent: int) -> None:
    """Make this process end with its parent, even if the parent is killed; on Linux alone."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # 1: PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


def run_gamba(words: Sequence[str], output: IO[bytes] | None, received: Sequence[object]) -> int:
    """Run a command in a child process, which ends with this one.

    Args:
        words: of the command, such as ``["export", ..]``.
        output: receives stdout and stderr, and stdin is empty; None: it inherits all three.
        received: signals of this process (``stop_requests``); the child gets a SIGTERM after one.

    Returns:
        The exit code, -n for signal n.
    """
    child = subprocess.Popen(
        [*GAMBA, *words],
        stdin=None if output is None else subprocess.DEVNULL,
        stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
        start_new_session=output is not None,  # so that a Ctrl-C comes once, by ``received``
        preexec_fn=partial(end_with_parent, os.getpid()),
    )
    asked = False
    try:
        while child.poll() is None:
            time.sleep(LOOK)
            if received and not asked:
                child.terminate()
                asked = True
    finally:
        child.kill()  # does nothing if it is gone
        child.wait()
    return child.returncode


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
