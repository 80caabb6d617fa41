"""Self-contained HTML pages: pictures, a 3D viewer and numbers in one file that loads nothing."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from PIL import Image

from ..conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from ..files import write_text
from ..gaussians import Gaussians
from ..images import to_uint8
from ..viewer.page import POLICY, frame_element, frames_script
from .turntable import SECONDS

_VIEWER_CAPTION = (
    '<span class="when-idle">Press 3D to turn it by hand</span>'
    '<span class="when-running">Drag to turn, wheel or pinch to zoom, H for help</span>'
)


@dataclass
class Section:
    """One block of a page; every part but the title may be left out.

    Attributes:
        title: heading.
        text: a sentence or two.
        picture: the input, ``[H, W, 3|4]`` floats in [0, 1].
        turntable: frames ``[F, H, W, 3]`` uint8.
        gaussians: one object ``[N]``, for the 3D viewer.
        mesh: its surface, with ``vertices``, ``faces`` and ``colors``, for the viewer; or None.
        views: pictures ``[V, H, W, 3]``, floats in [0, 1], by label; each label is a row of views,
            such as "Predicted" above "Truth".
        table: rows of cells; text is set to the left, numbers to the right.
        header: names of the table's columns.
        curves: ``(x, y)`` points by label, drawn as one chart.
        curves_label: label of the chart's vertical axis.
        files: names of files beside the page, which it offers for download.
        fragment: HTML that is set as it is, such as that of ``curves.draw_curves``.
        distance: distance of the viewer's camera from the origin, object units.
        fov: field of view of the viewer's camera, degrees.
        elevation: of the viewer's camera at the start, degrees.
    """

    title: str
    text: str = ""
    picture: np.ndarray | None = None
    turntable: np.ndarray | None = None
    gaussians: Gaussians | None = None
    mesh: Any = None
    views: Mapping[str, np.ndarray] = field(default_factory=dict)
    table: Sequence[Sequence[str | int | float]] = ()
    header: Sequence[str] = ()
    curves: Mapping[str, Sequence[tuple[float, float]]] = field(default_factory=dict)
    curves_label: str = ""
    files: Sequence[str] = ()
    fragment: str = ""
    distance: float = DEFAULT_DISTANCE
    fov: float = DEFAULT_FOV
    elevation: float = 0.0


def reconstruction_page(path: str | Path, section: Section) -> None:
    """Writes the page of one reconstruction atomically; its viewer is large, and starts by itself.

    Raises:
        UserError: the file cannot be written.
    """
    _write(path, section.title, "", [section], auto=True)


def demo_page(
    path: str | Path, sections: Sequence[Section], *, title: str = "Gamba demo", text: str = ""
) -> None:
    """Writes a page of many sections atomically; its viewers start when asked to.

    Raises:
        UserError: the file cannot be written.
    """
    _write(path, title, text, sections, auto=False)


def index_page(path: str | Path, title: str, results: Mapping[str, np.ndarray]) -> None:
    """Writes, atomically, a page that leads to the pages of many reconstructions beside it.

    Args:
        path: the file.
        title: heading of the page.
        results: by name a small picture ``[H, W, 3]`` uint8; NAME.html is the page.

    Raises:
        UserError: the file cannot be written.
    """
    links = (
        f'<a href="{quote(name)}.html">{_figure(_animation(small[None]), html.escape(name))}</a>'
        for name, small in results.items()
    )
    fragment = f'<div class="index">{"".join(links)}</div>'
    text = "Of each, what was given and what was made of it."
    _write(path, title, text, [Section(title, fragment=fragment)], auto=True)


def _write(
    path: str | Path, title: str, text: str, sections: Sequence[Section], auto: bool
) -> None:
    here = Path(__file__).parent
    body = "\n".join(_section(s, f"viewer{i}", auto) for i, s in enumerate(sections))
    script = frames_script() if any(s.gaussians is not None for s in sections) else ""
    document = f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>
{(here / "page.css").read_text(encoding="utf-8")}</style>
</head>
<body>
<header><h1>{html.escape(title)}</h1>{_paragraph(text)}</header>
{body}
{script}</body>
</html>
"""
    write_text(path, document)


