"""One job at a time, all on the main thread.

gradio calls from threads that come and go. Open3D ends the whole process at its exit if it was used
on a thread that had ended before, and OpenMP makes a new team of threads for every thread that
computes. So the main thread, which has nothing else to do, computes.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Any, TypeVar

from ..errors import UserError

Result = TypeVar("Result")


class MainThread:
    """Jobs of other threads, done in turn by the one that calls ``work``."""

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[tuple[Future, Callable, tuple]] = queue.SimpleQueue()
        self._over = False

    def call(self, function: Callable[..., Result], *args: Any) -> Result:
        """Has the main thread call the function, and waits; what it raises is raised here.

        Raises:
            UserError: the main thread has ended.
        """
        future: Future[Result] = Future()
        self._jobs.put((future, function, args))
        if self._over:
            future.cancel()
        try:
            return future.result()
        except CancelledError:
            raise UserError("gamba app was ended; start it again") from None

    def work(self) -> None:
        """Does jobs until something that is no error of a job, such as Ctrl-C, ends it."""
        try:
            self._work()
        finally:  # who waits for a job must not wait for ever
            self._over = True
            while not self._jobs.empty():
                self._jobs.get()[0].cancel()

    def _work(self) -> None:
        while True:
            future, function, args = self._jobs.get()
            try:
                result = function(*args)
            except Exception as error:
                future.set_exception(error)
            except BaseException:
                future.cancel()
                raise
            else:
                future.set_result(result)
