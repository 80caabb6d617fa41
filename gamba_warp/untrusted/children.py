"""A function run for many items in child processes: what kills a child is one item's failure.

Native libraries that meet a stranger's bytes may crash, hang or take all memory. Here they do so in
a process that can be lost: its item gets one line as its reason, a new child takes the next item.

A child is a fresh Python process (spawn: threads of native libraries do not survive a fork), takes
one item at a time, and is kept for the next call, because its imports take seconds. Children end
with their parent, however that ends. As with everything that ``multiprocessing`` spawns, a script
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

from ..errors import UserError

_EXIT_SECONDS = 10.0  # in which a process that was killed is gone
_READY = "ready"


class Failed(NamedTuple):
    """What stands in place of a value: why there is none, in one line."""

    reason: str


def run_each(
    function: Callable[[Any], Any],
    items: Sequence[Any],
    *,
    workers: int = 1,
    seconds: float | None = None,
    memory: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Calls ``function(item)`` for every item in child processes; yields results as they come.

    Args:
        function: what pickle can name: of a module, or a ``functools.partial`` of such.
        items: what pickle can carry.
        workers: number of children.
        seconds: limit for one item, or None. The first item of a child includes its imports.
        memory: bytes that a child may allocate, its imports (half a gigabyte with torch) included,
            or None; on Linux alone (``RLIMIT_DATA``).

    Yields:
        The item's index, and the function's value or ``Failed``: what it raised, the signal that
        its process died of, or that it took too long.

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
            for index, value in _answers(busy, seconds):
                child = busy.pop(index)
                if child.is_alive():
                    _idle.append(child)
                else:
                    child.end()
                yield index, value
    finally:  # also where the caller stops early, or is interrupted
        for child in busy.values():
            child.end()


def end_idle() -> None:
    """Ends the children that are kept for the next call, and frees their memory."""
    while _idle:
        _idle.pop().end()


def _answers(busy: dict[int, _Child], seconds: float | None) -> list[tuple[int, Any]]:
    """Waits until something happens; returns the items that are done, and what came of them."""
    left = None
    if seconds is not None:
        left = max(0.0, min(child.start for child in busy.values()) + seconds - time.monotonic())
    wait([way for child in busy.values() for way in (child.pipe, child.process.sentinel)], left)
    done = []
    for index, child in busy.items():
        answer = child.answer()
        if answer is None and seconds is not None and time.monotonic() - child.start >= seconds:
            child.end()
            answer = (Failed(f"took more than {seconds:g} seconds"),)
        if answer is not None:
            done.append((index, answer[0]))
    return done


class _Child:
    """One process, and the pipe to it."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        # Daemons are ended by multiprocessing when this process ends in order.
        self.process = context.Process(target=_serve, args=(theirs, os.getpid()), daemon=True)
        self.process.start()
        theirs.close()
        self.owner = os.getpid()
        self.ready = False
        self.start = time.monotonic()

    def is_alive(self) -> bool:
        # After a fork the child is another's.
        return self.owner == os.getpid() and not self.pipe.closed and self.process.is_alive()

    def begin(self, function: Callable[[Any], Any], item: Any, memory: int | None) -> None:
        """Sends a task. Raises what pickle raises where it cannot be sent."""
        self.start = time.monotonic()
        message = pickle.dumps((os.getcwd(), memory, pickle.dumps((function, item))))
        with contextlib.suppress(OSError):  # it has died: ``answer`` says so
            self.pipe.send_bytes(message)

    def answer(self) -> tuple[Any] | None:
        """The value or ``Failed`` of the task; None where it is still at work."""
        try:
            if not self.pipe.poll() and self.process.is_alive():
                return None
            value = self.pipe.recv()
        except (OSError, EOFError, pickle.UnpicklingError):
            return (self._death(),)
        if isinstance(value, str) and value == _READY:
            self.ready, self.start = True, time.monotonic()
            return None
        return (value[0],)

    def _death(self) -> Failed:
        self.process.join(_EXIT_SECONDS)
        code = self.process.exitcode
        self.end()
        if not self.ready:
            raise RuntimeError(
                f"a child process ended before it began ({_of(code)}); a script must have its "
                "calls below 'if __name__ == \"__main__\":'"
            )
        return Failed(f"its process {_of(code)}")

    def end(self) -> None:
        """Ends the process at once, and waits until it is gone."""
        if self.owner == os.getpid():
            self.process.kill()
            self.process.join(_EXIT_SECONDS)
        self.pipe.close()


_idle: list[_Child] = []


def _of(code: int | None) -> str:
    """How a process ended, in words."""
    if code is None:
        return "stopped answering"
    if code >= 0:
        return f"ended with exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else "unknown"
    memory = ", perhaps for want of memory" if name == "SIGKILL" else ""
    return f"died of signal {-code} ({name}){memory}"


def _serve(pipe: Connection, parent: int) -> None:
    """The child: does tasks, until its parent is gone."""
    _end_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: the parent ends its children
    os.dup2(2, 1)  # stdout belongs to the parent's command
    try:
        pipe.send(_READY)
        while True:
            folder, memory, task = pickle.loads(pipe.recv_bytes())
            pipe.send_bytes(_done(folder, memory, task))
    except (EOFError, OSError):
        return


def _end_with_parent(parent: int) -> None:
    """Sees to it that this process does not outlive its parent, even one that is killed."""

    def watch() -> None:
        process = parent_process()
        if process is not None:
            process.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    if sys.platform == "linux":  # also where a native call never lets that thread run
        import ctypes

        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # 1: PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


def _done(folder: str, memory: int | None, data: bytes) -> bytes:
    """Does one task; returns the pickled answer, a tuple of one."""
    try:
        with contextlib.suppress(OSError):
            os.chdir(folder)  # relative paths mean what they mean to the parent
        _limit(memory)
        function, item = pickle.loads(data)
        return pickle.dumps((function(item),))
    except UserError as error:
        reason = str(error)
    except MemoryError:
        reason = "not enough memory"
    except BaseException as error:
        reason = f"{type(error).__name__}: {error}"
    return pickle.dumps((Failed((reason.strip().splitlines() or ["unknown"])[0]),))


def _limit(memory: int | None) -> None:
    if sys.platform != "linux":  # macOS has these limits, but heeds none of memory
        return
    import resource

    # Not RLIMIT_AS: torch and its friends reserve far more addresses than they ever use.
    most = resource.getrlimit(resource.RLIMIT_DATA)[1]
    limits = [limit for limit in (memory, most) if limit not in (None, resource.RLIM_INFINITY)]
    resource.setrlimit(resource.RLIMIT_DATA, (min(limits, default=most), most))
