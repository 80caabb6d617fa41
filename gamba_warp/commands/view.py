"""``gamba view``: Gaussians or a mesh in the browser."""

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
    mesh_axes: Axes | None = None,
    open_browser: bool = True,
    elevation: Elevation = 0.0,
    fov: Fov | None = None,
    distance: Distance | None = None,
    drop_bad: bool = False,
) -> None:
    """Show Gaussians or a mesh in a browser, as one self-contained HTML page.

    Args:
        file: Gaussians (.ply, .splat, .spz, .glb), or a mesh (.glb, .obj, .ply, .stl).
        out: File for the page; a temporary file by default.
        mesh: A mesh of the same object, shown too (.glb, .obj, .ply, .stl).
        mesh_axes: Axes of the mesh; by default those that its file states, else opengl: y up.
        open_browser: Open the browser.
        elevation: Initial elevation of the camera above the object, degrees.
        fov: Field of view, degrees; 49.1 by default. Without --distance the object keeps its size
            in the image.
        distance: Initial distance of the camera from the object's centre, in units of its longest
            side; 1.5 by default.
        drop_bad: Leave out invalid Gaussians (a value that is not finite, a rotation of length
            zero), and print their number; without it such a file is refused.
    """
    import tempfile
    import webbrowser

    import numpy as np

    from ..formats.meshes import TexturedMesh
    from ..formats.read import Cloud, read
    from ..gaussians import Gaussians
    from ..trajectories.paths import Viewpoint
    from ..viewer.pack import own_frame, viewed_mesh, visible
    from ..viewer.page import write_viewer

    check_not_read([] if out is None else [out], [file] if mesh is None else [file, mesh])
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"--out {out}: the page is an .html file")
    content = read(file, drop_bad)
    if isinstance(content.shape, Cloud):
        raise UserError(f"{file}: contains points; gamba view shows Gaussians and meshes")
    gaussians = content.shape if isinstance(content.shape, Gaussians) else None
    if mesh is not None and gaussians is None:
        raise UserError(f"--mesh goes with Gaussians, {file} contains a mesh")
    warn(file, content.warnings)
    shown, surface = content if mesh is None else read(mesh, only=TexturedMesh), None
    if isinstance(shown.shape, TexturedMesh):
        surface = viewed_mesh(shown.shape, mesh_axes or shown.axes)
    if mesh is not None and gaussians is not None and surface is not None:
        warn(mesh, shown.warnings)
        size = own_frame(visible(gaussians, file.name), file.name).size
        scale = size / float(np.ptp(surface.vertices, axis=0).max())
        if not 0.5 < scale < 2:  # of --size-mm
            surface = surface._replace(vertices=surface.vertices * scale)
            warn(mesh, [f"its sides are scaled by {scale:.4g} to those of the Gaussians"])
    if out is not None:
        output_folder(out.parent)
    page = out or Path(tempfile.mkdtemp(prefix="gamba-")) / f"{file.stem}.html"
    start = Viewpoint().changed(elevation, distance, fov)
    write_viewer(page, file.name, gaussians, mesh=surface, view=start.camera)
    print(page, flush=True)
    if open_browser and not webbrowser.open(page.resolve().as_uri()):
        print("gamba: no browser was found; open the page above in one", file=sys.stderr)
