"""Reconstruction of a cut-out object, its viewer and files; independent of the web server."""

from __future__ import annotations

import base64
import secrets
import tempfile
import time
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ..errors import UserError
from ..files import atomic_path
from ..formats.names import MESH_FORMATS, SPLAT_FORMATS, splat_suffix
from .cutting import Cut, model_picture

if TYPE_CHECKING:
    from ..gaussians import Gaussians
    from ..model.gamba import Gamba
    from ..surfaces.extract import Surface

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
UNRENDERED = {*GAUSSIANS, "html"}  # kinds whose writing renders nothing
KINDS = {**GAUSSIANS, **MESHES, **SHOWS}
LOWEST, HIGHEST = -30, 90  # elevations that can be set by hand, degrees
_PICTURE, _SMALL = 512, 128  # largest side of a kept input; side of a thumbnail, pixels


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


@dataclass(eq=False)
class Reconstruction:
    """One reconstruction.

    Attributes:
        name: stem of its files.
        whole: ``[N]`` on the CPU, upright, OpenCV's axes.
        camera: distance (object units), field of view and elevation (degrees) of the input's.
        seconds: run time of the model.
        picture: the model's input ``[S, S, 4]`` uint8, reduced.
        surface: the last one that was extracted, or None.
        choice: its number of faces at most, and if it is closed.
        given: key of the picture.
        estimate: of the elevation, in words.
        chosen: elevation that was set by hand, or None.
        removed: ``[N]`` bool, Gaussians that were removed by hand; every edit makes a new tensor.
        key: unpredictable name.
    """

    name: str
    whole: Gaussians
    camera: tuple[float, float, float]
    seconds: float
    picture: np.ndarray
    surface: Surface | None = None
    choice: tuple[int, bool] | None = None
    given: str = ""
    estimate: str = ""
    chosen: float | None = None
    removed: torch.Tensor = field(init=False)
    key: str = field(init=False)

    def __post_init__(self) -> None:
        self.removed = torch.zeros(self.whole.num, dtype=torch.bool)
        self.key = secrets.token_hex(8)

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians that are left, ``[n]``."""
        return self.whole.select(~self.removed)


def run_model(model: Gamba, cut: Cut, elevation: float | None = None) -> Reconstruction:
    """Run one forward pass.

    Args:
        model: on any device.
        cut: the object.
        elevation: of the picture's camera above the object, set by hand, degrees; None for the
            estimate. The result is upright.

    Raises:
        UserError: the mask is empty.
    """
    from ..data.preprocess import shrink
    from ..images import to_uint8
    from ..model.predict import reconstruct
    from ..trajectories.elevation import estimate_elevation
    from ..trajectories.paths import set_up

    rgba = model_picture(cut)
    started = time.perf_counter()
    gaussians = reconstruct(model, rgba).to("cpu")
    seconds = time.perf_counter() - started
    estimate = estimate_elevation(gaussians)
    angle = estimate.degrees if elevation is None else elevation
    camera = model.config.distance, model.config.fov, angle
    upright, picture = set_up(gaussians, angle), to_uint8(shrink(rgba, _PICTURE))
    made = Reconstruction(cut.name, upright, camera, seconds, picture)
    made.given, made.estimate, made.chosen = cut.key, str(estimate), elevation
    return made


def surface_of(
    made: Reconstruction, mesh: MeshChoice, device: str = "cpu", texture: int = 0
) -> Surface:
    """Return the surface of a reconstruction, and keep it.

    Args:
        made: the reconstruction.
        mesh: number of faces, and if it is closed.
        device: device that renders.
        texture: side of a texture, pixels; without one the surface may have any.

    Raises:
        UserError: there is none, or a library is missing.
    """
    from ..surfaces import extract
    from ..surfaces.options import SurfaceOptions

    kept, choice = made.surface, (mesh.faces, mesh.watertight)
    baked = 0 if kept is None or kept.texture is None else len(kept.texture.image)
    if kept is None or made.choice != choice or texture not in (0, baked):
        options = SurfaceOptions(colors=True, faces=mesh.faces, watertight=mesh.watertight)
        options.require(texture)
        chosen = torch.device(device)
        kept = extract.surface_of(made.gaussians.to(chosen), options, chosen, texture)
        made.surface, made.choice = kept, choice
    return kept


def thumbnail(made: Reconstruction, path: Path, device: str = "cpu") -> None:
    """Write a small picture of the object, from the input's camera.

    Raises:
        UserError: the file cannot be written.
    """
    from ..images import save_image
    from ..pages.turntable import turntable_frames

    distance, fov, elevation = made.camera
    view = {"distance": distance, "fov": fov, "elevation": elevation}
    frames = turntable_frames(made.gaussians.to(device), size=_SMALL, frames=1, **view)
    save_image(path, frames[0] / 255.0)


def viewer(made: Reconstruction) -> str:
    """Return the viewer of a reconstruction, with its last surface: a complete HTML document.

    Raises:
        UserError: the object is invisible.
    """
    from ..viewer.pack import visible_order
    from ..viewer.page import viewer_page

    bits = made.removed[visible_order(made.whole, made.name)].numpy()
    removed = base64.b64encode(np.packbits(bits, bitorder="little").tobytes()).decode()
    edit = {"key": made.key, "removed": removed, "elevation": made.camera[2]}
    return viewer_page(made.name, made.whole, edit=edit, **_shown(made))


def edit(made: Reconstruction, elevation: float, removed: bytes) -> None:
    """Rotate a reconstruction, and leave Gaussians out, which forgets its surface.

    Args:
        made: the reconstruction.
        elevation: of the picture's camera above the object, degrees; the result is upright.
        removed: a bit for each Gaussian, in the order of the viewer, the lowest bit first.

    Raises:
        UserError: the number of bits is wrong, or nothing would be left.
    """
    from ..trajectories.paths import set_up, upright
    from ..viewer.pack import visible_order

    order = visible_order(made.whole, made.name)
    bits = np.unpackbits(np.frombuffer(removed, np.uint8), bitorder="little")
    if len(removed) != -(-len(order) // 8) or bits[len(order) :].any():
        raise UserError("the removed parts are not those of this object")
    gone = torch.from_numpy(bits[: len(order)].astype(bool))
    if gone.all():
        raise UserError("nothing of the object would be left")
    before, surface, angle = made.removed, made.surface, elevation - made.camera[2]
    made.removed = torch.zeros_like(before).index_fill(0, order[gone], True)
    if not made.removed.equal(before):
        made.surface = None
    elif surface is not None:
        vertices = surface.vertices @ upright(angle).double().numpy().T
        made.surface = replace(surface, vertices=vertices)
    if angle:
        made.whole = set_up(made.whole, angle)
        made.camera = (*made.camera[:2], elevation)
        made.chosen = elevation


def _shown(made: Reconstruction) -> dict:
    return {"camera": made.camera, "mesh": made.surface, "picture": made.picture / 255.0}


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
        from ..surfaces.files import save_mesh

        texture = mesh.texture if kind == "mesh-glb" else 0
        surface = surface_of(made, mesh, device, texture)
        save_mesh(path, surface if texture else replace(surface, texture=None))
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

        write_viewer(path, made.name, made.gaussians, **_shown(made))
    return path, note
