"""One page for a browser at the other end of a tunnel."""

from __future__ import annotations

import http.server

from ..errors import UserError


def page_server(content: bytes, port: int) -> http.server.HTTPServer:
    """A server of one page on this machine; ``serve_forever`` runs it.

    Args:
        content: the page.
        port: 0 picks a free one.

    Raises:
        UserError: the port is taken or not allowed.
    """
    try:
        return http.server.HTTPServer(("127.0.0.1", port), page_handler(content))
    except OSError as error:
        raise UserError(f"--port {port}: {error.strerror}") from error


def page_handler(content: bytes) -> type[http.server.BaseHTTPRequestHandler]:
    """A request handler that answers ``/`` with one page, and everything else with 404."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path != "/":
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    return Handler
