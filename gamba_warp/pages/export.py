"""Output files of an object, for ``gamba export`` and ``gamba reconstruct``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ..batch import STAGES, say, warn
from ..data.preprocess import composite
from ..errors import UserError
from ..files import warn_of_others
from ..formats.gaussians.files import (
    comments_of,
    read_gaussians,
    splat_kind,
    to_be_written,
    write_gaussians,
)
from ..formats.names import SPLAT_SUFFIXES, mesh_formats, splat_suffix
from ..gaussians import Gaussians
from ..images import save_image, to_uint8
from ..model.config import GambaConfig
from ..photo.cutout import CutOut
from ..surfaces.extract import Surface, unit_frame
from ..surfaces.files import mesh_suffixes, write_meshes
from ..surfaces.options import BROWSER_FACES, TEXTURE, TEXTURED_FACES, SurfaceOptions
from ..trajectories.movies import require_movie
from ..trajectories.paths import Viewpoint, set_up
from .options import FileOptions
from .page import Section, index_page, reconstruction_page
from .sheet import Sheet
from .turntable import save_turntable, turntable_frames

INDEX = "index.html"  # links to the pages of several results
_SMALL = (320, 160)  # size of its thumbnails, an input and its result, pixels
_SURFACE = SurfaceOptions(colors=True)


@dataclass(kw_only=True)
class ObjectFiles:
    """Files to write for each object.

    Attributes:
        options: the files.
        surface: options of the mesh; the number of faces follows from ``options``.
        texture: side of its texture, pixels; 0: none.
        mesh: formats of the mesh.
    """

    options: FileOptions
    surface: SurfaceOptions
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
        found = [splat_suffix(kind) for kind in options.splats]
        found += [f".{options.turntable}"] if options.turntable != "none" else []
        found += [".html"] if options.page else []
        return found + (mesh_suffixes(self.mesh, self.texture) if meshes else [])

    def require(self) -> None:
        """Raise ModuleNotFoundError if a required library is not installed."""
        require_movie(self.options.turntable)
        if self.mesh:
            self.surface.require(self.texture)

    def write(
        self,
        gaussians: Gaussians,
        shown: Gaussians | None,
        view: Viewpoint,
        section: Section,
        device: torch.device,
        comments: Sequence[str],
    ) -> tuple[dict[str, Any], np.ndarray | None]:
        """Write the files of one object, ``NAME.*`` by the section's title.

        Args:
            gaussians: the object, of any size and position.
            shown: the object for turntable and viewer, at the origin in units of its longest side;
                None: ``gaussians``.
            view: of turntable and viewer.
            section: of the page, filled in here.
            device: that renders.
            comments: lines for the header of a ``.ply``.

        Returns:
            Names of the files, number of Gaussians, sizes of the mesh and sentences about it and
            about losses of formats; and the turntable ``[F, S, S, 3]`` uint8, if one was made.

        Raises:
            UserError: a file cannot be written, or the object has no surface.
        """
        options = self.options
        base, turn = options.out / section.title, None
        STAGES.begin("Gaussians")
        notes = []
        files = [section.title + end for end in self.suffixes()]
        figures: dict[str, Any] = {"files": files, "gaussians": gaussians.num}
        for kind in options.splats:
            path = base.with_name(base.name + splat_suffix(kind))
            notes.append(write_gaussians(path, gaussians, kind, comments=comments))
        if options.turntable != "none" or options.page:
            STAGES.begin("turntable")
            seen = gaussians if shown is None else shown
            turn = turntable_frames(
                seen.to(device), size=options.size, frames=options.frames, **asdict(view)
            )
            if options.turntable != "none":
                STAGES.begin(f"{options.turntable} file")
                save_turntable(base.with_name(f"{base.name}.{options.turntable}"), turn)
            section.turntable, section.gaussians = turn, seen
            self._write_page(section, meshes=False)
        if self.mesh:  # the slowest comes last, so that the rest can be viewed
            STAGES.begin("mesh")
            start = time.perf_counter()
            how = self.surface, options.frame, device, self.texture, options.size_mm
            mesh = write_meshes(base, gaussians, self.mesh, *how)
            seconds = time.perf_counter() - start
            counts = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
            colors = f", texture of {self.texture} pixels" if self.texture else ""
            notes.append(f"Mesh: {counts}{colors}, {_closedness(mesh)}, {seconds:.1f} s.")
            figures["mesh"] = {
                "vertices": len(mesh.vertices),
                "faces": len(mesh.faces),
                "closed": mesh.is_watertight(),
            }
            section.mesh = mesh if shown is None else None
            self._write_page(section, meshes=True)
        STAGES.begin("rest")
        return figures | {"notes": [*filter(None, notes)]}, turn

    def _write_page(self, section: Section, meshes: bool) -> None:
        """Write the page, if requested; with ``meshes`` it also links to these."""
        if self.options.page:
            STAGES.begin("page")
            ends = [end for end in self.suffixes(meshes) if end != ".html"]
            section.files = [section.title + end for end in ends]
            reconstruction_page(self.options.out / f"{section.title}.html", section)


def _closedness(mesh: Surface) -> str:
    """Describe if a mesh has holes, and how far the surface moved if they were closed."""
    if mesh.moved is not None:
        mean, most = (f"{100 * part:.2g} %" for part in mesh.moved)
        return f"closed (moved by {mean} of the longest side, {most} at most)"
    if mesh.is_watertight():
        return "closed"
    return "open (with holes where no view met a surface; --watertight closes them)"


@dataclass(kw_only=True)
class ExportJob(ObjectFiles):
    """Options for each input.

    Attributes:
        device: device that renders.
        view: of turntables and pages, in units of the object's longest side.
        drop_bad: leave out invalid Gaussians; else their file is refused.
    """

    device: torch.device
    view: Viewpoint = Viewpoint()
    drop_bad: bool = False


def find_gaussians(inputs: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Resolve files and folders to files of Gaussians, each once; files of a folder are sorted.

    In folders a .glb with a mesh is skipped, because commands write them next to the Gaussians. So
    are names that begin with a dot: hidden files, and unfinished ones of killed commands.

    Returns:
        The files, and the inputs that are missing or hold none, with the reason.

    Raises:
        UserError: without inputs.
    """
    files: dict[Path, None] = {}
    failures = []
    if not inputs:
        raise UserError("give at least one file of Gaussians (.ply, .splat, .spz, .glb) or folder")
    for path in inputs:
        if not path.is_dir():
            if path.exists():
                files[path] = None
            else:
                failures.append((path, "no such file"))
            continue
        inside = sorted(p for p in path.glob("[!.]*") if p.is_file())
        warn_of_others(path, inside, (*SPLAT_SUFFIXES, ".html", ".gif", ".mp4"))
        inside = [p for p in inside if p.suffix.lower() in SPLAT_SUFFIXES]
        inside = [p for p in inside if p.suffix.lower() != ".glb" or holds_gaussians(p)]
        files.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no .ply, .splat, .spz or .glb files"))
    return list(files), failures


