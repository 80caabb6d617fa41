"""Handlers of the page's events, which return gradio's updates. Imports gradio."""

from __future__ import annotations

import contextvars
import copy
import html
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import gradio as gr
import msgspec
from msgspec import Meta

from ..batch import STAGES
from ..errors import UserError, first_line
from ..images import save_image
from ..versions import advice
from . import work
from .cutting import (
    Cut,
    apply_strokes,
    cut_by_network,
    cut_image,
    editor_image,
    examples,
    note_of,
    read_strokes,
    reset_mask,
    switch_areas,
)
from .main_thread import Cancelled, MainThread
from .store import Store

if TYPE_CHECKING:
    from ..model.gamba import Gamba
    from ..photo.cutout import CutoutOptions

_FRAME = (
    '<iframe class="stage" title="3D view of {name}" sandbox="allow-scripts allow-downloads" '
    'allow="fullscreen" srcdoc="{document}"></iframe>'
)
VIEWS = "Cut-out", "Object"  # what the stage shows
MAX_IMAGES = 12  # of one upload, and results of one page
# Fraction of the progress bar before each stage of a mesh; not measured.
_DONE = {
    "mesh views": 0.1,
    "mesh surface": 0.3,
    "mesh cleaning": 0.4,
    "mesh closing": 0.5,
    "mesh colors": 0.6,
    "mesh texture": 0.7,
    "mesh": 0.9,
}

State = tuple[work.EditableObject, list[Path]]  # the shown result, and its files


class Edit(msgspec.Struct):
    """Message of the viewer about its object; ``removed`` has a bit for each Gaussian."""

    key: str
    elevation: Annotated[float, Meta(ge=work.LOWEST, le=work.HIGHEST)]
    removed: bytes  # base64 in the message


class Result(NamedTuple):
    """A result of the strip, and the file of its small image."""

    edited: work.EditableObject
    image: Path


@contextmanager
def page_errors() -> Iterator[None]:
    """Turn bad input into one line in the page; any other error is a bug."""
    try:
        yield
    except (UserError, MemoryError) as error:
        raise _error(error) from None
    except ModuleNotFoundError as error:
        reason = advice(error.name or "", "app", "app")
        if reason is None:
            raise
        raise _error(UserError(reason)) from None
    except RuntimeError as error:  # torch raises it when out of memory
        if "memory" not in str(error):
            raise
        raise _error(MemoryError("there is not enough memory for this")) from None


def _error(error: Exception) -> gr.Error:
    # The page interprets the text as HTML, and it may have untrusted file names.
    text = html.escape(first_line(error))
    return gr.Error(text, title="This did not work", print_exception=False)


