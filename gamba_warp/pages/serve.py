"""One page for a browser at the other end of a tunnel."""

from __future__ import annotations

import contextlib
import http.server
import socket
import threading
from collections.abc import Iterable
from typing import Any

from ..errors import UserError

HOSTS = ("127.0.0.1", "localhost")
_TOLD = ("host", "origin", "sec-fetch-mode", "sec-fetch-site")
_CONNECTIONS = 16  # at once; a browser opens six
READ_SECONDS = 10.0  # a request must be there within them, and each piece of the page be taken
PIECE = 1 << 16  # bytes


def is_foreign(headers: Iterable[tuple[str, str]]) -> bool:
    """Whether a request to a server on 127.0.0.1 is not of its own page, nor of the user.

    A foreign web page in the same browser can send requests there, and even read the answers once
    it has given its own name that address (DNS rebinding). The browser says so in these headers,
    each of them once.

    Args:
        headers: all of the request, by their names.
    """
    said: dict[str, str] = {}
    for name, value in ((name.lower(), value) for name, value in headers):
        if name in said and name in _TOLD:
            return True
        said[name] = value
    host, site = said.get("host", ""), said.get("sec-fetch-site")
    name, colon, port = host.partition(":")
    if name not in HOSTS or (colon and not port.isdecimal()):
        return True
    if said.get("origin") not in (None, f"http://{host}"):
        return True
    followed = said.get("sec-fetch-mode") == "navigate"  # a link, whose page sees no answer
    return not followed and site not in (None, "none", "same-origin")


class PageServer(http.server.ThreadingHTTPServer):
    """A server with a thread for each connection, so that one that stalls holds up no other.

    At most ``_CONNECTIONS`` are open at once; further ones are closed at the door.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], content: bytes) -> None:
        self._free = threading.BoundedSemaphore(_CONNECTIONS)
        super().__init__(address, page_handler(content))

    def process_request(self, request: Any, client_address: Any) -> None:
        """Starts a thread, or closes the connection where there are too many."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answers one connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing: a client that leaves in the middle is no fault of the page."""


def page_server(content: bytes, port: int) -> http.server.HTTPServer:
    """A server of one page on this machine; ``serve_forever`` runs it.

    Args:
        content: the page.
        port: 0 picks a free one.

    Raises:
        UserError: the port is taken or not allowed.
    """
    try:
        return PageServer(("127.0.0.1", port), content)
    except OSError as error:
        raise UserError(f"--port {port}: {error.strerror}") from error


def page_handler(content: bytes) -> type[http.server.BaseHTTPRequestHandler]:
    """A request handler that answers ``/`` with one page, and everything else with 404.

    Requests for another host's name or from another page are refused (421).
    """

    class Handler(http.server.BaseHTTPRequestHandler):
        timeout = READ_SECONDS  # of each single read and write

        def handle(self) -> None:
            def end() -> None:
                with contextlib.suppress(OSError):  # it is closed already
                    self.connection.shutdown(socket.SHUT_RDWR)

            # A client that sends a letter now and then would pass every single read's limit.
            timer = threading.Timer(READ_SECONDS, end)
            timer.daemon = True
            self.reading = timer
            timer.start()
            try:
                super().handle()
            finally:
                timer.cancel()

        def do_GET(self) -> None:
            self.reading.cancel()
            if is_foreign(self.headers.items()):
                self.send_error(421)
                return
            if self.path != "/":
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            view = memoryview(content)
            for start in range(0, len(view), PIECE):  # a time limit is that of one piece
                self.wfile.write(view[start : start + PIECE])

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    return Handler
