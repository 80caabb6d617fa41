"""Bounds on the connections of the app's server; uvicorn has none for a request that comes slowly.

A page of one browser takes up to six connections, two of them for as long as it is open.
"""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

from ..pages.serve import PIECE, READ_SECONDS

CONNECTIONS = 64  # at once


class Connection(H11Protocol):
    """A connection whose requests must be there, and whose answers be taken, within a time.

    Where there are too many, the one that has waited longest for its request is closed.
    """

    _reading: asyncio.TimerHandle | None = None  # runs while the head of a request is awaited
    _writing: asyncio.TimerHandle | None = None  # runs while the client takes nothing

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Starts the clock, and makes room."""
        super().connection_made(transport)
        self._look()
        if len(self.connections) > CONNECTIONS:
            waiting = [c for c in self.connections if isinstance(c, Connection) and c._reading]
            oldest = min(waiting, key=lambda c: c._reading.when() if c._reading else 0.0)
            self.connections.discard(oldest)
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stops the clocks."""
        super().connection_lost(exc)
        for clock in filter(None, (self._reading, self._writing)):
            clock.cancel()

    def data_received(self, data: bytes) -> None:
        """Takes a part of a request."""
        super().data_received(data)
        self._look()

    def on_response_complete(self) -> None:
        """Waits for the next request."""
        super().on_response_complete()
        self._look()

    def pause_writing(self) -> None:
        """Gives the client time to take what was sent."""
        super().pause_writing()
        self._await_taking()

    def resume_writing(self) -> None:
        """Stops the clock."""
        super().resume_writing()
        if self._writing:
            self._writing.cancel()

    def _look(self) -> None:
        if self.cycle is None or self.cycle.response_complete:
            if self._reading is None:
                # What was answered before goes out first.
                self._reading = self.loop.call_later(READ_SECONDS, self.transport.close)
        elif self._reading:
            self._reading.cancel()
            self._reading = None

    def _await_taking(self) -> None:
        left = self.transport.get_write_buffer_size()

        def check() -> None:
            if self.transport.get_write_buffer_size() > left - PIECE:
                self.transport.abort()
            else:
                self._await_taking()

        self._writing = self.loop.call_later(READ_SECONDS, check)