class Actions:
    """Handlers of the page's events.

    Args:
        model: the network.
        options: options of the cut-out.
        store: files of the page.
        device: device that renders.
        main_thread: runs all computations.
    """

    def __init__(
        self,
        model: Gamba,
        options: CutoutOptions,
        store: Store,
        device: str,
        main_thread: MainThread,
    ) -> None:
        self._main_thread = main_thread
        self._model = model
        self._options = options
        self._store = store
        self._device = device
        self._cancels: Counter[str] = Counter()  # by page

    @page_errors()
    def take(
        self,
        given: dict[str, Any] | None,
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
    ) -> tuple:
        """Take a dropped or pasted image."""
        if not given or not given.get("path"):
            return self.end_session()
        name = given.get("orig_name") or "image"
        progress(0.2, "Looking for the object")
        try:
            cut = self._call(request, cut_image, Path(given["path"]), name, self._options)
        except UserError as error:
            gr.Warning(html.escape(str(error)), title="This image cannot be used")
            return self.end_session()
        return *self._shown(cut, request), gr.skip()

    @page_errors()
    def cancel(self, request: gr.Request) -> None:
        """Interrupt the running action of a page, also when it is closed."""
        self._cancels[request.session_hash or ""] += 1

    @page_errors()
    def end_session(self) -> tuple:
        """Clear the image; its results stay."""
        gone, empty = gr.update(visible=False), gr.update(value=None, visible=False)
        view = gr.update(value=VIEWS[1], visible=False)
        return None, gone, empty, "", gone, view, gr.skip(), None

    @page_errors()
    def load_example(self, event: gr.EventData, request: gr.Request) -> tuple:
        """Take an example of the gallery."""
        shipped, index = examples(), event._data["index"]
        if type(index) is not int or not 0 <= index < len(shipped):
            raise UserError(f"not one of the {len(shipped)} examples")
        path, title = shipped[index]
        cut = self._call(request, cut_image, path, title, self._options)
        return *self._shown(cut, request), str(path)

    @page_errors()
    def apply_strokes(
        self, cut: Cut | None, painted: dict[str, Any] | None, request: gr.Request
    ) -> tuple:
        """Apply the strokes to the mask."""
        cut = apply_strokes(_given(cut), _layers(painted))
        return self._edited(cut, request)

    @page_errors()
    def restart(self, cut: Cut | None, request: gr.Request) -> tuple:
        """Reset the mask, without strokes."""
        cut = reset_mask(_given(cut))
        return self._edited(cut, request)

    @page_errors()
    def toggle_holes(self, cut: Cut | None, request: gr.Request) -> tuple:
        """Clear the enclosed areas of a plain background's colour, or fill them."""
        cut = _given(cut)
        if not cut.areas.any():
            raise UserError("the object encloses no area of a plain background's colour")
        cut = switch_areas(cut)
        return self._edited(cut, request)

    @page_errors()
    def cut_by_network(
        self,
        cut: Cut | None,
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
    ) -> tuple:
        """Cut the image out again by a network."""
        progress(0.2, "Cutting out with a network")
        again = self._call(request, cut_by_network, _given(cut), self._options)
        return self._edited(again, request)

    @page_errors()
    def reconstruct(
        self,
        cut: Cut | None,
        painted: dict[str, Any] | None,
        results: list[Result],
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
    ) -> tuple:
        """Reconstruct the object and show its viewer; pending strokes are applied first.

        An elevation that was set by hand for this image stays.
        """
        before = _given(cut)
        after = apply_strokes(before, _layers(painted))
        progress(0.1, "Running the network")
        earlier = [each.edited.chosen for each in results if each.edited.image_key == after.key]
        chosen = earlier[-1] if earlier else None
        reconstruction = self._call(request, work.run_model, self._model, after, chosen)
        progress(0.8, "Making the viewer")
        edited = (gr.skip(),) * 4 if after is before else self._edited(after, request)
        return *edited, *self._added(results, reconstruction, request)

    def take_all(
        self,
        given: list[dict[str, Any]] | None,
        results: list[Result],
        request: gr.Request,
        progress: gr.Progress = gr.Progress(),  # noqa: B008
    ) -> Iterator[tuple]:
        """Reconstruct several images, each with the cut-out that is found; yield each result."""
        given, before, doubted = given or [], results, []
        with page_errors():
            if len(given) > MAX_IMAGES:
                raise UserError(f"{len(given)} images; at most {MAX_IMAGES} at once")
            for number, file in enumerate(given):
                name = file.get("orig_name") or "image"
                progress(number / len(given), f"Image {number + 1} of {len(given)}")
                try:
                    cut = self._call(request, cut_image, Path(file["path"]), name, self._options)
                    reconstruction = self._call(request, work.run_model, self._model, cut)
                except Cancelled:
                    raise
                except UserError as error:
                    text = f"{name}: {str(error).removeprefix(f'{name}: ')}"
                    gr.Warning(html.escape(text), title="This image cannot be used")
                    continue
                if cut.warning:
                    doubted.append(name)
                results, *shown = self._added(results, reconstruction, request)
                yield gr.update(open=False), results, *shown
            if doubted:
                text = f"{', '.join(doubted)}. Give such an image alone to correct it."
                gr.Warning(html.escape(text), title="These cut-outs may be wrong")
            if results is before:
                raise UserError("none of these images can be used")

    @page_errors()
    def choose(self, results: list[Result], event: gr.EventData) -> tuple:
        """Show an earlier result again."""
        index = event._data["index"]
        if type(index) is not int or not 0 <= index < len(results):
            raise UserError("this result has expired")
        _forget_surfaces(results)
        return _presented(results[index].edited)

    @page_errors()
    def edit(self, message: dict[str, Any], results: list[Result], state: State | None) -> Any:
        """Edit one of the results; files of the shown one that were written before are dropped."""
        try:
            edit = msgspec.convert(message, Edit)
        except msgspec.ValidationError as error:
            raise UserError(f"the edit: {error}") from None
        reconstruction = next(
            (each.edited for each in results if each.edited.key == edit.key), None
        )
        if reconstruction is None:
            raise UserError("this result has expired")
        work.edit(reconstruction, edit.elevation, edit.removed)
        if state is None or state[0] is not reconstruction:
            return gr.skip()
        state[1].clear()
        return gr.update(value=None, visible=False)

    def writer(self, kind: str) -> Callable:
        """Return the handler that writes files of one kind, and adds them to the list."""

        def write(
            state: State | None,
            faces: str,
            texture: str,
            watertight: bool,
            request: gr.Request,
            progress: gr.Progress = gr.Progress(),  # noqa: B008
        ) -> tuple:
            reconstruction, files = _state(state)
            one = copy.copy(reconstruction)  # the object may be edited meanwhile
            progress(0.1, f"Writing {work.KINDS[kind][1]}")
            mesh = work.MeshChoice.of(faces, texture, watertight)
            inputs = one, kind, self._store.new_folder(), self._device, mesh
            if kind in work.UNRENDERED:
                path, note = work.write(*inputs)
            else:
                path, note = self._call(request, work.write, *inputs, progress=progress)
            if note:
                gr.Info(html.escape(note.removeprefix(f"{path}: ")))
            # In place: meanwhile the page may show another object, which stays.
            files[:] = [*(old for old in files if old.name != path.name and old.is_file()), path]
            listed = gr.update(value=[str(file) for file in files], visible=True)
            if reconstruction.removed is not one.removed or reconstruction.surface is one.surface:
                return listed, gr.skip()
            reconstruction.surface, reconstruction.choice = one.surface, one.choice
            return listed, _frame(reconstruction)

        return page_errors()(write)

    def _added(
        self, results: list[Result], reconstruction: work.EditableObject, request: gr.Request
    ) -> tuple:
        """Append a result, and show it."""
        path = self._store.new_folder() / "result.png"
        self._call(request, work.thumbnail, reconstruction, path, self._device)
        _forget_surfaces(results)
        latest = [*results, Result(reconstruction, path)][-MAX_IMAGES:]
        if len(latest) == len(results):
            gr.Info(f"The strip keeps the last {MAX_IMAGES} results.")
        strip = [(str(result.image), result.edited.name) for result in latest]
        shown = gr.update(value=strip, visible=len(latest) > 1, selected_index=None)
        return latest, shown, *_presented(reconstruction)

    def _call(
        self,
        request: gr.Request,
        function: Callable,
        *args: Any,
        progress: Callable[[float, str], Any] | None = None,
    ) -> Any:
        """Call a function on the main thread, until its page cancels it or is closed.

        The stages of a mesh are shown as progress.
        """
        page = request.session_hash or ""
        cancels = self._cancels[page]
        context = contextvars.copy_context()  # gradio finds the event by it

        def show(name: str) -> None:
            if progress is not None:
                context.run(progress, _DONE.get(name, 0.1), name)

        def job() -> Any:
            STAGES.show = show
            try:
                return function(*args)
            finally:
                STAGES.show = None

        return self._main_thread.call(job, wanted=lambda: self._cancels[page] == cancels)

    def _shown(self, cut: Cut, request: gr.Request) -> tuple:
        cut, *edited = self._edited(cut, request)
        view = gr.update(value=VIEWS[0], visible=True)
        return cut, gr.update(visible=True), *edited, view, gr.update(open=False)

    def _edited(self, cut: Cut, request: gr.Request) -> tuple:
        note = html.escape(self._call(request, note_of, cut))
        network = gr.update(value=cut.network, visible=bool(cut.network))
        return cut, self._editor(cut), f"<p>{note}</p>", network

    def _editor(self, cut: Cut) -> dict[str, Any]:
        """Return the editor's value, each time in a new file.

        gradio would rewrite the same file while the browser reads it.
        """
        path = self._store.new_folder() / "cut-out.png"
        save_image(path, editor_image(cut) / 255.0)
        value = {"background": str(path), "layers": [], "composite": str(path)}
        return gr.update(value=value, visible=True)


