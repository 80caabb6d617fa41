"""``gamba view``: a file of Gaussians in the browser."""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

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
    import webbrowser

    import numpy as np

    from ..formats.read import read_with_warning
    from ..trajectories.paths import Viewpoint
    from ..viewer.pack import own_frame, read_viewed_mesh, visible
    from ..viewer.page import write_viewer

    check_not_read([] if out is None else [out], [file] if mesh is None else [file, mesh])
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"--out {out}: the page is an .html file")
    gaussians = read_with_warning(file, drop_bad)
    surface = None
    if mesh is not None:
        surface = read_viewed_mesh(mesh, mesh_frame)
        warn(mesh, surface.warnings)
        size = own_frame(visible(gaussians, file.name), file.name).size
        scale = size / float(np.ptp(surface.vertices, axis=0).max())
        if not 0.5 < scale < 2:  # of --size-mm
            surface = surface._replace(vertices=surface.vertices * scale)
            warn(mesh, [f"its sides are scaled by {scale:.4g} to those of the Gaussians"])
    if out is not None:
        output_folder(out.parent)
    page = out or Path(tempfile.mkdtemp(prefix="gamba-")) / f"{file.stem}.html"
    start = Viewpoint().changed(elevation, distance, fov)
    view = (start.distance, start.fov, start.elevation)
    write_viewer(page, file.name, gaussians, mesh=surface, view=view)
    print(page, flush=True)
    if open_browser and not webbrowser.open(page.resolve().as_uri()):
        print("gamba: no browser was found; open the page above in one", file=sys.stderr)
