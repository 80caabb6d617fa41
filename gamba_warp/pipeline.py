"""Flow from an image to files: Gaussians of a cut-out, elevation, the upright object, its files.

``reconstruct_object`` makes a ``Reconstruction``, ``ObjectFiles.write`` writes its files. The
command, the page and scripts use both; ``gamba export`` writes an ``Object`` that it has read.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from .batch import STAGES
from .conventions import Detail, Precision
from .data.preprocess import composite
from .formats.gaussians.files import to_be_written, write_gaussians
from .formats.names import mesh_formats, splat_suffix
from .gaussians import Gaussians
from .images import save_image, to_uint8
from .model.predict import reconstruct
from .pages.options import FileOptions
from .pages.page import Section, write_page
from .pages.sheet import Sheet
from .photo.cutout import CutOut
from .surfaces.extract import Surface, surface_of, unit_frame
from .surfaces.files import mesh_suffixes, write_meshes
from .surfaces.options import BROWSER_FACES, TEXTURE, TEXTURED_FACES, SurfaceOptions
from .trajectories.elevation import ElevationEstimate, estimate_elevation
from .trajectories.movies import require_movie, save_turntable, turntable_frames
from .trajectories.paths import Viewpoint, set_up

if TYPE_CHECKING:
    from .model.gamba import Gamba

INDEX = "index.html"  # links to the pages of several results
_SMALL = (320, 160)  # size of its thumbnails, an input and its result, pixels


@dataclass(eq=False, kw_only=True)
class Object:
    """Object whose files are written.

    Attributes:
        name: stem of its files.
        gaussians: ``[N]``, upright: -y is up.
        view: camera of turntable and viewer; of a reconstruction, the input image's.
        in_unit: True shows the object in turntable and viewer in its unit frame, because its size
            and position are any.
    """

    name: str
    gaussians: Gaussians
    view: Viewpoint
    in_unit: bool = False


@dataclass(eq=False, kw_only=True)
class Reconstruction(Object):
    """Object reconstructed from an image.

    Attributes:
        estimate: elevation of the image's camera, estimated from the Gaussians.
        seconds: run time of the model.
    """

    estimate: ElevationEstimate
    seconds: float


def reconstruct_object(
    model: Gamba,
    name: str,
    rgba: np.ndarray,
    elevation: float | None = None,
    precision: Precision = "float32",
    detail: Detail | None = None,
) -> Reconstruction:
    """Reconstruct a cut-out by one forward pass, and set the object upright.

    Args:
        model: on any device, in evaluation mode.
        name: of the object.
        rgba: ``[S, S, 4]`` in [0, 1] with the object in the middle, as ``photo.cutout.cut_out``
            returns it.
        elevation: of the image's camera above the object, degrees; None for the estimate.
        precision: as for ``model.predict.reconstruct``.
        detail: likewise.

    Returns:
        The object, with Gaussians on the CPU.

    Raises:
        UserError: the model cannot split its front.
        ValueError: the array has another shape.
    """
    started = time.perf_counter()
    gaussians = reconstruct(model, rgba, precision, detail).to("cpu")  # waits for the device
    seconds = time.perf_counter() - started
    estimate = estimate_elevation(gaussians)
    angle = estimate.degrees if elevation is None else elevation
    view = Viewpoint(angle, model.config.distance, model.config.fov)
    return Reconstruction(
        name=name,
        gaussians=set_up(gaussians, angle),
        view=view,
        estimate=estimate,
        seconds=seconds,
    )


@dataclass(kw_only=True)
class ObjectFiles:
    """Files to write for each object.

    Attributes:
        options: the files.
        surface: options of the mesh; the number of faces follows from ``options``.
        device: device that renders.
        texture: side of its texture, pixels; 0: none.
        mesh: formats of the mesh.
    """

    options: FileOptions
    surface: SurfaceOptions = SurfaceOptions(colors=True)
    device: torch.device = torch.device("cpu")
    texture: int = field(init=False)

    def __post_init__(self) -> None:
        options, self.mesh = self.options, mesh_formats(self.options.mesh)
        self.texture = options.texture or 0
        # xatlas has wheels for some machines only; elsewhere the vertices have the colours.
        if options.texture is None and "glb" in self.mesh and self.surface.colors:
            self.texture = TEXTURE if find_spec("xatlas") else 0
        faces = TEXTURED_FACES if self.texture else BROWSER_FACES
        self.surface = replace(
            self.surface,
            faces=faces if options.faces is None else options.faces,
            colors=self.surface.colors and set(self.mesh) != {"stl"},
            watertight=options.watertight,
        )

    def suffixes(self, meshes: bool = True) -> list[str]:
        """Return the suffixes of an object's files, meshes last."""
        options = self.options
        suffixes = [splat_suffix(kind) for kind in options.splats]
        suffixes += [f".{options.turntable}"] if options.turntable != "none" else []
        suffixes += [".html"] if options.page else []
        return suffixes + (mesh_suffixes(self.mesh, self.texture) if meshes else [])

    def require(self) -> None:
        """Raise ModuleNotFoundError if a required library is not installed."""
        require_movie(self.options.turntable)
        if self.mesh:
            self.surface.require(self.texture)

    def write(
        self, item: Object, comments: Sequence[str] = (), section: Section | None = None
    ) -> tuple[str, dict[str, Any]]:
        """Write the files of one object, without the Gaussians that are never drawn.

        Args:
            item: the object.
            comments: lines for the header of a ``.ply``.
            section: of the page, completed here with the object and its turntable.

        Returns:
            A sentence with the number of Gaussians; and by name the ``files``, the number of
            ``gaussians``, the sizes of the ``mesh``, if there is one, and ``notes``, sentences
            about it and about losses of formats.

        Raises:
            UserError: a file cannot be written, no Gaussian is left, or the object has no surface.
        """
        options, base = self.options, self.options.out / item.name
        STAGES.begin("Gaussians")
        gaussians, count = to_be_written(item.gaussians, options.min_opacity)
        files = [item.name + end for end in self.suffixes()]
        figures: dict[str, Any] = {"files": files, "gaussians": gaussians.num}
        notes: list[str | None] = []
        for kind in options.splats:
            path = base.with_name(base.name + splat_suffix(kind))
            notes.append(write_gaussians(path, gaussians, kind, comments=comments))
        section = section or Section(item.name)
        section.table = [("Gaussians", f"{gaussians.num:,}"), *section.table]
        if options.turntable != "none" or options.page:
            STAGES.begin("turntable")
            shown = gaussians.in_unit(*unit_frame(gaussians)) if item.in_unit else gaussians
            section.gaussians, section.view = shown, item.view
            section.turntable = turntable_frames(
                shown.to(self.device), item.view, size=options.size, frames=options.frames
            )
            if options.turntable != "none":
                STAGES.begin(f"{options.turntable} file")
                path = base.with_name(f"{base.name}.{options.turntable}")
                save_turntable(path, section.turntable)
            self._write_page(section, meshes=False)
        if self.mesh:  # the slowest comes last, so that the rest can be viewed
            STAGES.begin("mesh")
            start = time.perf_counter()
            mesh = surface_of(gaussians, self.surface, self.device, self.texture)
            write_meshes(base, mesh, self.mesh, options.axes, options.size_mm)
            seconds = time.perf_counter() - start
            counts = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
            colors = f", texture of {self.texture} pixels" if self.texture else ""
            notes.append(f"Mesh: {counts}{colors}, {_closedness(mesh)}, {seconds:.1f} s.")
            figures["mesh"] = {
                "vertices": len(mesh.vertices),
                "faces": len(mesh.faces),
                "closed": mesh.is_watertight(),
            }
            section.mesh = None if item.in_unit else mesh
            self._write_page(section, meshes=True)
        STAGES.begin("rest")
        return count, figures | {"notes": [*filter(None, notes)]}

    def _write_page(self, section: Section, meshes: bool) -> None:
        """Write the page, if requested; with ``meshes`` it also links to these."""
        if self.options.page:
            STAGES.begin("page")
            ends = [end for end in self.suffixes(meshes) if end != ".html"]
            section.files = [section.title + end for end in ends]
            title = section.title
            write_page(self.options.out / f"{title}.html", title, [section])


