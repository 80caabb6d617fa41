"""``gamba app``: a page on 127.0.0.1 until Ctrl-C; its files are removed at the end."""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import signal
import socket
import stat
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from msgspec import Meta

from ..conventions import DeviceChoice
from ..errors import UserError
from ..files import only_process
from ..untrusted.ranges import ranged
from .main_thread import MainThread
from .store import Store

if TYPE_CHECKING:
    import gradio as gr

HOST = "127.0.0.1"
PREFIX = "gamba-app-"
_PAGES = 8  # pages whose images and results are kept at once
_EXPECTED = ("ClientDisconnect", "LocalProtocolError")  # errors of a page that is closed


@ranged
def app_command(
    *,
    checkpoint: Path | None = None,
    encoder_weights: Path | None = None,
    matte_model: Annotated[str | None, tyro.conf.arg(metavar="FILE|URL")] = None,
    port: Annotated[int, Meta(ge=0, le=65535)] = 7860,
    open_browser: bool = True,
    max_upload_mb: Annotated[int, Meta(ge=1, le=1024)] = 30,
    device: DeviceChoice = "auto",
) -> None:
    """Serve a page on this machine that turns images into 3D objects, until Ctrl-C.

    Args:
        checkpoint: Trained model (.safetensors); the shipped model by default.
        encoder_weights: The image encoder's weights, if the model has a pretrained one.
        matte_model: ONNX file of an ISNet or U2-Net that cuts objects out, or a URL of one of
            rembg's; by default rembg's copy on this machine, else it is fetched once (179 MB).
        port: Port of 127.0.0.1; 0 picks a free one.
        open_browser: Open the browser; the address is printed in any case.
        max_upload_mb: Largest image file, MB.
        device: Device that computes; auto is the GPU if there is one.
    """
    with listener(port) as listening, work_folder() as folder:
        print("loading the model", flush=True)
        from ..devices import pick_device
        from ..model.checkpoint import load_model
        from ..photo.cutout import CutoutOptions

        chosen = pick_device(device)
        options = CutoutOptions(matte_model=matte_model, device=chosen).checked()
        model = load_model(checkpoint, chosen, encoder_weights)
        print("loading the page's libraries", flush=True)
        configure_gradio(folder)
        from .actions import Actions
        from .interface import build

        main_thread = MainThread()
        page = build(Actions(model, options, Store(folder), str(chosen), main_thread))
        serve(page, listening, max_upload_mb, open_browser, main_thread)


@contextmanager
def work_folder() -> Iterator[Path]:
    """Make a temporary folder for the page's files, removed at the end.

    Folders of killed processes, whose locks are free, are removed at the start.
    """
    for old in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        _remove_leftover(old)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX)).resolve()
    try:
        with only_process(folder, "serves"):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_leftover(folder: Path) -> None:
    """Remove a folder that an ended ``gamba app`` of this user left, and no other."""
    try:
        status = folder.lstat()
    except OSError:  # removed meanwhile
        return
    # Other users may create a folder or link of this name.
    ours = status.st_uid == os.geteuid() and not status.st_mode & 0o077
    if not (stat.S_ISDIR(status.st_mode) and ours):
        return
    if not (folder / ".lock").is_file():  # another process is creating it
        return
    try:
        with only_process(folder, "serves"):
            shutil.rmtree(folder, ignore_errors=True)
    except UserError:  # in use
        return


def configure_gradio(folder: Path) -> None:
    """Set gradio's environment before its import: no network access, files in ``folder``."""
    for name in [name for name in os.environ if name.startswith("GRADIO_")]:
        del os.environ[name]  # they could share the page or start other servers
    os.environ |= {
        "GRADIO_TEMP_DIR": str(folder),
        "GRADIO_ANALYTICS_ENABLED": "False",
        "GRADIO_SHARE": "False",
        "HF_HUB_DISABLE_TELEMETRY": "1",
    }


def listener(port: int) -> socket.socket:
    """Return a socket bound to the port, or to a free one for 0.

    Raises:
        UserError: the port is taken or not allowed.
    """
    taken = socket.socket()
    taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        taken.bind((HOST, port))
        taken.listen()
    except OSError as error:
        taken.close()
        raise UserError(f"--port {port}: {error.strerror}") from error
    return taken


def serve(
    page: gr.Blocks,
    listening: socket.socket,
    max_mb: int,
    open_browser: bool,
    main_thread: MainThread,
) -> None:
    """Serve the page until Ctrl-C or SIGTERM.

    Args:
        page: of ``interface.build``.
        listening: socket of ``listener``.
        max_mb: largest upload, MB.
        open_browser: open the browser; the address is printed in any case.
        main_thread: queue of jobs that must run on the main thread.

    Raises:
        KeyboardInterrupt: Ctrl-C.
    """
    import webbrowser

    import gradio as gr
    import uvicorn
    from fastapi import FastAPI

    from .guard import Guard
    from .interface import CSS, theme

    port, token = listening.getsockname()[1], secrets.token_urlsafe(16)
    page.state_session_capacity = _PAGES
    app = gr.mount_gradio_app(
        FastAPI(openapi_url=None),
        page,
        "/",
        server_name=HOST,
        server_port=port,
        show_error=False,
        max_file_size=max_mb << 20,
        footer_links=[],
        run_history=False,
        enable_monitoring=False,
        ssr_mode=False,
        pwa=False,
        mcp_server=False,
        theme=theme(),
        css_paths=CSS,
    )
    server = uvicorn.Server(
        uvicorn.Config(
            Guard(app, token, port),
            ws="none",
            loop="asyncio",
            lifespan="on",
            log_level="error",
            access_log=False,
            proxy_headers=False,
        )
    )
    logging.getLogger("uvicorn.error").addFilter(_is_unexpected)
    thread = threading.Thread(target=server.run, args=[[listening]], daemon=True)
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    thread.start()
    try:
        while not server.started:
            if not thread.is_alive():
                raise RuntimeError("the server did not start")
            time.sleep(0.01)
        address = f"http://{HOST}:{port}/?token={token}"
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if open_browser:
            webbrowser.open(address)
        main_thread.work()
    finally:
        # Open pages are not waited for, and errors of broken connections are expected.
        logging.getLogger("uvicorn.error").disabled = True
        server.should_exit = server.force_exit = True
        thread.join(timeout=5)


def _is_unexpected(record: logging.LogRecord) -> bool:
    """Return True if a record is logged."""
    kind = (record.exc_info or (None,))[0]
    return kind is None or kind.__name__ not in _EXPECTED
