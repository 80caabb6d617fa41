"""What the page's events do: our functions, with gradio's updates for answers. It needs gradio."""

from __future__ import annotations

import functools
import html
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gradio as gr

from ..errors import UserError, first_line
from ..images import save_image
from ..versions import advice
from . import work
from .cutting import (
    Cut,
    cut_picture,
    editor_picture,
    examples,
    mended,
    read_strokes,
    restarted,
)
from .guard import VISITOR
from .server import MainThread
from .shelf import Shelf

if TYPE_CHECKING:
    from ..model.gamba import Gamba
    from ..photo.cutout import Ways

_FRAME = (
    '<iframe class="stage" title="3D view of {name}" sandbox="allow-scripts allow-downloads" '
    'allow="fullscreen" srcdoc="{document}"></iframe>'
)


def plainly(function: Callable) -> Callable:
    """A function whose bad input is one line in the page; what else it raises is our defect."""

    @functools.wraps(function)
    def careful(*args: Any) -> Any:
        try:
            return function(*args)
        except (UserError, MemoryError) as error:
            raise _error(error) from None
        except ModuleNotFoundError as error:
            reason = advice(error.name or "", "app")
            if reason is None:
                raise
            raise _error(UserError(reason)) from None
        except RuntimeError as error:  # torch's errors of memory have no type of their own
            if "memory" not in str(error):
                raise
            raise _error(MemoryError("there is not enough memory for this")) from None

    return careful


def _error(error: Exception) -> gr.Error:
    # The page takes the text for HTML, and names of strangers' files stand in it.
    text = html.escape(first_line(error))
    return gr.Error(text, title="This did not work", print_exception=False)


class Actions:
    """What the page's events do.

    Args:
        model: the network.
        ways: how objects may be cut out.
        shelf: for files.
        device: device that renders.
        turns: who computes.
    """

    def __init__(
        self, model: Gamba, ways: Ways, shelf: Shelf, device: str, turns: MainThread
    ) -> None:
        self._turns = turns
        self._model = model
        self._ways = ways
        self._shelf = shelf
        self._device = device
        for name in ("take", "leave", "example", "mend", "restart", "make"):
            setattr(self, name, plainly(getattr(self, name)))

    def take(
        self,
        given: dict[str, Any] | None,
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
    ) -> tuple:
        """A picture that was dropped or pasted; the guard knows that it is this visitor's."""
        if not given or not given.get("path"):
            return self.leave()
        name = given.get("orig_name") or "picture"
        progress(0.2, "Looking for the object")
        try:
            cut = self._turns.call(cut_picture, Path(given["path"]), name, self._ways)
        except UserError as error:
            gr.Warning(html.escape(str(error)), title="This is no picture for us")
            return self.leave()
        return *self._shown(cut, request), gr.skip()

    def leave(self) -> tuple:
        """The picture was taken away; what was made of it stays."""
        return None, gr.update(visible=False), None, "", None

    def example(self, event: gr.EventData, request: gr.Request) -> tuple:
        """A picture of the gallery."""
        found, index = examples(), event._data["index"]
        if type(index) is not int or not 0 <= index < len(found):
            raise UserError(f"there are {len(found)} examples, and this is none of them")
        path, title = found[index]
        cut = self._turns.call(cut_picture, path, title, self._ways)
        return *self._shown(cut, request), str(path)

    def mend(self, cut: Cut | None, painted: dict[str, Any] | None, request: gr.Request) -> tuple:
        """The strokes become part of the mask."""
        cut = mended(_given(cut), _layers(painted))
        return cut, self._editor(cut, request)

    def restart(self, cut: Cut | None, request: gr.Request) -> tuple:
        """The mask as it was found, without strokes."""
        cut = restarted(_given(cut))
        return cut, self._editor(cut, request)

    def make(
        self,
        cut: Cut | None,
        painted: dict[str, Any] | None,
        elevation: float,
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
    ) -> tuple:
        """The object in 3D, and its viewer; strokes that nobody applied count, too."""
        before = _given(cut)
        after = mended(before, _layers(painted))
        progress(0.1, "The network looks at the picture")
        made = self._turns.call(work.solve, self._model, after, elevation)
        progress(0.8, "The viewer is made")
        document = html.escape(work.viewer(made), quote=True)
        frame = _FRAME.format(name=html.escape(made.name, quote=True), document=document)
        editor = gr.skip() if after is before else self._editor(after, request)
        files = gr.update(value=None, visible=False)
        return after, editor, (made, []), frame, gr.update(visible=True), files

    def writer(self, kind: str) -> Callable:
        """The function that writes files of one kind, and adds them to those that are there."""

        def write(
            state: tuple[work.Made, list[Path]] | None,
            request: gr.Request,
            progress: gr.Progress = gr.Progress(),  # noqa: B008
        ) -> tuple:
            if state is None:
                raise UserError("make the object first; it may have been kept for too long")
            made, older = state
            progress(0.2, f"Writing {work.KINDS[kind][1]}")
            folder = self._place(request)
            path, note = self._turns.call(work.write, made, kind, folder, self._device)
            if note:
                gr.Info(html.escape(note.removeprefix(f"{path}: ")))
            files = [*(old for old in older if old.name != path.name and old.is_file()), path]
            return (made, files), gr.update(value=[str(file) for file in files], visible=True)

        return plainly(write)

    def _shown(self, cut: Cut, request: gr.Request) -> tuple:
        note = f"<p>{html.escape(cut.note)}</p>"
        return cut, gr.update(visible=True), self._editor(cut, request), note

    def _place(self, request: gr.Request) -> Path:
        asked = request.request
        assert asked is not None  # gradio has one for every event
        return self._shelf.place(asked.scope[VISITOR])

    def _editor(self, cut: Cut, request: gr.Request) -> dict[str, Any]:
        """The editor's value. gradio would write the same picture to the same file once more, in
        the middle of the browser's reading it; each of ours is a new one.
        """
        path = self._place(request) / "cut-out.png"
        save_image(path, editor_picture(cut) / 255.0)
        return {"background": str(path), "layers": [], "composite": str(path)}


def _given(cut: Cut | None) -> Cut:
    if cut is None:
        raise UserError("give a picture first; the last one may have been kept for too long")
    return cut


def _layers(painted: dict[str, Any] | None) -> list:
    """The strokes; the guard knows that the files are this visitor's."""
    return [read_strokes(Path(file["path"])) for file in (painted or {"layers": ()})["layers"]]
