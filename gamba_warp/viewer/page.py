"""Page of the viewer: one self-contained HTML document that fills the window."""

from __future__ import annotations

import base64
import html
import io
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..conventions import DEFAULT_DISTANCE, DEFAULT_FOV
from ..files import write_text
from ..gaussians import Gaussians
from ..images import to_uint8
from .pack import Frame, frame_of_mesh, own_frame, pack_gaussians, pack_mesh, visible

# In order of their dependencies.
_SCRIPTS = "shaders gl sorter camera controls packed meshes open edit ui main".split()
_IMAGE = 512  # longest side of the input, pixels
# The page may load only inlined content; the sorting worker is made from a text of the page.
POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; worker-src blob:"
)


def viewer_page(title: str, gaussians: Gaussians | None, **options: Any) -> str:
    """Return the viewer of one object as a document, for a file or the ``srcdoc`` of a frame.

    Arguments and errors are those of ``viewer_parts``.
    """
    return _filled(program_page(title), viewer_parts(title, gaussians, **options))


def write_viewer(path: str | Path, title: str, gaussians: Gaussians | None, **options: Any) -> None:
    """Write ``viewer_page`` to a file, atomically; arguments and errors as there.

    Raises:
        UserError: also if the file cannot be written.
    """
    write_text(path, viewer_page(title, gaussians, **options))


def program_page(title: str = "") -> str:
    """Return the document without an object, with slots such as ``{{object}}``."""
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
    gaussians: Gaussians | None,
    *,
    mesh: Any = None,
    camera: tuple[float, float, float] | None = None,
    view: tuple[float, float, float] | None = None,
    image: np.ndarray | None = None,
    note: str = "",
    edit: dict[str, Any] | None = None,
) -> dict[str, str]:
    """Return the texts for the slots of ``program_page``.

    They are ``object``, JSON about the object and its cameras, and in base64 ``gaussians`` (the
    records of ``pack_gaussians``), ``harmonics`` (their coefficients, or nothing) and ``mesh`` (of
    ``pack_mesh``, or nothing).

    Args:
        title: name of the object.
        gaussians: ``[N]`` in the world of ``cameras.orbit``: y down, the input seen from azimuth 0;
            None shows the mesh alone.
        mesh: the object's surface in the same world, with ``vertices [V, 3]``, ``faces [F, 3]`` and
            ``colors [V, 3]`` in [0, 1] or None; or no mesh.
        camera: distance from the origin in object units, field of view of the shorter side and
            elevation, both in degrees, of the input's camera: the initial view, also drawn as
            lines. None: without an input; the object may have any size and position.
        view: the initial view without a camera; its distance is from the object's centre, in units
            of the object's longest side.
        image: the input from ``camera``, ``[S, S, 3|4]`` in [0, 1], which a slider shows.
        note: a few words below the title.
        edit: lets the viewer edit the object, and tell the page around its frame: ``key`` of the
            object, ``elevation`` of ``camera``, and ``removed``, in base64 a bit for each Gaussian
            in the order of ``visible_order``.

    Raises:
        UserError: a value is not finite, nothing can be seen, or the object has no extent.
        ValueError: there is a batch dimension.
    """
    seen = None if gaussians is None else visible(gaussians, title)
    frame = Frame(np.zeros(3), 1.0)
    if camera is None:
        frame = frame_of_mesh(mesh) if seen is None else own_frame(seen, title)
    distance, fov, elevation = camera or view or (DEFAULT_DISTANCE, DEFAULT_FOV, 0.0)
    home = {"azimuth": 0.0, "elevation": math.radians(elevation), "distance": distance}
    home |= {"target": [0.0, 0.0, 0.0], "fov": fov}
    url = ""
    if image is not None:
        content, small = io.BytesIO(), Image.fromarray(to_uint8(image))
        small.thumbnail((_IMAGE, _IMAGE))
        small.save(content, "WEBP", quality=90)
        url = f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"
    records, harmonics = (b"", b"") if seen is None else pack_gaussians(seen, frame)
    surface, vertices, faces = (b"", 0, 0) if mesh is None else pack_mesh(mesh, frame, title)
    about = {
        "title": title,
        "note": note,
        "total": gaussians.num if gaussians else 0,
        "count": seen.num if seen else 0,
        "degree": seen.degree if seen else 0,
        "antialiased": seen.antialiased if seen else False,
        "vertices": vertices,
        "faces": faces,
        "home": home,
        "input": None if camera is None else home,
        "image": url,
        "frame": {"center": frame.center.tolist(), "size": frame.size},
        "edit": edit,
    }
    packed = {"gaussians": records, "harmonics": harmonics, "mesh": surface}
    texts = {name: base64.b64encode(part).decode() for name, part in packed.items()}
    return {"object": json_text(about), **texts}


def frame_element(
    name: str,
    title: str,
    gaussians: Gaussians,
    *,
    poster: str = "",
    auto: bool = False,
    **options: Any,
) -> str:
    """Return an element of another page in which the viewer runs, in its own frame.

    The page also needs ``frames_script()``, once, and ``POLICY`` or a wider policy.

    Args:
        name: unique id of the element: letters and digits.
        title: as for ``viewer_parts``, like ``gaussians``.
        poster: HTML shown until the viewer starts.
        auto: start without a click.
        options: as for ``viewer_parts``; errors as there.
    """
    parts = viewer_parts(title, gaussians, **options)
    kinds = {"object": "application/json"}
    scripts = "".join(
        f'<script type="{kinds.get(part, "text/plain")}" id="{name}-{part}">{text}</script>'
        for part, text in parts.items()
    )
    start = " data-auto" if auto else ""
    return (
        f'<div class="viewer" data-viewer="{name}"{start}>{poster}'
        f'<button type="button">3D</button></div>{scripts}'
    )


def frames_script() -> str:
    """Return the script that starts the viewers of a page, with the program."""
    script, program = _program("frames.js"), json_text(program_page())
    return (
        f'<script type="application/json" id="viewer-program">{program}</script>\n'
        f"<script>\n{script}</script>\n"
    )


def json_text(value: Any) -> str:
    """Return JSON that is safe in script elements and attributes."""
    text = json.dumps(value)
    for letter in "<>&'":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def _filled(template: str, texts: Mapping[str, str]) -> str:
    """Fill all slots at once, so that slots within texts are not replaced."""
    names = "|".join(texts)
    return re.sub(r"\{\{(" + names + r")\}\}", lambda match: texts[match[1]], template)
