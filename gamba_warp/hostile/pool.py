"""Child processes for hostile cases: as many as are asked for, each started anew when it dies."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from ..kernels.runtime.system import end_signals
from .case import Case
from .child import serve
from .verdict import Verdict

SECONDS = 20.0  # for a case
_FIRST = 90.0  # for the first case of a reader in a child, which imports what it needs
_START = 180.0  # for a child to come up
_MEMORY_FOLDER = Path("/dev/shm")  # where a case's files cost no disk


class _Worker:
    """One child process, and what it is doing."""

    def __init__(self, folder: Path, prepare: Callable[[], None] | None) -> None:
        self._folder, self._number, self._prepare = folder, 0, prepare
        self._process: BaseProcess | None = None
        self.connection: Connection
        self.case: Case | None = None
        self.start()

    def start(self) -> None:
        self.stop()
        self._number += 1
        base = self._folder / str(self._number)
        base.mkdir(parents=True)
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, str(base), self._prepare))
        process.start()
        self._process = process
        theirs.close()
        self.case, self.ready, self._seen = None, False, set()
        self.began, self.limit = time.monotonic(), _START

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self.connection.close()
            shutil.rmtree(self._folder / str(self._number), ignore_errors=True)
            self._process = None

    def give(self, case: Case) -> None:
        self.case, self.began = case, time.monotonic()
        self.limit = SECONDS if case.reader in self._seen else _FIRST
        self._seen.add(case.reader)
        self.connection.send(case)

    def late(self) -> bool:
        return (self.case is not None or not self.ready) and self.left() <= 0

    def left(self) -> float:
        return self.began + self.limit - time.monotonic()

    def death(self) -> str:
        assert self._process is not None
        self._process.join(5)
        code = self._process.exitcode
        return f"ended with {code}" if code is None or code >= 0 else f"killed by signal {-code}"


class Pool:
    """Runs cases in child processes; a context manager, which ends them.

    Args:
        count: number of child processes.
        prepare: called in each of them first; for readers of a test.

    Raises:
        RuntimeError: a child does not come up.
    """

    def __init__(self, count: int, prepare: Callable[[], None] | None = None) -> None:
        place = _MEMORY_FOLDER if _MEMORY_FOLDER.is_dir() else None
        self._folder = Path(tempfile.mkdtemp(prefix="gamba-hostile-", dir=place))
        self._signals: dict[int, object] = {}
        self._workers = [_Worker(self._folder / str(i), prepare) for i in range(count)]

    def __enter__(self) -> Pool:
        if threading.current_thread() is threading.main_thread():  # no other may set handlers
            for number in end_signals():  # as Ctrl-C: what was found is kept
                self._signals[number] = signal.signal(number, signal.default_int_handler)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._signals.items():
            signal.signal(number, handler)  # pyright: ignore[reportArgumentType]
        for worker in self._workers:
            worker.stop()
        shutil.rmtree(self._folder, ignore_errors=True)

    def run(self, cases: Iterator[Case], seconds: float) -> Iterator[tuple[Case, Verdict]]:
        """Runs cases until there are no more or the time is up; yields each when it is judged.

        Args:
            cases: drawn one by one, when a child is free.
            seconds: no case is begun later; may be infinite.
        """
        end, more = time.monotonic() + seconds, True
        while True:
            for worker in self._workers:
                if worker.ready and worker.case is None and more:
                    case = next(cases, None) if time.monotonic() < end else None
                    more = case is not None
                    if case is not None:
                        worker.give(case)
            if not more and all(worker.case is None for worker in self._workers):
                return
            yield from self._finished()

    def run_one(self, case: Case) -> Verdict:
        """Runs one case."""
        return next(verdict for _, verdict in self.run(iter([case]), float("inf")))

    def _finished(self) -> list[tuple[Case, Verdict]]:
        """Waits until something happens; the cases that are judged since."""
        busy = [w for w in self._workers if w.case is not None or not w.ready]
        least = min(worker.left() for worker in busy)
        told = wait([worker.connection for worker in busy], max(0.0, least))
        done = []
        for worker in busy:
            if worker.connection in told:
                done += self._heard(worker)
            elif worker.late():
                done += self._restarted(worker, "hang", f"over {worker.limit:g} s")
        return done

    def _heard(self, worker: _Worker) -> list[tuple[Case, Verdict]]:
        try:
            verdict = worker.connection.recv()
        except (EOFError, OSError):
            return self._restarted(worker, "death", worker.death())
        worker.ready = True
        case, worker.case = worker.case, None
        return [(case, verdict)] if case is not None else []

    def _restarted(self, worker: _Worker, outcome: str, text: str) -> list[tuple[Case, Verdict]]:
        case, seconds = worker.case, time.monotonic() - worker.began
        if case is None:
            raise RuntimeError(f"a child process does not come up: {text}")
        worker.start()
        return [(case, Verdict(outcome, text, seconds))]