def _section(section: Section, name: str, auto: bool) -> str:
    figures = []
    if section.gaussians is not None and auto:
        viewer = _viewer(section, section.gaussians, name, auto, "")
        figures.append(_figure(viewer, _VIEWER_CAPTION, "wide"))
    if section.picture is not None:
        figures.append(_figure(_image(section.picture, "frame", "input"), "Input"))
    turning = "" if section.turntable is None else _animation(section.turntable)
    if turning and (auto or section.gaussians is None):
        figures.append(_figure(f'<div class="frame">{turning}</div>', "Turntable"))
        turning = ""
    if (
        section.gaussians is not None and not auto
    ):  # a viewer that waits to be started shows the turntable
        figures.append(
            _figure(_viewer(section, section.gaussians, name, auto, turning), _VIEWER_CAPTION)
        )
    parts = [f"<h2>{html.escape(section.title)}</h2>" if not auto else ""]
    parts += [
        _paragraph(section.text),
        f'<div class="media">{"".join(figures)}</div>' if figures else "",
        _views(section.views) if section.views else "",
        _downloads(section.files) if section.files else "",
        _table(section.header, section.table) if section.table else "",
        svg_chart(section.curves, section.curves_label) if section.curves else "",
        section.fragment,
    ]
    return "<section>" + "\n".join(filter(None, parts)) + "</section>"


def _paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>" if text else ""


def _figure(content: str, caption: str, css: str = "") -> str:
    kind = f' class="{css}"' if css else ""
    return f"<figure{kind}>{content}<figcaption>{caption}</figcaption></figure>"


def _downloads(names: Sequence[str]) -> str:
    links = (f'<a href="{quote(name)}" download>{html.escape(name)}</a>' for name in names)
    return f'<p class="files">Files beside this page: {" ".join(links)}</p>'


