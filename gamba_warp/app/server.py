"""``gamba app``: serves the page on 127.0.0.1 until Ctrl-C, and leaves nothing behind."""

from __future__ import annotations

import logging
import os
import queue
import shutil
import signal
import socket
import stat
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro
from msgspec import Meta

from ..conventions import DeviceChoice
from ..errors import UserError
from ..files import only_process
from ..untrusted.ranges import ranged
from .shelf import MAX_OWN, Shelf

if TYPE_CHECKING:
    import gradio as gr

HOST = "127.0.0.1"
PREFIX = "gamba-app-"
_PAGES = 8  # whose pictures and results are kept at once
BACKLOG = 64  # connections that are taken in one go; each takes a descriptor
Result = TypeVar("Result")


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
    """Serves a page that makes 3D objects of pictures, for this machine alone, until Ctrl-C.

    Args:
        checkpoint: Trained model (.safetensors); the shipped model if not given.
        encoder_weights: The image encoder's weights, where the model has a pretrained one.
        matte_model: ONNX file of an ISNet or U2-Net that cuts objects out, or the address of a copy
            of one of rembg's; if not given, one that rembg keeps on this machine, or it is fetched
            once (179 MB).
        port: Port of 127.0.0.1; 0 picks a free one.
        open_browser: Open the browser; the address is printed in any case.
        max_upload_mb: Largest picture file, MB.
        device: Device that computes; auto is the GPU if there is one.
    """
    from ..devices import pick_device
    from ..model.checkpoint import load_model
    from ..photo.cutout import Ways

    chosen, listening = pick_device(device), listener(port)
    ways = Ways(matte_model=matte_model, device=chosen).checked()
    model = load_model(checkpoint, chosen, encoder_weights)
    with listening, work_folder() as folder:
        quiet(folder)
        from .actions import Actions
        from .interface import build

        turns, shelf = MainThread(), Shelf(folder, own=max(MAX_OWN, max_upload_mb << 20))
        page = build(Actions(model, ways, shelf, str(chosen), turns))
        serve(page, shelf, listening, max_upload_mb, open_browser, turns)