@dataclass(kw_only=True)
class ReconstructionFiles(ObjectFiles):
    """Files to write for each image.

    Attributes:
        checkpoint: the model's file, named in the ``.ply``.
        about: labels and texts about the model for the page, which shows the first one; the others
            are its model card, opened by a click.
        sheet: gets a row of each image, or None.
        inputs: also write each cut-out as ``NAME-input.png``.
        thumbnails: of results with a page, by name.
    """

    checkpoint: Path
    about: Sequence[tuple[str, str]] = ()
    sheet: Sheet | None = None
    inputs: bool = False
    thumbnails: dict[str, np.ndarray] = field(default_factory=dict, init=False)

    def suffixes(self, meshes: bool = True) -> list[str]:
        """Return the suffixes of an image's files."""
        return super().suffixes(meshes) + (["-input.png"] if self.inputs else [])

    def own(self, count: int) -> list[str]:
        """Return the names of files that belong to no single one of ``count`` images."""
        return [INDEX] if self.options.page and count > 1 else []

    def write_result(self, result: Reconstruction, cut: CutOut) -> tuple[str, dict[str, Any]]:
        """Write the files of one reconstruction; arguments, result and errors as for ``write``."""
        name, options = result.name, self.options
        if self.inputs:
            save_image(options.out / f"{name}-input.png", cut.editable)
        took = ("Forward pass", f"{result.seconds:.2f} s on {self.device.type}")
        card = "\n\n".join(f"{label}: {text}" for label, text in self.about[1:])
        section = Section(name, cut.note, cut.rgba, table=[took, *self.about[:1]])
        section.details = {"Model card": card} if card else {}
        section.strip = cut.beside() if cut.warning else None
        written = self.write(result, [f"from {name} by {self.checkpoint.name}"], section)
        if self.sheet is not None:
            drawn = result.gaussians.drawn(options.min_opacity).to(self.device)
            self.sheet.add(name, cut.rgba, drawn, result.view)
        if options.page and section.turntable is not None:
            turn = section.turntable
            flat = to_uint8(composite(cut.rgba, turn.shape[1]).numpy())
            small = Image.fromarray(np.hstack([flat, turn[len(turn) // 8]]))  # rotated a little
            small.thumbnail(_SMALL)
            self.thumbnails[name] = np.asarray(small)
        return written

    def finish(self) -> None:
        """Write the sheet, and the page with links to the results, if there are several."""
        if self.sheet is not None:
            self.sheet.write()
        if len(self.thumbnails) > 1:
            title = f"{len(self.thumbnails):,} reconstructions"
            links = [Section("", links=self.thumbnails)]
            write_page(self.options.out / INDEX, title, links, "Input and result of each.")


def _closedness(mesh: Surface) -> str:
    """Describe if a mesh has holes, and how far the surface moved if they were closed."""
    if mesh.moved is not None:
        mean, most = (f"{100 * part:.2g} %" for part in mesh.moved)
        return f"closed (moved by {mean} of the longest side, {most} at most)"
    if mesh.is_watertight():
        return "closed"
    return "open (with holes where no view met a surface; --watertight closes them)"