def holds_gaussians(path: Path) -> bool:
    """Return True if a .glb holds Gaussians or is unreadable, False for a mesh."""
    try:
        return splat_kind(path) is not None
    except UserError:  # reading it gives this error
        return True


def read_with_warning(path: Path, drop_bad: bool) -> Gaussians:
    """Read a file of Gaussians for a command; print the number of dropped ones on stderr.

    Args:
        path: the file.
        drop_bad: leave out invalid Gaussians; else the file is refused.

    Raises:
        UserError: as ``read_gaussians``.
    """
    left_out: list[str] = []
    gaussians = read_gaussians(path, left_out if drop_bad else None)
    warn(path, left_out)
    return gaussians


def export(name: str, path: Path, job: ExportJob) -> dict[str, Any]:
    """Write all requested outputs of one file of Gaussians; print a line about them.

    Args:
        name: stem of the outputs.
        path: the Gaussians.
        job: options.

    Returns:
        Figures, as of ``ObjectFiles.write``.

    Raises:
        UserError: the input cannot be read, has no surface, or a file cannot be written.
    """
    gaussians, count = to_be_written(read_with_warning(path, job.drop_bad), job.options.min_opacity)
    drawn = job.options.page or job.options.turntable != "none"
    shown = gaussians.in_unit(*unit_frame(gaussians)) if drawn else gaussians
    section = Section(name, table=[("Gaussians", f"{gaussians.num:,}")], **asdict(job.view))
    figures, _ = job.write(gaussians, shown, job.view, section, job.device, comments_of(path))
    say(" ".join([f"{name}: {count}", *figures["notes"]]))
    return figures


