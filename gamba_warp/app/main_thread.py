"""Jobs of many threads that run on the main one."""

from __future__ import annotations

import queue
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Any, TypeVar

from ..errors import UserError

Result = TypeVar("Result")


class MainThread:
    """Queue of jobs that run on the thread that calls ``work``, the main thread.

    gradio calls from short-lived threads. Open3D aborts the process at its exit if it was used on a
    thread that has ended, and OpenMP makes a new team for every computing thread. So all jobs run
    on the main thread.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[tuple[Future, Callable, tuple]] = queue.SimpleQueue()
        self._ended = False

    def call(self, function: Callable[..., Result], *args: Any) -> Result:
        """Call the function on the main thread, wait, and return its result or raise its error.

        Raises:
            UserError: the main thread has ended.
        """
        future: Future[Result] = Future()
        self._jobs.put((future, function, args))
        if self._ended:
            future.cancel()
        try:
            return future.result()
        except CancelledError:
            raise UserError("gamba app was ended; start it again") from None

    def work(self) -> None:
        """Run jobs until Ctrl-C or another exception that is not an ``Exception``."""
        try:
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
        finally:  # release the threads that wait for a job
            self._ended = True
            while not self._jobs.empty():
                self._jobs.get()[0].cancel()
