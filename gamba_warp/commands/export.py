"""``gamba export``: files of Gaussians to meshes, splats, turntables and pages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..batch import for_each, report, unique_names
from ..conventions import Axes, DeviceChoice
from ..devices import pick_device
from ..errors import UserError
from ..files import output_folder
from ..formats.names import ExportFormat, MeshFormat
from ..surfaces.options import SurfaceOptions


def export_command(
    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")],
    /,
    out: Path = Path("out"),
    mesh: tuple[MeshFormat, ...] = ("glb",),
    formats: tuple[ExportFormat, ...] = (),
    surface: Literal["tsdf", "density"] = "tsdf",
    voxels: int = 128,
    views: int = 64,
    pixels: int = 256,
    faces: int = 0,
    colors: bool = True,
    close_holes: int = 30,
    min_component: float = 0.01,
    largest: bool = False,
    smooth: int = 0,
    frame: Axes = "opengl",
    min_opacity: float = 0.0,
    size: int = 256,
    frames: int = 48,
    device: DeviceChoice = "auto",
) -> int:
    """Turns files of Gaussians into meshes, other splat formats, pages and turntables.

    Meshes are NAME-mesh.FORMAT, all else is NAME.FORMAT; files of that name are replaced.

    Args:
        inputs: Gaussians (.ply in the 3DGS layout), or folders of them.
        out: Folder for the results.
        mesh: Files of the surface; give it without a value for none.
        formats: Files of the Gaussians, a page with a 3D viewer, moving pictures of one turn.
        surface: Method: tsdf (fused depth of many views) or density (level set; fattens thin
            parts).
        voxels: Number of voxels along the object's longest side.
        views: Number of pictures from all around, for depth and colours.
        pixels: Side of these pictures.
        faces: Simplify to at most so many; 0 keeps all.
        colors: Give the vertices colours (.stl has none).
        close_holes: Close holes with at most so many edges.
        min_component: Remove parts with a smaller share of the faces.
        largest: Keep the largest part only.
        smooth: Number of smoothing steps.
        frame: Axes of all but .splat and .glb; opengl is y up, opencv y down as in the input.
        min_opacity: Leave out Gaussians fainter than this.
        size: Side of the turntable's frames in pixels.
        frames: Number of views in the turntable.
        device: Device that renders; auto is the GPU if there is one.
    """
    from tqdm import tqdm

    from ..pages.export import ExportJob, export, find_gaussians

    _check(mesh, formats, min_component, size, frames)
    options = SurfaceOptions(
        method=surface,
        voxels=voxels,
        views=views,
        pixels=pixels,
        faces=faces,
        colors=colors and set(mesh) != {"stl"},
        close_holes=close_holes,
        min_component=min_component,
        largest=largest,
        smooth=smooth,
    )
    options.check()
    files, failures = find_gaussians(inputs)
    if not files:
        raise UserError("; ".join(f"{path}: {reason}" for path, reason in failures))
    chosen = pick_device(device)
    folder = output_folder(out)
    job = ExportJob(folder, mesh, formats, options, frame, min_opacity, size, frames, chosen)

    def one(name: str, path: Path) -> None:
        tqdm.write(export(name, path, job))

    for_each(unique_names(files), one, "export", "file", failures)
    return report(len(files), "file", failures, out)


def _check(mesh: tuple, formats: tuple, min_component: float, size: int, frames: int) -> None:
    """Raises UserError for the first option that is out of its range."""
    if size < 16 or frames < 2:
        raise UserError("--size must be at least 16 and --frames at least 2")
    if not mesh and not formats:
        raise UserError("nothing to write: give --mesh or --formats")
    if not 0 <= min_component < 1:
        raise UserError("--min-component is a share, from 0 to under 1")
