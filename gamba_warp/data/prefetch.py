"""Work that is done ahead on threads, and taken in a fixed order."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")


class Prefetcher(Generic[Part, Result]):
    """Makes results on threads before they are asked for; each is made of parts.

    The parts of one result are made by several threads at once, so the first result does not wait
    for one thread alone, and ``close`` waits for no more than one part of each thread. What a part
    computes must depend on its arguments alone: then the number of threads changes no result.
    """

    def __init__(self, threads: int) -> None:
        """Starts up to ``threads`` threads, >= 1, when there is work for them."""
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="prefetch")
        self._waiting: dict[Hashable, Future] = {}

    def __contains__(self, key: Hashable) -> bool:
        """Whether a result was started and not taken yet."""
        return key in self._waiting

    def submit(
        self,
        key: Hashable,
        parts: Sequence[Callable[[], Part]],
        join: Callable[[list[Part]], Result],
    ) -> None:
        """Starts a result.

        Args:
            key: name of the result, which is not waiting yet.
            parts: functions that make its parts.
            join: makes the result of the parts, in their order; it runs on a thread, too.
        """
        # The threads take their work in this order. So when a thread comes to the joining, others
        # have begun all parts that are not done, and it waits for no thread that waits for it.
        futures = [self._pool.submit(part) for part in parts]
        self._waiting[key] = self._pool.submit(lambda: join([part.result() for part in futures]))

    def take(self, key: Hashable) -> Result:
        """Waits for a result; an error of its parts, or of the joining, is raised here."""
        return self._waiting.pop(key).result()

    def close(self) -> None:
        """Drops what has not begun, and waits for the parts that have."""
        self._pool.shutdown(cancel_futures=True)
