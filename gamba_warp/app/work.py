"""Reconstruction of a cut-out object, its viewer and files; independent of the web server."""

from __future__ import annotations

import tempfile
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import UserError
from ..files import atomic_path
from ..formats.names import MESH_FORMATS, SPLAT_FORMATS, splat_suffix
from .cutting import Cut, model_picture

if TYPE_CHECKING:
    from ..gaussians import Gaussians
    from ..model.gamba import Gamba

FRAMES, SIZE = 48, 320  # views of the turntable; their side in pixels
# By kind of file: the label of its button, and the suffix after the object's name.
GAUSSIANS = {kind: (f".{kind.replace('-', ' ')}", splat_suffix(kind)) for kind in SPLAT_FORMATS}
MESHES = {f"mesh-{kind}": (f".{kind}", f"-mesh.{kind}") for kind in MESH_FORMATS}
SHOWS = {
    "gif": ("Turntable .gif", ".gif"),
    "html": ("Viewer .html", ".html"),
    "zip": ("All of these .zip", ".zip"),
}
IN_ZIP = ("ply", "mesh-glb", "mesh-stl", "gif", "html")
# Choices for the mesh, by label.
FACES = {f"{count:,} faces": count for count in (2_000, 10_000, 50_000, 200_000)}
TEXTURES = {"No texture": 0, **{f"Texture {side}": side for side in (512, 1024, 2048)}}
KINDS = {**GAUSSIANS, **MESHES, **SHOWS}


class MeshChoice(NamedTuple):
    """Choices for the mesh: faces at most, side of a ``.glb``'s texture (0: none), closed."""

    faces: int = 10_000
    texture: int = 1024
    watertight: bool = False

    @classmethod
    def of(cls, faces: str, texture: str, watertight: bool) -> MeshChoice:
        """Read the labels of ``FACES`` and ``TEXTURES``.

        Raises:
            UserError: a label is unknown.
        """
        if faces not in FACES or texture not in TEXTURES:
            raise UserError(f"no such mesh: {faces}, {texture}")
        return cls(FACES[faces], TEXTURES[texture], watertight)


MESH = MeshChoice()


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


def run_model(model: Gamba, cut: Cut, elevation: float = 0.0) -> Reconstruction:
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
    made: Reconstruction,
    kind: str,
    folder: Path,
    device: str = "cpu",
    mesh: MeshChoice = MESH,
) -> tuple[Path, str | None]:
    """Write one file of a reconstruction.

    Args:
        made: the reconstruction.
        kind: one of ``KINDS``.
        folder: exists.
        device: device that renders.
        mesh: choices for a mesh.

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

        options = SurfaceOptions(colors=True, faces=mesh.faces, watertight=mesh.watertight)
        chosen, texture = torch.device(device), mesh.texture if kind == "mesh-glb" else 0
        options.require(texture)
        save_mesh(path, surface_of(made.gaussians.to(chosen), options, chosen, texture))
    elif kind == "zip":
        with tempfile.TemporaryDirectory(dir=folder) as inner, atomic_path(path) as temporary:
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
                for part in IN_ZIP:
                    file, _ = write(made, part, Path(inner), device, mesh)
                    archive.write(file, file.name)
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
