"""The viewer's page: one HTML document that fills the window and loads nothing."""

from __future__ import annotations

import base64
import html
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from ..files import write_text
from ..gaussians import Gaussians
from .pack import Frame, own_frame, pack_gaussians, pack_mesh, visible

# As they need each other.
_SCRIPTS = ("shaders", "gl", "sorter", "camera", "controls", "ui", "main")
# The page may load only what is inlined in it. The worker that sorts is made of a text of the page.
POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; worker-src blob:"
)


class ViewerParts(NamedTuple):
    """What differs between two viewers, as texts that stand in HTML as they are.

    Attributes:
        object: JSON about the object and its cameras.
        gaussians: the records of ``pack_gaussians``, base64.
        harmonics: the coefficients, base64, or nothing.
        mesh: ``pack_mesh``, base64, or nothing.
    """

    object: str
    gaussians: str
    harmonics: str
    mesh: str


def viewer_page(title: str, gaussians: Gaussians, **options: Any) -> str:
    """The viewer of one object as a whole document, for a file or for the ``srcdoc`` of a frame.

    Arguments and errors are those of ``viewer_parts``.
    """
    parts = viewer_parts(title, gaussians, **options)
    return _filled(program_page(title), parts._asdict())


def write_viewer(path: str | Path, title: str, gaussians: Gaussians, **options: Any) -> None:
    """Writes ``viewer_page`` to a file, atomically; arguments and errors as there.

    Raises:
        UserError: also where the file cannot be written.
    """
    write_text(path, viewer_page(title, gaussians, **options))


def program_page(title: str = "") -> str:
    """The document without an object: ``{{object}}`` and the like stand where its parts go."""
    texts = {
        "policy": POLICY,
        "title": html.escape(title),
        "style": _program("viewer.css"),
        "script": "".join(_program(f"{name}.js") for name in _SCRIPTS),
    }
    return _filled(_program("viewer.html"), texts)


def _program(name: str) -> str:
    return (Path(__file__).parent / "program" / name).read_text(encoding="utf-8")


def viewer_parts(
    title: str,
    gaussians: Gaussians,
    *,
    mesh: Any = None,
    camera: tuple[float, float, float] | None = None,
    view: tuple[float, float, float] | None = None,
    note: str = "",
) -> ViewerParts:
    """What fills the slots of ``program_page``.

    Args:
        title: name of the object.
        gaussians: ``[N]`` in the world of ``cameras.orbit``: y down, the input seen from azimuth 0.
        mesh: the object's surface in the same world, with ``vertices [V, 3]``, ``faces [F, 3]`` and
            ``colors [V, 3]`` in [0, 1] or None; or no mesh.
        camera: distance from the origin in object units, field of view of the shorter side and
            elevation, both in degrees, of the input's camera: it is the first view, and shown as
            lines. None: there was no input, and the object may have any size and be anywhere.
        view: the first view if there is no camera; its distance is that from the object's centre in
            units of the object's longest side.
        note: a few words below the title.

    Raises:
        UserError: a value is not finite, nothing can be seen, or the object has no extent.
        ValueError: there is a batch dimension.
    """
    seen = visible(gaussians, title)
    frame = own_frame(seen, title) if camera is None else Frame(np.zeros(3), 1.0)
    distance, fov, elevation = camera or view or (DEFAULT_DISTANCE, DEFAULT_FOV, 0.0)
    home = {"azimuth": 0.0, "elevation": math.radians(elevation), "distance": distance}
    home |= {"target": [0.0, 0.0, 0.0], "fov": fov}
    records, harmonics = pack_gaussians(seen, frame)
    surface, vertices, faces = (b"", 0, 0) if mesh is None else pack_mesh(mesh, frame, title)
    about = {
        "title": title,
        "note": note,
        "total": gaussians.num,
        "count": seen.num,
        "degree": seen.degree,
        "vertices": vertices,
        "faces": faces,
        "home": home,
        "input": None if camera is None else home,
        "frame": {"center": frame.center.tolist(), "size": frame.size},
    }
    packed = (base64.b64encode(part).decode() for part in (records, harmonics, surface))
    return ViewerParts(json_text(about), *packed)


def frame_element(
    name: str,
    title: str,
    gaussians: Gaussians,
    *,
    poster: str = "",
    auto: bool = False,
    **options: Any,
) -> str:
    """A place of another page in which the viewer runs, in a frame of its own.

    The page also needs ``frames_script()``, once, and ``POLICY`` or a wider policy.

    Args:
        name: of the place, unlike those of the page's other places: letters and digits.
        title: as for ``viewer_parts``, like ``gaussians``.
        poster: HTML that stands there until the viewer is started.
        auto: whether it starts by itself.
        options: as for ``viewer_parts``; errors as there.
    """
    parts = viewer_parts(title, gaussians, **options)
    kinds = {"object": "application/json"}
    scripts = "".join(
        f'<script type="{kinds.get(part, "text/plain")}" id="{name}-{part}">{text}</script>'
        for part, text in parts._asdict().items()
    )
    start = " data-auto" if auto else ""
    return (
        f'<div class="viewer" data-viewer="{name}"{start}>{poster}'
        f'<button type="button">3D</button></div>{scripts}'
    )


def frames_script() -> str:
    """What starts the viewers of a page: the program, once, and a script."""
    script, program = _program("frames.js"), json_text(program_page())
    return (
        f'<script type="application/json" id="viewer-program">{program}</script>\n'
        f"<script>\n{script}</script>\n"
    )


def json_text(value: Any) -> str:
    """JSON that can stand in a script element and in an attribute: nothing in it ends either."""
    text = json.dumps(value)
    for letter in "<>&'":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def _filled(template: str, texts: Mapping[str, str]) -> str:
    """The slots filled at once, so that what looks like one in a text stays as it is."""
    names = "|".join(texts)
    return re.sub(r"\{\{(" + names + r")\}\}", lambda match: texts[match[1]], template)
