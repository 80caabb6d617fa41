"""Limits on the connections of the app's server; uvicorn has none for slow requests.

A page in a browser uses up to six connections, two of them as long as it is open.
"""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

CONNECTIONS = 64  # at once
READ_SECONDS = 10.0  # time limit of reading a request, and of sending each piece
PIECE = 1 << 16  # bytes


class Connection(H11Protocol):
    """A connection with time limits for reading requests and sending answers.

    If there are too many, the one that has waited longest for its request is closed.
    """

    _reading: asyncio.TimerHandle | None = None  # runs while waiting for the head of a request
    _writing: asyncio.TimerHandle | None = None  # runs while the client reads nothing

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the read timer; close the oldest waiting connection if there are too many."""
        super().connection_made(transport)
        self._update_read_timer()
        if len(self.connections) > CONNECTIONS:
            waiting = [c for c in self.connections if isinstance(c, Connection) and c._reading]
            oldest = min(waiting, key=lambda c: c._reading.when() if c._reading else 0.0)
            self.connections.discard(oldest)
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timers."""
        super().connection_lost(exc)
        for timer in filter(None, (self._reading, self._writing)):
            timer.cancel()

    def data_received(self, data: bytes) -> None:
        """Receive a part of a request."""
        super().data_received(data)
        self._update_read_timer()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._update_read_timer()

    def pause_writing(self) -> None:
        """Start the write timer."""
        super().pause_writing()
        self._start_write_timer()

    def resume_writing(self) -> None:
        """Stop the write timer."""
        super().resume_writing()
        if self._writing:
            self._writing.cancel()

    def _update_read_timer(self) -> None:
        if self.cycle is None or self.cycle.response_complete:
            if self._reading is None:
                # close() sends pending answers first.
                self._reading = self.loop.call_later(READ_SECONDS, self.transport.close)
        elif self._reading:
            self._reading.cancel()
            self._reading = None

    def _start_write_timer(self) -> None:
        left = self.transport.get_write_buffer_size()

        def check() -> None:
            if self.transport.get_write_buffer_size() > left - PIECE:
                self.transport.abort()
            else:
                self._start_write_timer()

        self._writing = self.loop.call_later(READ_SECONDS, check)
