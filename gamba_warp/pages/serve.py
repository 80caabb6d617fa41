"""Server of one page, for a browser at the other end of a tunnel."""

from __future__ import annotations

import contextlib
import http.server
import socket
import threading
from collections.abc import Iterable
from typing import Any

from ..errors import UserError

HOSTS = ("127.0.0.1", "localhost")
_CHECKED = ("host", "origin", "sec-fetch-mode", "sec-fetch-site")
_CONNECTIONS = 16  # at once; a browser opens six
READ_SECONDS = 10.0  # time limit of reading a request, and of sending each piece
PIECE = 1 << 16  # bytes


def is_foreign(method: str, headers: Iterable[tuple[str, str]]) -> bool:
    """Return True if a request to a server on 127.0.0.1 is neither of its page nor of the user.

    Another web page in the same browser can send requests there, and even read the answers by
    resolving its own name to that address (DNS rebinding). The browser reveals it by these headers,
    each of which comes once.

    Args:
        method: of the request, such as GET.
        headers: all of the request, by name.
    """
    found: dict[str, str] = {}
    for name, value in ((name.lower(), value) for name, value in headers):
        if name in found and name in _CHECKED:
            return True
        found[name] = value
    host, site = found.get("host", ""), found.get("sec-fetch-site")
    name, colon, port = host.partition(":")
    if name not in HOSTS or (colon and not port.isdecimal()):
        return True
    if found.get("origin") not in (None, f"http://{host}"):
        return True
    # The page of a link sees no answer; a form of another page, without an Origin, would act.
    followed = found.get("sec-fetch-mode") == "navigate" and method in ("GET", "HEAD")
    return not followed and site not in (None, "none", "same-origin")


class PageServer(http.server.ThreadingHTTPServer):
    """Server with a thread per connection, so that a stalled one blocks no other.

    At most ``_CONNECTIONS`` are open at once; further ones are closed immediately.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], content: bytes) -> None:
        self._free = threading.BoundedSemaphore(_CONNECTIONS)
        super().__init__(address, page_handler(content))

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread, or close the connection if there are too many."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: a client that disconnects is not an error."""


def page_server(content: bytes, port: int) -> http.server.HTTPServer:
    """Return a server of one page on this machine; ``serve_forever`` runs it.

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
    """Return a request handler that answers ``/`` with one page, and everything else with 404.

    Requests with another host name or from another page are refused (421).
    """

    class Handler(http.server.BaseHTTPRequestHandler):
        timeout = READ_SECONDS  # of each single read and write

        def handle(self) -> None:
            def end() -> None:
                with contextlib.suppress(OSError):  # already closed
                    self.connection.shutdown(socket.SHUT_RDWR)

            # A slow client could stay below the time limit of each single read.
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
            if is_foreign("GET", self.headers.items()):
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
            for start in range(0, len(view), PIECE):  # the time limit applies to one piece
                self.wfile.write(view[start : start + PIECE])

        def log_message(self, format: str, *args: object) -> None:
            """Print nothing."""

    return Handler
