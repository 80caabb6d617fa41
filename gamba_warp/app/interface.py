"""Layout of the page, and the handlers of its events. Imports gradio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gradio as gr
from gradio import themes

from . import work
from .actions import MAX_IMAGES, VIEWS, Actions
from .cutting import FOLDER, KEEP, REMOVE, SIDE, STROKE, examples

KEEP_SECONDS = 3600  # time that an unused page's image and results are kept
WAITING = 16  # queued requests; further ones are rejected
_TITLE = """<h1>Gamba</h1>
<p>One image becomes a 3D object. Everything is computed on this machine, and nothing is sent
out.</p>"""
_EMPTY = """<div class="stage empty"><p>The object will appear here.<br>Give an image, check its
cut-out, and make it 3D.</p></div>"""
_FILES = {"Gaussians": work.GAUSSIANS, "Mesh": work.MESHES, "To show": work.SHOWS}
_BRUSHES = {"Paint what to keep": KEEP, "Paint what to remove": REMOVE}
# Starts the download once the file exists.
_FETCH = """(files) => {
  const file = Array.isArray(files) ? files.at(-1) : files;
  if (!file || !file.url) return;
  const link = document.createElement("a");
  link.href = file.url;
  link.download = file.orig_name || "";
  link.click();
}"""

_ROTATE = f"""(degrees) => {{
  const elevation = Math.max({work.LOWEST}, Math.min({work.HIGHEST}, Number(degrees)));
  document.querySelector("iframe.stage")?.contentWindow.postMessage({{ elevation }}, "*");
  return elevation;
}}"""
# Takes what the shown viewer tells, and no other frame.
_LISTEN = """addEventListener("message", ({ data, source }) => {
  if (!data?.edit || source !== document.querySelector("iframe.stage")?.contentWindow) return;
  props.value = data.edit;
  trigger("submit");
});"""


def build(actions: Actions) -> gr.Blocks:
    """Build the page; ``server.serve`` serves it.

    One action runs at a time over all pages, because they share the device. gradio's preprocessing
    is off: it would decode images differently and without limits.
    """
    gr.set_static_paths([FOLDER])
    page = gr.Blocks(title="Gamba", analytics_enabled=False, fill_width=True)
    with page:
        gr.HTML(_TITLE, elem_id="title")
        with gr.Row(elem_id="now"):
            status = gr.HTML(elem_id="status")
            cancel = gr.Button("Cancel", size="sm", min_width=80, elem_id="cancel")
        cut, state, results = (
            gr.State(first, time_to_live=KEEP_SECONDS) for first in (None, None, [])
        )
        small_images: dict[str, Any] = {
            "height": "auto",
            "allow_preview": False,
            "object_fit": "contain",
            "buttons": [],
            "interactive": False,
            "elem_classes": "strip",
        }
        plain: dict[str, Any] = {
            "show_label": False,
            "container": False,
            "interactive": True,  # also if only its look depends on it
            "elem_classes": "choice",
        }
        with gr.Row(elem_id="bench"):
            with gr.Column(scale=5, min_width=300, elem_id="left"):
                image = gr.Image(
                    label="Image",
                    sources=["upload", "clipboard"],
                    type="filepath",
                    image_mode=None,
                    height=170,
                    buttons=[],
                    placeholder="Drop an image here\nor click to choose one",
                    elem_id="image",
                )
                with gr.Accordion("Examples, or several images", elem_id="more") as more:
                    gallery = gr.Gallery(
                        [(str(path), title) for path, title in examples()],
                        show_label=False,
                        columns=6,
                        elem_id="examples",
                        **small_images,
                    )
                    several = gr.UploadButton(
                        f"Several images at once (up to {MAX_IMAGES})",
                        file_count="multiple",
                        file_types=["image"],
                        size="sm",
                        elem_id="several",
                    )
                with gr.Column(visible=False, elem_id="cut") as cut_part:
                    brush = gr.Radio([*_BRUSHES], value=[*_BRUSHES][0], elem_id="brush", **plain)
                    note = gr.HTML(elem_id="note")
                    network = gr.Button(visible=False, size="md", elem_id="network")
                    with gr.Row():
                        mend = gr.Button("Apply strokes", size="md", min_width=120)
                        restart = gr.Button("Start over", size="md", min_width=120)
                        areas = gr.Button(
                            "Clear or fill holes", size="md", min_width=120, elem_id="areas"
                        )
                    make = gr.Button("Make it 3D", variant="primary", size="lg", elem_id="make")
            with gr.Column(scale=8, min_width=300, elem_id="right"):
                view = gr.Radio([*VIEWS], value=VIEWS[1], visible=False, elem_id="view", **plain)
                with gr.Column(elem_id="views"):
                    editor = gr.ImageEditor(
                        label="Cut-out",
                        type="numpy",
                        image_mode="RGBA",
                        format="png",
                        sources=(),
                        transforms=(),
                        layers=False,
                        brush=_brush(KEEP),
                        eraser=gr.Eraser(default_size=SIDE // 24),
                        canvas_size=(SIDE, SIDE),
                        height="var(--tall)",
                        buttons=[],
                        visible=False,
                        elem_id="editor",
                    )
                    stage = gr.HTML(_EMPTY, elem_id="stage")
                edits = gr.HTML(
                    None, html_template="", js_on_load=_LISTEN, visible="hidden", elem_id="edits"
                )
                strip = gr.Gallery(
                    label="Results",
                    visible=False,
                    columns=MAX_IMAGES,
                    elem_id="results",
                    **small_images,
                )
                buttons: dict[str, gr.Button] = {}
                with gr.Column(visible=False, elem_id="files") as files_part:
                    with gr.Row(elem_id="elevation"):
                        lower = gr.Button("−5°", size="md", min_width=56, scale=0)
                        elevation = gr.Slider(
                            work.LOWEST,
                            work.HIGHEST,
                            value=0,
                            step=1,
                            label="Elevation of the camera, degrees",
                            buttons=[],
                            min_width=200,
                        )
                        raise_ = gr.Button("+5°", size="md", min_width=56, scale=0)
                    with gr.Row(elem_id="mesh"):
                        small: dict[str, Any] = {"container": False, "min_width": 120}
                        faces = gr.Dropdown([*work.FACES], value="10,000 faces", **small)
                        texture = gr.Dropdown([*work.TEXTURES], value="Texture 1024", **small)
                        closed = gr.Checkbox(label="Closed, for printing", **small)
                    for title, kinds in _FILES.items():
                        with gr.Row(elem_classes="kinds"):
                            gr.HTML(f"<span>{title}</span>", elem_classes="kinds-title")
                            for kind, (label, _) in kinds.items():
                                buttons[kind] = gr.Button(
                                    label, size="sm", min_width=70, elem_id=f"file-{kind}"
                                )
                    made_files = gr.File(
                        label="Files",
                        file_count="multiple",
                        interactive=False,
                        visible=False,
                        elem_id="made",
                    )
        free: dict[str, Any] = {"preprocess": False, "api_visibility": "private"}
        shared: dict[str, Any] = {**free, "show_progress_on": status}
        one = {**shared, "concurrency_id": "gamba", "concurrency_limit": 1}
        shown = [cut, cut_part, editor, note, network, view, more, image]
        mask = [cut, editor, note, network]
        # (The event ``input`` sends the old image when it is cleared.)
        image.upload(actions.take, image, shown, **one)
        image.clear(actions.end_session, None, shown, **one)
        gallery.select(actions.load_example, None, shown, **one)
        # Has its own queue, so that it waits for no other event.
        brush.change(_painting, brush, editor, show_progress="hidden", **free)
        mend.click(actions.apply_strokes, mask[:2], mask, **one)
        restart.click(actions.restart, cut, mask, **one)
        seen = [state, stage, files_part, made_files, view, elevation]
        added = [results, strip, *seen]
        make.click(actions.reconstruct, [cut, editor, results], [*mask, *added], **one)
        several.upload(actions.take_all, [several, results], [more, *added], **one)
        strip.select(actions.choose, results, seen, **one)
        for kind, button in buttons.items():
            # A file that needs no rendering does not wait for the device.
            queue = {**shared, "concurrency_id": "files"} if kind in work.UNRENDERED else one
            written = button.click(
                actions.writer(kind), [state, faces, texture, closed], [made_files, stage], **queue
            )
            written.success(None, made_files, None, js=_FETCH, api_visibility="private")
        areas.click(actions.toggle_holes, cut, mask, **one)
        cancel.click(actions.cancel, None, None, show_progress="hidden", **free)
        # Like the files, so that a file that is asked for afterwards has the edit.
        edits.submit(
            actions.edit,
            [edits, results, state],
            made_files,
            trigger_mode="always_last",
            show_progress="hidden",
            concurrency_id="files",
            **free,
        )
        network.click(actions.cut_by_network, cut, mask, **one)
        page.unload(actions.cancel)
        # The viewer rotates the object at once, and then tells of it.
        quick: dict[str, Any] = {"show_progress": "hidden", "api_visibility": "private"}
        elevation.input(None, elevation, None, js=_ROTATE, **quick)
        for button, step in ((lower, -5), (raise_, 5)):
            moved = f"(degrees) => ({_ROTATE})(Number(degrees) + {step})"
            button.click(None, elevation, elevation, js=moved, **quick)
    page.queue(api_open=False, max_size=WAITING, default_concurrency_limit=1)
    return page


def _brush(color: str) -> gr.Brush:
    return gr.Brush(
        colors=[(KEEP, STROKE), (REMOVE, STROKE)],
        default_color=(color, STROKE),
        default_size=SIDE // 20,
        color_mode="fixed",
    )


def _painting(choice: str) -> Any:
    return gr.update(brush=_brush(_BRUSHES[choice]))


CSS = Path(__file__).parent / "look.css"


def theme() -> themes.Base:
    """Return colours, corners and fonts; only system fonts, so that none is fetched."""
    return themes.Base(
        primary_hue=themes.colors.blue,
        neutral_hue=themes.colors.gray,
        radius_size=themes.sizes.radius_lg,
        font=["system-ui", "sans-serif"],
        font_mono=["ui-monospace", "monospace"],
    ).set(
        body_background_fill="#fbfbfa",
        body_background_fill_dark="#111316",
        body_text_color_subdued="#5d636d",
        body_text_color_subdued_dark="#a2a8b2",
        block_background_fill="#ffffff",
        block_background_fill_dark="#1a1d21",
        block_border_width="1px",
        block_label_background_fill="transparent",
        block_label_background_fill_dark="transparent",
        button_primary_background_fill="#1a63d8",
        button_primary_background_fill_hover="#1553b8",
        button_primary_background_fill_dark="#2563eb",
        button_primary_background_fill_hover_dark="#3b76f0",
        button_primary_text_color="#ffffff",
        button_secondary_background_fill="#ecedef",
        button_secondary_background_fill_hover="#e0e2e5",
        button_secondary_background_fill_dark="#2b2f36",
        button_secondary_background_fill_hover_dark="#383d46",
        button_secondary_text_color_dark="#e8e9eb",
    )
