"""Self-contained HTML pages with images, a 3D viewer and numbers in one file."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from PIL import Image

from ..files import write_text
from ..gaussians import Gaussians
from ..images import to_uint8
from ..trajectories.movies import SECONDS
from ..trajectories.paths import Viewpoint
from ..viewer.page import POLICY, viewer_page


@dataclass
class Section:
    """A block of a page; every part except the title is optional, and all text is escaped.

    Attributes:
        title: heading.
        text: a sentence or two; an empty line separates paragraphs.
        image: the input, ``[H, W, 3|4]`` floats in [0, 1].
        turntable: frames ``[F, H, W, 3]`` uint8.
        gaussians: one object ``[N]``, for the 3D viewer.
        mesh: its surface, with ``vertices``, ``faces`` and ``colors``, for the viewer; or None.
        strip: one wide image ``[H, W, 3]``, floats in [0, 1].
        links: thumbnails ``[H, W, 3]`` uint8 by name, which link to NAME.html in the page's folder.
        files: names of files in the page's folder, for download.
        table: labels and texts.
        details: long texts by name, initially hidden.
        view: initial camera of the viewer; with an image, the image's.
    """

    title: str
    text: str = ""
    image: np.ndarray | None = None
    turntable: np.ndarray | None = None
    gaussians: Gaussians | None = None
    mesh: Any = None
    strip: np.ndarray | None = None
    links: Mapping[str, np.ndarray] = field(default_factory=dict)
    files: Sequence[str] = ()
    table: Sequence[tuple[str, str]] = ()
    details: Mapping[str, str] = field(default_factory=dict)
    view: Viewpoint = Viewpoint()


def write_page(path: str | Path, title: str, sections: Sequence[Section], text: str = "") -> None:
    """Write a whole page, atomically.

    Args:
        path: the ``.html``.
        title: heading of the page.
        sections: in order.
        text: below the heading; an empty line separates paragraphs.

    Raises:
        UserError: the file cannot be written.
    """
    import jinja2  # only when a page is made

    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        autoescape=True,  # all text but ``Markup``
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = templates.get_template("page.html").render(
        **{"title": title, "text": text, "sections": sections, "policy": POLICY},
        style=Markup((Path(__file__).parent / "page.css").read_text(encoding="utf-8")),
        **{"image": _image, "animation": _animation, "viewer": _viewer},
        paragraphs=lambda text: filter(None, text.split("\n\n")),
    )
    write_text(path, page)


def _image(image: np.ndarray, label: str, css: str = "", kind: str = "PNG") -> str:
    """Return an ``<img>``; WEBP takes a quarter of a PNG's size, without a visible difference."""
    content = io.BytesIO()
    options = {"optimize": True} if kind == "PNG" else {"quality": 85}
    Image.fromarray(to_uint8(image)).save(content, kind, **options)
    return _element(content, kind, label, css)


def _animation(frames: np.ndarray, label: str) -> str:
    # WebP takes a third of a GIF's size and has no palette.
    content = io.BytesIO()
    first, *later = (Image.fromarray(frame) for frame in frames)
    duration = round(1000 * SECONDS / len(frames))
    first.save(
        content, "WEBP", save_all=True, append_images=later, duration=duration, loop=0, quality=90
    )
    return _element(content, "WEBP", label)


def _element(content: io.BytesIO, kind: str, label: str, css: str = "") -> str:
    data = f"data:image/{kind.lower()};base64,{base64.b64encode(content.getvalue()).decode()}"
    shown = Markup(' class="{}"').format(css) if css else ""
    return Markup('<img{} alt="{}" src="{}">').format(shown, label, data)


def _viewer(section: Section) -> str:
    """Return a frame with the viewer."""
    camera, of_image = section.view.camera, section.image is not None
    document = viewer_page(
        section.title,
        section.gaussians,
        mesh=section.mesh,
        image=section.image,
        camera=camera if of_image else None,
        view=None if of_image else camera,
    )
    frame = '<iframe class="viewer" title="3D view" allow="fullscreen *" srcdoc="{}"></iframe>'
    return Markup(frame).format(document)