@dataclass(kw_only=True)
class Outputs(ObjectFiles):
    """Options for each picture.

    Attributes:
        checkpoint: the model's file, named in the ``.ply``.
        about: labels and texts about the model for the page, which shows the first one; the others
            are its model card, opened by a click.
        sheet: gets a row of each picture, or None.
        camera: distance and field of view, degrees, of the camera of turntable, sheet and viewer;
            None for the model's.
        inputs: also write each cut-out as ``NAME-input.png``.
        made: thumbnails of results with a page, by name.
    """

    surface: SurfaceOptions = _SURFACE
    checkpoint: Path
    about: Sequence[tuple[str, str]] = ()
    sheet: Sheet | None = None
    camera: tuple[float | None, float | None] = (None, None)
    inputs: bool = False
    made: dict[str, np.ndarray] = field(default_factory=dict, init=False)

    def suffixes(self, meshes: bool = True) -> list[str]:
        """Return the suffixes of a picture's files."""
        return super().suffixes(meshes) + (["-input.png"] if self.inputs else [])

    def own(self, count: int) -> list[str]:
        """Return the names of files that belong to no single picture."""
        return [INDEX] if self.options.page and count > 1 else []

    def write_index(self) -> None:
        """Write the page with links to the results, if there are several."""
        if len(self.made) > 1:
            title = f"{len(self.made):,} reconstructions"
            index_page(self.options.out / INDEX, title, self.made)

    def view(self, config: GambaConfig, elevation: float) -> Viewpoint:
        """Return the viewpoint of turntable, sheet and viewer: the input's with the options."""
        return Viewpoint(elevation, config.distance, config.fov).changed(None, *self.camera)


def write_outputs(
    name: str,
    cut: CutOut,
    gaussians: Gaussians,
    outputs: Outputs,
    view: Viewpoint,
    seconds: float,
) -> dict[str, Any]:
    """Write all requested outputs of one reconstruction, as ``NAME.*`` in the folder.

    Args:
        name: stem of the files.
        cut: the cut-out object.
        gaussians: ``[N]``, on the device that renders the turntable.
        outputs: options.
        view: result of ``outputs.view``; by its elevation the outputs are set upright.
        seconds: run time of the model.

    Returns:
        Figures, as of ``ObjectFiles.write``.

    Raises:
        UserError: a file cannot be written, or all Gaussians are invalid.
    """
    gaussians, count = to_be_written(gaussians, outputs.options.min_opacity)
    gaussians = set_up(gaussians, view.elevation)
    if outputs.inputs:
        save_image(outputs.options.out / f"{name}-input.png", cut.editable)
    device = gaussians.means.device
    took = ("Forward pass", f"{seconds:.2f} s on {device.type}")
    table = [("Gaussians", f"{gaussians.num:,}"), took, *outputs.about[:1]]
    card = "\n\n".join(f"{label}: {text}" for label, text in outputs.about[1:])
    details = {"Model card": card} if card else {}
    section = Section(name, cut.note, cut.rgba, table=table, details=details, **asdict(view))
    if cut.warning:
        section.strip = cut.beside()
    comments = [f"from {name} by {outputs.checkpoint.name}"]
    figures, turn = outputs.write(gaussians, None, view, section, device, comments)
    for line in (f"{name}: {count}", *figures["notes"]):
        say(line)
    if outputs.sheet is not None:
        outputs.sheet.add(name, cut.rgba, gaussians, view)
    if outputs.options.page and turn is not None:
        flat = to_uint8(composite(cut.rgba, turn.shape[1]).numpy())
        small = Image.fromarray(np.hstack([flat, turn[len(turn) // 8]]))  # rotated a little
        small.thumbnail(_SMALL)
        outputs.made[name] = np.asarray(small)
    return figures
