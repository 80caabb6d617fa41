"""Jobs of many threads that run on the main one."""

from __future__ import annotations

import queue
import signal
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, TimeoutError
from contextlib import suppress
from types import FrameType
from typing import Any, TypeVar

from ..errors import UserError

Result = TypeVar("Result")
LOOK_SECONDS = 0.5  # between two looks whether the result of a job is still wanted
# In these functions, of imports and of compiled kernels, an error would last until the end.
_WHOLE = ("_find_and_load", "load")


class Cancelled(UserError):
    """An end of a job whose result is not wanted."""


class MainThread:
    """Queue of jobs that run on the thread that calls ``work``, the main thread.

    gradio calls from short-lived threads. Open3D aborts the process at its exit if it was used on a
    thread that has ended, and OpenMP makes a new team for every computing thread. So all jobs run
    on the main thread.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[tuple[Future, Callable, tuple]] = queue.SimpleQueue()
        self._running: Future | None = None
        self._unwanted: Future | None = None
        self._ended = False

    def call(
        self, function: Callable[..., Result], *args: Any, wanted: Callable[[], bool] = lambda: True
    ) -> Result:
        """Call the function on the main thread, wait, and return its result or raise its error.

        Args:
            function: to call.
            args: of the function.
            wanted: asked now and then; once it returns False, the function is interrupted.

        Raises:
            UserError: the main thread has ended; ``Cancelled`` if the result was not wanted.
        """
        future: Future[Result] = Future()
        self._jobs.put((future, function, args))
        if self._ended:
            future.cancel()
        try:
            while not future.done():
                with suppress(TimeoutError):
                    future.exception(LOOK_SECONDS)
                if self._running is future and not wanted():
                    self._unwanted = future
                    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)
            return future.result()
        except CancelledError:
            raise UserError("gamba app has stopped; restart it") from None

    def work(self) -> None:
        """Run jobs until Ctrl-C or another exception that is not an ``Exception``."""
        signal.signal(signal.SIGUSR1, self._interrupt)
        try:
            while True:
                future, function, args = self._jobs.get()
                try:
                    result = self._run(future, function, args)
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

    def _run(self, future: Future, function: Callable, args: tuple) -> Any:
        self._running = future
        try:
            return function(*args)
        finally:
            self._running = None

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        """Raise an error in an unwanted job."""
        while frame and frame.f_code.co_name not in _WHOLE:
            frame = frame.f_back
        if self._running and self._running is self._unwanted and not frame:
            raise Cancelled("it was cancelled, or its page was closed")
