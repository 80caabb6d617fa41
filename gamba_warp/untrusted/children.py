"""Runs a function for many items in child processes; a crashed child fails only its item.

Native libraries may crash, hang or exhaust the memory on untrusted bytes. In a child process this
fails one item, with a one-line reason, and a new child takes the next item.

A child is a fresh Python process (spawn: threads of native libraries do not survive a fork), takes
one item at a time, and is reused by the next call, because its imports take seconds. Children end
with their parent, however it ends. As with all processes spawned by ``multiprocessing``, a script
must have its calls below ``if __name__ == "__main__":``.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from ..errors import UserError, first_line
from ..processes import end_with_parent

_EXIT_SECONDS = 10.0  # timeout for the end of a killed process
_READY = "ready"


class Failed(NamedTuple):
    """Failure of an item, in place of its value, with a one-line reason."""

    reason: str


def run_each(
    function: Callable[[Any], Any],
    items: Sequence[Any],
    *,
    workers: int = 1,
    seconds: float | None = None,
    memory: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Call ``function(item)`` for every item in child processes; yield results as they complete.

    Args:
        function: a picklable function: of a module, or a ``functools.partial`` of one.
        items: picklable items.
        workers: number of children.
        seconds: limit for one item, or None. The first item of a child includes its imports.
        memory: bytes that a child may allocate, including its imports (half a gigabyte with
            torch), or None; only on Linux (``RLIMIT_DATA``).

    Yields:
        The item's index, and the function's value or ``Failed`` with its exception, the signal that
        killed its process, or the time limit.

    Raises:
        RuntimeError: child processes cannot be started.
    """
    waiting = list(range(len(items)))[::-1]
    busy: dict[int, _Child] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < max(1, workers):
                while _idle and not _idle[-1].is_alive():
                    _idle.pop().end()
                index, child = waiting.pop(), _idle.pop() if _idle else _Child()
                busy[index] = child
                child.begin(function, items[index], memory)
            for index, value in _wait_for_results(busy, seconds):
                child = busy.pop(index)
                if child.is_alive():
                    _idle.append(child)
                else:
                    child.end()
                yield index, value
    finally:  # also if the caller stops early or is interrupted
        for child in busy.values():
            child.end()


def end_idle() -> None:
    """End the idle children, and free their memory."""
    while _idle:
        _idle.pop().end()


def _wait_for_results(busy: dict[int, _Child], seconds: float | None) -> list[tuple[int, Any]]:
    """Wait for an event; return the finished items with their results."""
    left = None
    if seconds is not None:
        left = max(0.0, min(child.start for child in busy.values()) + seconds - time.monotonic())
    wait([w for child in busy.values() for w in (child.pipe, child.process.sentinel)], left)
    done = []
    for index, child in busy.items():
        result = child.result()
        if result is None and seconds is not None and time.monotonic() - child.start >= seconds:
            child.end()
            result = (Failed(f"took more than {seconds:g} seconds"),)
        if result is not None:
            done.append((index, result[0]))
    return done


class _Child:
    """Child process, and the pipe to it."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.pipe, remote = context.Pipe()
        # multiprocessing ends daemons when this process exits normally.
        self.process = context.Process(target=_serve, args=(remote, os.getpid()), daemon=True)
        self.process.start()
        remote.close()
        self.owner = os.getpid()
        self.ready = False
        self.start = time.monotonic()

    def is_alive(self) -> bool:
        # After a fork the child belongs to another process.
        return self.owner == os.getpid() and not self.pipe.closed and self.process.is_alive()

    def begin(self, function: Callable[[Any], Any], item: Any, memory: int | None) -> None:
        """Send a task. Errors of pickle are raised."""
        self.start = time.monotonic()
        message = pickle.dumps((os.getcwd(), memory, pickle.dumps((function, item))))
        with contextlib.suppress(OSError):  # it has died: reported by ``result``
            self.pipe.send_bytes(message)

    def result(self) -> tuple[Any] | None:
        """Return the value or ``Failed`` of the task; None while it is running."""
        try:
            if not self.pipe.poll() and self.process.is_alive():
                return None
            value = self.pipe.recv()
        except (OSError, EOFError, pickle.UnpicklingError):
            self.process.join(_EXIT_SECONDS)
            end = _describe_exit(self.process.exitcode)
            self.end()
            if not self.ready:
                raise RuntimeError(
                    f"a child process exited at its start ({end}); a script must "
                    "guard its calls with 'if __name__ == \"__main__\":'"
                ) from None
            return (Failed(f"its process {end}"),)
        if isinstance(value, str) and value == _READY:
            self.ready, self.start = True, time.monotonic()
            return None
        return (value[0],)

    def end(self) -> None:
        """Kill the process, and wait for its end."""
        if self.owner == os.getpid():
            self.process.kill()
            self.process.join(_EXIT_SECONDS)
        self.pipe.close()


_idle: list[_Child] = []


def _describe_exit(code: int | None) -> str:
    """Describe the end of a process."""
    if code is None:
        return "stopped answering"
    if code >= 0:
        return f"ended with exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else "unknown"
    memory = ", perhaps out of memory" if name == "SIGKILL" else ""
    return f"died of signal {-code} ({name}){memory}"


def _serve(pipe: Connection, parent: int) -> None:
    """Main loop of a child: run tasks until the parent ends."""

    def watch() -> None:  # where the system does not do it
        process = parent_process()
        if process is not None:
            process.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    end_with_parent(parent)  # also if a native call never lets that thread run
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: the parent ends its children
    os.dup2(2, 1)  # stdout belongs to the parent's command
    try:
        pipe.send(_READY)
        while True:
            folder, memory, task = pickle.loads(pipe.recv_bytes())
            pipe.send_bytes(_run_task(folder, memory, task))
    except (EOFError, OSError):
        return


def _run_task(folder: str, memory: int | None, data: bytes) -> bytes:
    """Run one task; return the pickled result, a tuple of one."""
    try:
        with contextlib.suppress(OSError):
            os.chdir(folder)  # so that relative paths are the parent's
        _limit(memory)
        function, item = pickle.loads(data)
        return pickle.dumps((function(item),))
    except UserError as error:
        reason = str(error)
    except MemoryError:
        reason = "not enough memory"
    except BaseException as error:
        reason = f"{type(error).__name__}: {error}"
    return pickle.dumps((Failed(first_line(reason)),))


def _limit(memory: int | None) -> None:
    if sys.platform != "linux":  # macOS does not enforce limits of memory
        return
    import resource

    # Not RLIMIT_AS: torch and other libraries reserve far more addresses than they use.
    most = resource.getrlimit(resource.RLIMIT_DATA)[1]
    limits = [limit for limit in (memory, most) if limit not in (None, resource.RLIM_INFINITY)]
    resource.setrlimit(resource.RLIMIT_DATA, (min(limits, default=most), most))