class MainThread:
    """Jobs of other threads, done in turn by the one that calls ``work``.

    gradio calls from threads that come and go. Open3D ends the whole process at its exit if it was
    used on a thread that had ended before, and OpenMP makes a new team of threads for every thread
    that computes. So the main thread, which has nothing else to do, computes.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[tuple[Future, Callable, tuple]] = queue.SimpleQueue()
        self._over = False

    def call(self, function: Callable[..., Result], *args: Any) -> Result:
        """Has the main thread call the function, and waits; what it raises is raised here.

        Raises:
            UserError: the main thread has ended.
        """
        future: Future[Result] = Future()
        self._jobs.put((future, function, args))
        if self._over:
            future.cancel()
        try:
            return future.result()
        except CancelledError:
            raise UserError("gamba app was ended; start it again") from None

    def work(self) -> None:
        """Does jobs until something that is no error of a job, such as Ctrl-C, ends it."""
        try:
            while True:
                future, function, args = self._jobs.get()
                try:
                    result = function(*args)
                except Exception as error:
                    future.set_exception(error)
                except BaseException:
                    future.cancel()
                    raise
                else:
                    future.set_result(result)
        finally:  # who waits for a job must not wait for ever
            self._over = True
            while not self._jobs.empty():
                self._jobs.get()[0].cancel()


@contextmanager
def work_folder() -> Iterator[Path]:
    """A temporary folder for all that the page makes; it goes in the end.

    Those of processes that were killed go at the start: nobody holds their locks.
    """
    place = Path(tempfile.gettempdir())
    for old in place.glob(f"{PREFIX}*"):
        _remove_unheld(old)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX)).resolve()
    try:
        with only_process(folder, "serves"):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_unheld(folder: Path) -> None:
    """Removes a folder that an ended ``gamba app`` of this user left; touches no other."""
    try:
        made = folder.lstat()
    except OSError:  # it is gone
        return
    # Anybody may put a folder of this name there, and links into it.
    ours = os.name != "posix" or (made.st_uid == os.geteuid() and not made.st_mode & 0o077)
    if not (stat.S_ISDIR(made.st_mode) and ours):
        return
    if not (folder / ".lock").is_file():  # another process makes it just now
        return
    try:
        with only_process(folder, "serves"):
            shutil.rmtree(folder, ignore_errors=True)
    except UserError:  # it is in use
        return


def quiet(folder: Path) -> None:
    """Tells gradio, before it is imported, to ask no other machine and where to put its files."""
    for name in [name for name in os.environ if name.startswith("GRADIO_")]:
        del os.environ[name]  # one would share the page, another start servers of its own
    os.environ |= {
        "GRADIO_TEMP_DIR": str(folder),
        "GRADIO_ANALYTICS_ENABLED": "False",
        "GRADIO_SHARE": "False",
        "HF_HUB_DISABLE_TELEMETRY": "1",
    }


def listener(port: int) -> socket.socket:
    """A socket that has the port, or a free one for 0; nothing is answered before it is served.

    Raises:
        UserError: it is taken or not allowed.
    """
    taken = socket.socket()
    if os.name == "posix":  # elsewhere it would let two servers have one port
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        taken.bind((HOST, port))
        taken.listen(BACKLOG)
    except OSError as error:
        taken.close()
        raise UserError(f"--port {port}: {error.strerror}") from error
    return taken


def serve(
    page: gr.Blocks,
    shelf: Shelf,
    listening: socket.socket,
    max_mb: int,
    open_browser: bool,
    turns: MainThread,
) -> None:
    """Serves the page until Ctrl-C or SIGTERM.

    Args:
        page: of ``interface.build``.
        shelf: for the visitors' files.
        listening: socket of ``listener``.
        max_mb: largest upload, MB.
        open_browser: whether the browser is opened; where there is none, the address is printed.
        turns: what this thread does meanwhile.

    Raises:
        KeyboardInterrupt: Ctrl-C.
    """
    import webbrowser

    import gradio as gr
    import uvicorn
    from fastapi import FastAPI

    from .connections import Connection
    from .guard import Guard
    from .interface import LOOK, inputs, theme

    port = listening.getsockname()[1]
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
        css_paths=LOOK,
    )
    server = uvicorn.Server(
        uvicorn.Config(
            Guard(app, shelf, inputs(page), max_mb << 20),
            http=Connection,
            ws="none",
            loop="asyncio",
            lifespan="on",
            backlog=BACKLOG,
            log_level="error",
            access_log=False,
            proxy_headers=False,
        )
    )
    new_defect = NewDefect()
    logging.getLogger("uvicorn.error").addFilter(new_defect)
    logging.getLogger("asyncio").addFilter(new_defect)
    logging.getLogger("python_multipart").setLevel(logging.ERROR)  # it warns of damaged uploads
    thread = threading.Thread(target=server.run, args=[[listening]], daemon=True)
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    thread.start()
    try:
        while not server.started:
            if not thread.is_alive():
                raise RuntimeError("the server did not start")
            time.sleep(0.01)
        address = f"http://{HOST}:{port}/"
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if open_browser:
            webbrowser.open(address)
        turns.work()
    finally:
        # It waits for no page that is open, and what breaks off now is no defect.
        logging.getLogger("uvicorn.error").disabled = True
        server.should_exit = server.force_exit = True
        thread.join(timeout=5)


class NewDefect(logging.Filter):
    """Lets an error be logged that may be our defect, once for each place that it comes from.

    A browser that leaves in the middle is none, and nobody can flood the terminal.
    """

    def __init__(self) -> None:
        super().__init__()
        self._seen: set[tuple[str, str, int]] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is logged."""
        kind, _, place = record.exc_info or (None, None, None)
        if kind is None:
            return True
        while place and place.tb_next:
            place = place.tb_next
        file, line = (place.tb_frame.f_code.co_filename, place.tb_lineno) if place else ("", 0)
        defect = kind.__name__, file, line
        new = defect not in self._seen
        self._seen.add(defect)
        return new and kind.__name__ not in ("ClientDisconnect", "LocalProtocolError")