def data_uri(content: bytes, kind: str) -> str:
    """The content as an address that a page can hold, of a type such as ``image/png``."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _image(picture: np.ndarray, css: str, label: str) -> str:
    content = io.BytesIO()
    Image.fromarray(to_uint8(picture)).save(content, "PNG", optimize=True)
    source = data_uri(content.getvalue(), "image/png")
    return f'<img class="{css}" alt="{html.escape(label)}" src="{source}">'


def _animation(frames: np.ndarray) -> str:
    # WebP takes a third of a GIF's size and has no palette.
    content = io.BytesIO()
    first, *rest = (Image.fromarray(frame) for frame in frames)
    duration = round(1000 * SECONDS / len(frames))
    first.save(
        content, "WEBP", save_all=True, append_images=rest, duration=duration, loop=0, quality=90
    )
    label = "turntable" if len(frames) > 1 else "input and result"
    return f'<img alt="{label}" src="{data_uri(content.getvalue(), "image/webp")}">'


def _viewer(section: Section, gaussians: Gaussians, name: str, auto: bool, poster: str) -> str:
    place = (section.distance, section.fov, section.elevation)
    which = "view" if section.picture is None else "camera"  # a picture is what a camera saw
    return frame_element(
        name,
        section.title,
        gaussians,
        mesh=section.mesh,
        poster=poster,
        auto=auto,
        **{which: place},
    )


def _views(rows: Mapping[str, np.ndarray]) -> str:
    columns = max(len(views) for views in rows.values())
    cells = []
    for label, views in rows.items():
        cells.append(f"<span>{html.escape(label)}</span>")
        cells += [_image(view, "", f"{label}, view {i + 1}") for i, view in enumerate(views)]
        cells += ["<i></i>"] * (columns - len(views))
    style = f"grid-template-columns: auto repeat({columns}, minmax(5rem, 10rem))"
    return f'<div class="scroll"><div class="views" style="{style}">{"".join(cells)}</div></div>'


def _table(header: Sequence[str], rows: Sequence[Sequence[str | int | float]]) -> str:
    def cell(value: str | int | float) -> str:
        if isinstance(value, str):
            return f"<td>{html.escape(value)}</td>"
        text = f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
        return f'<td class="number">{text}</td>'

    last = [*rows[-1], *[""] * len(header)]
    head = "".join(
        f"<th{'' if isinstance(last[i], str) else ' class=number'}>{html.escape(name)}</th>"
        for i, name in enumerate(header)
    )
    lines = [f"<tr>{head}</tr>"] if head else []
    lines += [f"<tr>{''.join(map(cell, row))}</tr>" for row in rows]
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def svg_chart(curves: Mapping[str, Sequence[tuple[float, float]]], label: str = "") -> str:
    """Draws a line chart as inline SVG; the vertical axis is logarithmic if values span over 20x.

    Args:
        curves: ``(x, y)`` points by name; points that are not finite are left out.
        label: label of the vertical axis.

    Returns:
        The ``<svg>`` element, or an empty text if there is no finite point.
    """
    series = {
        name: [(x, y) for x, y in points if math.isfinite(x) and math.isfinite(y)]
        for name, points in curves.items()
    }
    xs = [x for points in series.values() for x, _ in points]
    ys = [y for points in series.values() for _, y in points]
    if not xs:
        return ""
    logarithmic = min(ys) > 0 and max(ys) > 20 * min(ys)
    bend = math.log10 if logarithmic else float
    low, high = bend(min(ys)), bend(max(ys))
    left, right, top, bottom = 56, 624, 34, 214

    def to_x(x: float) -> float:
        return left + (right - left) * (x - min(xs)) / ((max(xs) - min(xs)) or 1)

    def to_y(value: float) -> float:
        return bottom - (bottom - top) * (value - low) / ((high - low) or 1)

    parts = []
    for value in ticks(min(ys), max(ys), logarithmic):
        y = to_y(bend(value))
        parts.append(f'<line class="grid" x1="{left}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    for value in ticks(min(xs), max(xs), False):
        at = f'x="{to_x(value):.1f}" y="{bottom + 20}"'
        parts.append(f'<text {at} text-anchor="middle">{value:,.6g}</text>')
    note = f"{label} (logarithmic)" if logarithmic else label
    parts.append(f'<text x="{left}" y="16">{html.escape(note)}</text>')
    for i, (name, points) in enumerate(series.items()):
        colour = f"var(--s{i % 4})"
        path = " ".join(f"{to_x(x):.1f},{to_y(bend(y)):.1f}" for x, y in points)
        parts.append(f'<polyline class="line" style="stroke: {colour}" points="{path}"/>')
        at = right - 110 * (len(series) - 1 - i)
        style = f'text-anchor="end" style="fill: {colour}"'
        parts.append(f'<text x="{at}" y="16" {style}>{html.escape(name)}</text>')
    return f'<svg viewBox="0 0 640 240" role="img">{"".join(parts)}</svg>'


def ticks(low: float, high: float, logarithmic: bool) -> list[float]:
    """Returns round values within the bounds, multiples of 1, 2 or 5 times a power of ten.

    Args:
        low: lower bound; above 0 if ``logarithmic``.
        high: upper bound.
        logarithmic: whether the axis is.
    """
    if high <= low:
        return [low]
    if logarithmic:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        leads = (1, 2, 5) if high < 1000 * low else (1,)
        values = [float(f"{lead}e{power}") for power in powers for lead in leads]
    else:
        raw = (high - low) / 5
        unit = 10.0 ** math.floor(math.log10(raw))
        step = next(unit * lead for lead in (1, 2, 5, 10) if unit * lead >= raw)
        values = [step * i for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return [value for value in values if low <= value <= high]
