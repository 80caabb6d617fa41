"""``gamba view``: a file of Gaussians in the browser."""

from __future__ import annotations

import functools
import http.server
import tempfile
import webbrowser
from pathlib import Path

import tyro

from ..errors import UserError
from ..formats.ply import load_ply
from ..pages.page import Section, reconstruction_page
from ..surfaces.extract import moved_to_unit, unit_frame


def view_command(
    file: tyro.conf.Positional[Path],
    /,
    out: Path | None = None,
    serve: bool = False,
    port: int = 8000,
    open_browser: bool = True,
) -> None:
    """Shows Gaussians (.ply) in a browser, as one HTML page that needs no network.

    Args:
        file: Gaussians in the 3DGS layout.
        out: Where to keep the page; a temporary file if not given.
        serve: Serve it on this machine until Ctrl-C, for a browser at the other end of a tunnel.
        port: Of --serve; 0 picks a free one.
        open_browser: Open the browser.
    """
    if not 0 <= port < 65536:
        raise UserError("--port: 0 to 65535 are possible")
    gaussians = load_ply(file)
    moved = moved_to_unit(gaussians, *unit_frame(gaussians))
    page = out or Path(tempfile.mkdtemp(prefix="gamba-")) / f"{file.stem}.html"
    table = [("Gaussians", f"{gaussians.num:,}")]
    reconstruction_page(page, Section(file.stem, gaussians=moved, table=table))
    if not serve:
        print(page)
        if open_browser:
            webbrowser.open(page.resolve().as_uri())
        return
    try:
        server = http.server.HTTPServer(("127.0.0.1", port), page_handler(page.read_bytes()))
    except OSError as error:
        raise UserError(f"--port {port}: {error.strerror}") from error
    with server:
        address = f"http://127.0.0.1:{server.server_port}/"
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if open_browser:
            webbrowser.open(address)
        server.serve_forever()


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

        log_message = functools.partialmethod(lambda self, *args: None)

    return Handler
