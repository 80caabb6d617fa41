"""Self-contained HTML pages with images, a 3D viewer and numbers in one file."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from PIL import Image

from ..files import write_text
from ..gaussians import Gaussians
from ..images import to_uint8
from ..trajectories.movies import SECONDS
from ..trajectories.paths import Viewpoint
from ..viewer.page import POLICY, frame_element, frames_script
from .templates import render

_NUMBER = re.compile(r"[-+]?[0-9][0-9.,e+-]*( %| to [0-9.,e+-]+)?")
_ABSENT = ("", "-", "absent")
_WITH_INTERVAL = re.compile(r"([-+]?[0-9][0-9.,e+-]*) (\[.*\])")


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
        table: rows of cells; text is left-aligned, numbers right-aligned. Below a header, texts of
            numbers count as numbers, ``1.0 [0.5, 1.5]`` as one with its interval.
        header: names of the table's columns.
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
    table: Sequence[Sequence[str | int | float]] = ()
    header: Sequence[str] = ()
    details: Mapping[str, str] = field(default_factory=dict)
    view: Viewpoint = Viewpoint()


def page_text(title: str, text: str, sections: Sequence[Section], auto: bool = False) -> str:
    """Return a whole page.

    Args:
        title: heading of the page.
        text: below it; an empty line separates paragraphs.
        sections: in order.
        auto: viewers are large and start by themselves, and sections have no headings.
    """
    viewers = any(section.gaussians is not None for section in sections)
    return render(
        "page.html",
        **{"title": title, "text": text, "sections": sections, "auto": auto, "policy": POLICY},
        style=Markup((Path(__file__).parent / "page.css").read_text(encoding="utf-8")),
        script=Markup(frames_script() if viewers else ""),
        **{"image": _image, "animation": _animation, "viewer": _viewer, "cells": _cells},
        paragraphs=lambda text: filter(None, text.split("\n\n")),
    )


def write_page(
    path: str | Path, title: str, sections: Sequence[Section], text: str = "", auto: bool = False
) -> None:
    """Write ``page_text`` to a file, atomically; arguments as there.

    Raises:
        UserError: the file cannot be written.
    """
    write_text(path, page_text(title, text, sections, auto))


def _image(image: np.ndarray, label: str, css: str = "", kind: str = "PNG") -> str:
    """Return an ``<img>``; WEBP takes a quarter of a PNG's size, without a visible difference."""
    content = io.BytesIO()
    options = {"optimize": True} if kind == "PNG" else {"quality": 85}
    Image.fromarray(to_uint8(image)).save(content, kind, **options)
    return _element(content, kind, label, css)


def _animation(frames: np.ndarray, label: str) -> str:
    # WebP takes a third of a GIF's size and has no palette.
    content = io.BytesIO()
    first, *rest = (Image.fromarray(frame) for frame in frames)
    duration = round(1000 * SECONDS / len(frames))
    first.save(
        content, "WEBP", save_all=True, append_images=rest, duration=duration, loop=0, quality=90
    )
    return _element(content, "WEBP", label)


def _element(content: io.BytesIO, kind: str, label: str, css: str = "") -> str:
    data = f"data:image/{kind.lower()};base64,{base64.b64encode(content.getvalue()).decode()}"
    shown = Markup(' class="{}"').format(css) if css else ""
    return Markup('<img{} alt="{}" src="{}">').format(shown, label, data)


def _viewer(section: Section, number: int, poster: str, auto: bool) -> str:
    assert section.gaussians is not None
    which = "view" if section.image is None else "camera"  # the camera of the image
    element = frame_element(
        f"viewer{number}",
        section.title,
        section.gaussians,
        mesh=section.mesh,
        image=section.image,
        poster=poster,
        auto=auto,
        **{which: section.view.camera},
    )
    return Markup(element)


class _Cell(NamedTuple):
    text: str
    kind: str = ""
    interval: str = ""


def _cells(section: Section) -> list[list[_Cell]]:
    """Return the cells of the header and the table (``Section.table``)."""

    def cell(value: str | int | float) -> _Cell:
        if not isinstance(value, str):
            return _Cell(f"{value:,}" if isinstance(value, int) else f"{value:.4g}", "number")
        if section.header and _NUMBER.fullmatch(value):
            return _Cell(value, "number")
        if section.header and (found := _WITH_INTERVAL.fullmatch(value)):
            return _Cell(found[1], "", found[2])
        return _Cell(value)

    columns = [[cell(value) for value in column] for column in zip(*section.table)]
    for column in columns:  # missing values are aligned like numbers
        if section.header and any(cell.kind == "number" for cell in column):
            column[:] = [c._replace(kind="number") if c.text in _ABSENT else c for c in column]
    heads = [[cell.kind for cell in column].count("number") * 2 > len(column) for column in columns]
    head = [_Cell(text, "number" * right) for text, right in zip(section.header, heads)]
    return [head, *map(list, zip(*columns))]
