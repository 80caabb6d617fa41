"""Reconstruction of a cut-out object, its viewer and files; independent of the web server."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UserError
from ..formats.names import MESH_FORMATS, SPLAT_FORMATS, splat_suffix
from .cutting import Cut, model_picture

if TYPE_CHECKING:
    from ..gaussians import Gaussians
    from ..model.gamba import Gamba

FRAMES, SIZE = 48, 320  # views of the turntable; their side in pixels
# By kind of file: the label of its button, and the suffix after the object's name.
GAUSSIANS = {kind: (f".{kind.replace('-', ' ')}", splat_suffix(kind)) for kind in SPLAT_FORMATS}
MESHES = {f"mesh-{kind}": (f".{kind}", f"-mesh.{kind}") for kind in MESH_FORMATS}
SHOWS = {"gif": ("Turntable .gif", ".gif"), "html": ("Viewer .html", ".html")}
KINDS = {**GAUSSIANS, **MESHES, **SHOWS}


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """One reconstruction.

    Attributes:
        name: stem of its files.
        gaussians: ``[N]`` on the CPU, upright, OpenCV's axes.
        camera: distance (object units), field of view and elevation (degrees) of the input's.
        seconds: run time of the model.
    """

    name: str
    gaussians: Gaussians
    camera: tuple[float, float, float]
    seconds: float


def solve(model: Gamba, cut: Cut, elevation: float = 0.0) -> Reconstruction:
    """Run one forward pass.

    Args:
        model: on any device.
        cut: the object.
        elevation: of the picture's camera above the object, degrees; the result is upright.

    Raises:
        UserError: the mask is empty.
    """
    from ..model.predict import reconstruct
    from ..trajectories.paths import set_up

    rgba = model_picture(cut)
    started = time.perf_counter()
    gaussians = reconstruct(model, rgba).to("cpu")
    seconds = time.perf_counter() - started
    camera = model.config.distance, model.config.fov, elevation
    return Reconstruction(cut.name, set_up(gaussians, elevation), camera, seconds)


def viewer(made: Reconstruction) -> str:
    """Return the viewer of a reconstruction, a complete HTML document.

    Raises:
        UserError: the object is invisible.
    """
    from ..viewer.page import viewer_page

    return viewer_page(made.name, made.gaussians, camera=made.camera)


def write(
    made: Reconstruction, kind: str, folder: Path, device: str = "cpu"
) -> tuple[Path, str | None]:
    """Write one file of a reconstruction.

    Args:
        made: the reconstruction.
        kind: one of ``KINDS``.
        folder: exists.
        device: device that renders.

    Returns:
        The file, and for Gaussians a note on its content, else None.

    Raises:
        UserError: the kind is unknown, the object has no surface, a library is missing, or the
            file cannot be written.
    """
    if kind not in KINDS:
        raise UserError(f"no such kind of file: {kind}")
    path, note = folder / f"{made.name}{KINDS[kind][1]}", None
    if kind in GAUSSIANS:
        from ..formats.gaussians.files import to_be_written, write_gaussians

        gaussians, count = to_be_written(made.gaussians)
        lost = write_gaussians(path, gaussians, kind)  # type: ignore[arg-type]
        note = f"{lost} {count}" if lost else count
    elif kind in MESHES:
        import torch

        from ..surfaces.extract import surface_of
        from ..surfaces.files import save_mesh
        from ..surfaces.options import SurfaceOptions

        options, chosen = SurfaceOptions(colors=True), torch.device(device)
        save_mesh(path, surface_of(made.gaussians.to(chosen), options, chosen))
    elif kind == "gif":
        from ..pages.turntable import save_turntable, turntable_frames

        distance, fov, elevation = made.camera
        view = {"distance": distance, "fov": fov, "elevation": elevation}
        gaussians = made.gaussians.to(device)
        save_turntable(path, turntable_frames(gaussians, size=SIZE, frames=FRAMES, **view))
    else:
        from ..viewer.page import write_viewer

        write_viewer(path, made.name, made.gaussians, camera=made.camera)
    return path, note