def _forget_surfaces(results: list[Result]) -> None:
    """Free the surfaces of results that are not shown; one with a texture takes up to 60 MB."""
    for result in results:
        result.edited.surface = None


def _presented(reconstruction: work.EditableObject) -> tuple:
    """Return state, viewer, the buttons of files, no files, the view, and the elevation."""
    files, on = gr.update(value=None, visible=False), gr.update(visible=True)
    info = f"Estimate: {reconstruction.estimate}. Change it if the object leans."
    elevation = gr.update(value=reconstruction.view.elevation, info=info)
    return (reconstruction, []), _frame(reconstruction), on, files, VIEWS[1], elevation


def _frame(reconstruction: work.EditableObject) -> str:
    document = html.escape(work.viewer(reconstruction), quote=True)
    return _FRAME.format(name=html.escape(reconstruction.name, quote=True), document=document)


def _state(state: State | None) -> State:
    if state is None:
        raise UserError("make the object first; an older one may have expired")
    return state


def _given(cut: Cut | None) -> Cut:
    if cut is None:
        raise UserError("give an image first; an older one may have expired")
    return cut


def _layers(painted: dict[str, Any] | None) -> list:
    """Read the strokes."""
    return [read_strokes(Path(file["path"])) for file in (painted or {"layers": ()})["layers"]]
