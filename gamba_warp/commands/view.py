"""``gamba view``: a file of Gaussians in the browser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro
from msgspec import Meta

from ..batch import check_not_read, warn
from ..conventions import Axes
from ..errors import UserError
from ..files import output_folder
from ..untrusted.ranges import Distance, Elevation, Fov, ranged


@ranged
def view_command(
    file: tyro.conf.Positional[Path],
    /,
    out: Path | None = None,
    mesh: Path | None = None,
    mesh_frame: Axes = "opengl",
    serve: bool = False,
    port: Annotated[int, Meta(ge=0, le=65535)] = 8000,
    open_browser: bool = True,
    elevation: Elevation = 0.0,
    fov: Fov | None = None,
    distance: Distance | None = None,
    drop_bad: bool = False,
) -> None:
    """Show Gaussians in a browser, as one self-contained HTML page.

    Args:
        file: Gaussians (.ply, .splat, .spz, .glb).
        out: File for the page; a temporary file by default.
        mesh: A mesh of the same object, shown too (.glb, .obj, .ply, .stl).
        mesh_frame: Axes of the mesh; opengl is y up, gamba's default for meshes.
        serve: Serve it on this machine until Ctrl-C, for a browser at the other end of a tunnel.
        port: Port of --serve; 0 picks a free one.
        open_browser: Open the browser.
        elevation: Initial elevation of the camera above the object, degrees.
        fov: Field of view, degrees; 49.1 by default. Without --distance the object keeps its size
            in the picture.
        distance: Initial distance of the camera from the object's centre, in units of its longest
            side; 1.5 by default.
        drop_bad: Leave out invalid Gaussians (a value that is not finite, a rotation of length
            zero), and print their number; without it such a file is refused.
    """
    import tempfile

    from ..pages.export import read_with_warning
    from ..pages.serve import page_server
    from ..trajectories.paths import Viewpoint
    from ..viewer.pack import read_viewed_mesh
    from ..viewer.page import write_viewer

    check_not_read([] if out is None else [out], [file] if mesh is None else [file, mesh])
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"--out {out}: the page is an .html file")
    gaussians = read_with_warning(file, drop_bad)
    surface = None
    if mesh is not None:
        surface = read_viewed_mesh(mesh, mesh_frame)
        warn(mesh, surface.warnings)
    if out is not None:
        output_folder(out.parent)
    page = out or Path(tempfile.mkdtemp(prefix="gamba-")) / f"{file.stem}.html"
    start = Viewpoint().changed(elevation, distance, fov)
    view = (start.distance, start.fov, start.elevation)
    write_viewer(page, file.name, gaussians, mesh=surface, view=view)
    if not serve:
        print(page)
        if open_browser:
            _open(page.resolve().as_uri())
        return
    with page_server(page.read_bytes(), port) as server:
        address = f"http://127.0.0.1:{server.server_port}/"
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if open_browser:
            _open(address)
        server.serve_forever()


def _open(address: str) -> None:
    """Open the address in a browser, or print that none was found."""
    import webbrowser

    if not webbrowser.open(address):
        print(
            "gamba: no browser was found; open the page above in one", file=sys.stderr, flush=True
        )
