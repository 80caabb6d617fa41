"""``gamba export``: files of Gaussians to meshes, splats, turntables and pages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..batch import for_each, plan_outputs, report
from ..conventions import Axes, DeviceChoice
from ..devices import pick_device
from ..errors import UserError
from ..files import output_folder
from ..formats.names import MeshChoice, SplatFormat, mesh_formats
from ..surfaces.options import (
    BROWSER_FACES,
    TEXTURED_FACES,
    Faces,
    Holes,
    PartShare,
    Pixels,
    Smoothing,
    SurfaceOptions,
    Texels,
    Views,
    Voxels,
)
from ..untrusted.ranges import Distance, Elevation, Fov, Frames, Opacity, Side, ranged

if TYPE_CHECKING:
    from ..pages.export import ExportJob


@ranged
def export_command(
    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")],
    /,
    out: Path = Path("out"),
    mesh: tuple[MeshChoice, ...] = ("glb",),
    splats: tuple[SplatFormat, ...] = (),
    page: bool = False,
    turntable: Literal["gif", "mp4", "none"] = "none",
    surface: Literal["tsdf", "density"] = "tsdf",
    voxels: Voxels = 128,
    views: Views = 64,
    pixels: Pixels = 256,
    faces: Faces | None = None,
    colors: bool = True,
    texture: Texels = 0,
    close_holes: Holes = 30,
    min_component: PartShare = 0.01,
    largest: bool = False,
    smooth: Smoothing = 0,
    frame: Axes = "opengl",
    min_opacity: Opacity | None = None,
    size: Side = 256,
    frames: Frames = 48,
    elevation: Elevation = 0.0,
    fov: Fov | None = None,
    distance: Distance | None = None,
    device: DeviceChoice = "auto",
) -> int:
    """Turns files of Gaussians into meshes, other splat formats, pages and turntables.

    Meshes are NAME-mesh.FORMAT, splats NAME.FORMAT (compressed-ply: NAME.compressed.ply); files
    of that name are replaced, but never one that is read.

    Args:
        inputs: Gaussians (.ply, .splat, .spz, .glb), or folders of them.
        out: Folder for the results.
        mesh: Files of the surface.
        splats: Files of the Gaussians.
        page: Write an HTML page with a 3D viewer.
        turntable: Moving picture of one turn.
        surface: Method: tsdf (fused depth of many views) or density (level set; fattens thin
            parts).
        voxels: Number of voxels along the object's longest side.
        views: Number of pictures from all around, for depth and colours.
        pixels: Side of these pictures.
        faces: Simplify to at most so many; 0 keeps all. 50,000 if not given, 10,000 with --texture.
        colors: Give the vertices colours (.stl has none).
        texture: Side in pixels of a picture of the colours, in the .glb, and beside the .obj with a
            .mtl; 0 for none. 1024 is plenty for what the models make.
        close_holes: Close holes with at most so many edges.
        min_component: Remove parts with a smaller share of the faces.
        largest: Keep the largest part only.
        smooth: Number of smoothing steps.
        frame: Axes of meshes but .glb; opengl is y up, opencv y down as files of Gaussians are.
        min_opacity: Leave out Gaussians fainter than this; 1/255 if not given, below which they
            are never drawn. 0 keeps all.
        size: Side of the turntable's frames in pixels.
        frames: Number of views in the turntable.
        elevation: Degrees by which the camera of turntable and 3D viewer stands above the object.
        fov: Its field of view, degrees; 49.1 if not given. Without --distance the object stays as
            large.
        distance: Its distance from the object's centre, in units of the longest side; 1.5 if not
            given.
        device: Device that renders; auto is the GPU if there is one.
    """
    from ..pages.export import ExportJob
    from ..trajectories.paths import Viewpoint

    options = SurfaceOptions(
        method=surface,
        voxels=voxels,
        views=views,
        pixels=pixels,
        faces=(TEXTURED_FACES if texture else BROWSER_FACES) if faces is None else faces,
        colors=colors and set(mesh) != {"stl"},
        close_holes=close_holes,
        min_component=min_component,
        largest=largest,
        smooth=smooth,
    )
    job = ExportJob(
        folder=out,
        mesh=mesh_formats(mesh),
        splats=splats,
        page=page,
        turntable=turntable,
        surface=options,
        texture=texture,
        axes=frame,
        min_opacity=min_opacity,
        size=size,
        frames=frames,
        device=pick_device(device),
        view=Viewpoint().changed(elevation, distance, fov),
    )
    return _run(inputs, job)


def _run(inputs: tuple[Path, ...], job: ExportJob) -> int:
    """Writes what the job says for each file, and returns the exit code."""
    from tqdm import tqdm

    from ..pages.export import export, find_gaussians

    if not job.suffixes():
        raise UserError("nothing to write: give --mesh, --splats, --page or --turntable")
    job.require()
    files, failures = find_gaussians(inputs)
    if not files:
        raise UserError("; ".join(f"{path}: {reason}" for path, reason in failures))
    names = plan_outputs(files, job.suffixes(), job.folder)
    output_folder(job.folder)

    def one(name: str, path: Path) -> None:
        tqdm.write(export(name, path, job))

    for_each(names, one, "export", "file", failures)
    return report(len(files), "file", failures, job.folder)
