"""A choice of kernels that can be changed for a while, to measure what it costs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Choice(Generic[T]):
    """What is in force now, for all threads of the process.

    Attributes:
        value: what is in force.
    """

    def __init__(self, value: T) -> None:
        self.value = value

    @contextlib.contextmanager
    def use(self, value: T) -> Iterator[None]:
        """Puts ``value`` in force inside, and what was in force before it back at the end."""
        before, self.value = self.value, value
        try:
            yield
        finally:
            self.value = before
