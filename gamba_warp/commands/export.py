"""``gamba export``: files of Gaussians to meshes, splats, turntables and pages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..batch import for_each, plan_outputs, say, warn
from ..conventions import DeviceChoice
from ..devices import pick_device
from ..errors import UserError
from ..files import output_folder
from ..pages.options import EXPORTED, FileOptions
from ..surfaces.options import Pixels, SurfaceOptions, Views, Voxels
from ..untrusted.ranges import Distance, Elevation, Fov, ranged
from .results import Results, reported


@reported
@ranged
def export_command(
    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")],
    /,
    files: Annotated[FileOptions, tyro.conf.OmitArgPrefixes] = EXPORTED,
    surface: Literal["tsdf", "density"] = "tsdf",
    voxels: Voxels = 128,
    views: Views = 64,
    pixels: Pixels = 256,
    largest: bool = False,
    elevation: Elevation = 0.0,
    fov: Fov | None = None,
    distance: Distance | None = None,
    drop_bad: bool = False,
    device: DeviceChoice = "auto",
) -> Results:
    """Turn files of Gaussians into meshes, other splat formats, pages and turntables.

    Meshes are NAME-mesh.FORMAT, splats NAME.FORMAT (compressed-ply: NAME.compressed.ply). Existing
    files are replaced, except inputs.

    Args:
        inputs: Gaussians (.ply, .splat, .spz, .glb), or folders of them.
        files: Outputs to write.
        surface: Method: tsdf (fused depth of many views) or density (level set; fattens thin
            parts).
        voxels: Number of voxels along the object's longest side.
        views: Number of views around the object, for depth and colours.
        pixels: Side of these views, pixels.
        largest: Keep the largest part only.
        elevation: Elevation of the camera of turntable and 3D viewer above the object, degrees.
        fov: Its field of view, degrees; 49.1 by default. Without --distance the object keeps its
            size in the image.
        distance: Its distance from the object's centre, in units of the longest side; 1.5 by
            default.
        drop_bad: Leave out invalid Gaussians (a value that is not finite, a rotation of length
            zero), and print their number; without it such a file is refused.
        device: Device that renders; auto is the GPU if there is one.
    """
    from ..formats.read import find_gaussians, read
    from ..gaussians import Gaussians
    from ..pipeline import Object, ObjectFiles
    from ..trajectories.paths import Viewpoint

    options = SurfaceOptions(surface, voxels, views, pixels, largest=largest, colors=True)
    view = Viewpoint().changed(elevation, distance, fov)
    outputs = ObjectFiles(options=files, surface=options, device=pick_device(device))
    if not outputs.suffixes():
        raise UserError("nothing to write: give --mesh, --splats, --page or --turntable")
    outputs.require()
    paths, failures = find_gaussians(inputs)
    if not paths:
        raise UserError("; ".join(f"{path}: {reason}" for path, reason in failures))
    names = plan_outputs(paths, outputs.suffixes(), files.out)
    output_folder(files.out)
    results = Results("file", len(paths), files.out, failures)

    def one(name: str, path: Path) -> None:
        content = read(path, drop_bad, Gaussians)
        warn(path, content.warnings)
        assert isinstance(content.shape, Gaussians)
        item = Object(name=name, gaussians=content.shape, view=view, in_unit=True)
        count, figures = outputs.write(item, content.comments)
        say(" ".join([f"{name}: {count}", *figures["notes"]]))
        results.figures.append({"input": str(path), "name": name, **figures})

    for_each(names, one, "export", "file", failures)
    return results
