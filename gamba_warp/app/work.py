"""Reconstruction of a cut-out object, its viewer and files; independent of the web server."""

from __future__ import annotations

import base64
import secrets
import tempfile
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ..data.preprocess import shrink
from ..errors import UserError
from ..files import atomic_path
from ..formats.gaussians.files import to_be_written, write_gaussians
from ..formats.names import MESH_FORMATS, SPLAT_FORMATS, splat_suffix
from ..gaussians import Gaussians
from ..images import save_image, to_uint8
from ..pipeline import Reconstruction, reconstruct_object
from ..surfaces import extract
from ..surfaces.extract import Surface
from ..surfaces.files import save_mesh
from ..surfaces.options import SurfaceOptions
from ..trajectories.movies import save_turntable, turntable_frames
from ..trajectories.paths import set_up, upright
from ..viewer.pack import visible_order
from ..viewer.page import viewer_page, write_viewer
from .cutting import Cut, model_image

if TYPE_CHECKING:
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
UNRENDERED = {*GAUSSIANS, "html"}  # kinds whose writing renders nothing
KINDS = {**GAUSSIANS, **MESHES, **SHOWS}
LOWEST, HIGHEST = -30, 90  # elevations that can be set by hand, degrees
_IMAGE, _SMALL = 512, 128  # largest side of a kept input; side of a thumbnail, pixels


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


@dataclass(eq=False, kw_only=True)
class EditableObject(Reconstruction):
    """Reconstruction that can be edited; ``gaussians`` are all, ``left`` those left.

    Attributes:
        image: the model's input ``[S, S, 4]`` uint8, reduced.
        surface: of ``left``, the last one that was extracted, or None.
        choice: its number of faces at most, and if it is closed.
        image_key: key of the image.
        chosen: elevation that was set by hand, or None.
        removed: ``[N]`` bool, Gaussians that were removed by hand; every edit makes a new tensor.
        key: unpredictable name.
    """

    image: np.ndarray
    surface: Surface | None = None
    choice: tuple[int, bool] | None = None
    image_key: str = ""
    chosen: float | None = None
    removed: torch.Tensor = field(init=False)
    key: str = field(init=False)

    def __post_init__(self) -> None:
        self.removed = torch.zeros(self.gaussians.num, dtype=torch.bool)
        self.key = secrets.token_hex(8)

    @property
    def left(self) -> Gaussians:
        """The Gaussians that are left, ``[n]``."""
        return self.gaussians.select(~self.removed)


def run_model(model: Gamba, cut: Cut, elevation: float | None = None) -> EditableObject:
    """Reconstruct an object; ``elevation`` and the errors are those of ``reconstruct_object``.

    Raises:
        UserError: also if the mask is empty.
    """
    rgba = model_image(cut)
    reconstruction = reconstruct_object(model, cut.name, rgba, elevation)
    small = to_uint8(shrink(rgba, _IMAGE))
    return EditableObject(**vars(reconstruction), image=small, image_key=cut.key, chosen=elevation)


def surface_of(
    edited: EditableObject, mesh: MeshChoice, device: str = "cpu", texture: int = 0
) -> Surface:
    """Return the surface of a reconstruction, and keep it.

    Args:
        edited: the reconstruction.
        mesh: number of faces, and if it is closed.
        device: device that renders.
        texture: side of a texture, pixels; without one the surface may have any.

    Raises:
        UserError: there is none, or a library is missing.
    """
    surface, choice = edited.surface, (mesh.faces, mesh.watertight)
    baked = 0 if surface is None or surface.texture is None else len(surface.texture.image)
    if surface is None or edited.choice != choice or texture not in (0, baked):
        options = SurfaceOptions(colors=True, faces=mesh.faces, watertight=mesh.watertight)
        options.require(texture)
        chosen = torch.device(device)
        surface = extract.surface_of(edited.left, options, chosen, texture)
        edited.surface, edited.choice = surface, choice
    return surface


def thumbnail(edited: EditableObject, path: Path, device: str = "cpu") -> None:
    """Write a small image of the object, from the input's camera.

    Raises:
        UserError: the file cannot be written.
    """
    frames = turntable_frames(edited.left.to(device), edited.view, size=_SMALL, frames=1)
    save_image(path, frames[0] / 255.0)


def viewer(edited: EditableObject) -> str:
    """Return the viewer of a reconstruction, with its last surface: a complete HTML document.

    Raises:
        UserError: the object is invisible.
    """
    bits = edited.removed[visible_order(edited.gaussians, edited.name)].numpy()
    removed = base64.b64encode(np.packbits(bits, bitorder="little").tobytes()).decode()
    edit = {"key": edited.key, "removed": removed, "elevation": edited.view.elevation}
    return viewer_page(edited.name, edited.gaussians, edit=edit, **_shown(edited))


def edit(edited: EditableObject, elevation: float, removed: bytes) -> None:
    """Rotate a reconstruction, and leave Gaussians out, which forgets its surface.

    Args:
        edited: the reconstruction.
        elevation: of the image's camera above the object, degrees; the result is upright.
        removed: a bit for each Gaussian, in the order of the viewer, the lowest bit first.

    Raises:
        UserError: the number of bits is wrong, or nothing would be left.
    """
    order = visible_order(edited.gaussians, edited.name)
    bits = np.unpackbits(np.frombuffer(removed, np.uint8), bitorder="little")
    if len(removed) != -(-len(order) // 8) or bits[len(order) :].any():
        raise UserError("the removed parts are not those of this object")
    gone = torch.from_numpy(bits[: len(order)].astype(bool))
    if gone.all():
        raise UserError("this removes all Gaussians")
    before, surface, angle = edited.removed, edited.surface, elevation - edited.view.elevation
    edited.removed = torch.zeros_like(before).index_fill(0, order[gone], True)
    if not edited.removed.equal(before):
        edited.surface = None
    elif surface is not None:
        vertices = surface.vertices @ upright(angle).double().numpy().T
        edited.surface = replace(surface, vertices=vertices)
    if angle:
        edited.gaussians = set_up(edited.gaussians, angle)
        edited.view = edited.view.changed(elevation)
        edited.chosen = elevation


def _shown(edited: EditableObject) -> dict:
    return {"camera": edited.view.camera, "mesh": edited.surface, "image": edited.image / 255.0}


def write(
    edited: EditableObject,
    kind: str,
    folder: Path,
    device: str = "cpu",
    mesh: MeshChoice = MESH,
) -> tuple[Path, str | None]:
    """Write one file of a reconstruction.

    Args:
        edited: the reconstruction.
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
    path, note = folder / f"{edited.name}{KINDS[kind][1]}", None
    if kind in GAUSSIANS:
        gaussians, count = to_be_written(edited.left)
        lost = write_gaussians(path, gaussians, kind)  # type: ignore[arg-type]
        note = f"{lost} {count}" if lost else count
    elif kind in MESHES:
        texture = mesh.texture if kind == "mesh-glb" else 0
        surface = surface_of(edited, mesh, device, texture)
        save_mesh(path, surface if texture else replace(surface, texture=None))
    elif kind == "zip":
        with tempfile.TemporaryDirectory(dir=folder) as inner, atomic_path(path) as temporary:
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
                for part in IN_ZIP:
                    file, _ = write(edited, part, Path(inner), device, mesh)
                    archive.write(file, file.name)
    elif kind == "gif":
        frames = turntable_frames(edited.left.to(device), edited.view, size=SIZE, frames=FRAMES)
        save_turntable(path, frames)
    else:
        write_viewer(path, edited.name, edited.left, **_shown(edited))
    return path, note
