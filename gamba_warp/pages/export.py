"""What is written of an object of Gaussians, and all that ``gamba export`` writes of a file."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from ..batch import STAGES
from ..conventions import Axes
from ..errors import UserError
from ..formats.gaussians.files import (
    comments_of,
    read_gaussians,
    splat_kind,
    to_be_written,
    write_gaussians,
)
from ..formats.names import SPLAT_SUFFIXES, MeshFormat, SplatFormat, splat_suffix
from ..gaussians import Gaussians
from ..surfaces.extract import unit_frame
from ..surfaces.files import mesh_suffixes, write_meshes
from ..surfaces.options import SurfaceOptions
from ..trajectories.movies import require_movie
from ..trajectories.paths import Viewpoint
from .page import Section, reconstruction_page
from .turntable import save_turntable, turntable_frames


@dataclass(kw_only=True)
class ObjectFiles:
    """What to write of each object.

    Attributes:
        folder: folder of the results.
        splats: formats of the Gaussians.
        mesh: formats of a mesh of the surface.
        page: whether a self-contained HTML page with a 3D viewer is written.
        turntable: ``gif``, ``mp4`` or ``none``.
        size: side of the turntable's frames, pixels.
        frames: views of one turn.
        axes: axes of the meshes, but of .glb.
        min_opacity: fainter Gaussians are left out; None: those that are never drawn.
        surface: how the mesh is made.
        texture: side of its texture, pixels; 0: none.
    """

    folder: Path
    splats: tuple[SplatFormat, ...]
    mesh: tuple[MeshFormat, ...]
    page: bool
    turntable: str
    size: int
    frames: int
    axes: Axes
    min_opacity: float | None
    surface: SurfaceOptions
    texture: int = 0

    def suffixes(self, meshes: bool = True) -> list[str]:
        """What follows the name of an object in each of its files, those of meshes the last."""
        found = [splat_suffix(kind) for kind in self.splats]
        found += [f".{self.turntable}"] if self.turntable != "none" else []
        found += [".html"] if self.page else []
        return found + (mesh_suffixes(self.mesh, self.texture) if meshes else [])

    def require(self) -> None:
        """Refuses what needs a library that is not installed (ModuleNotFoundError)."""
        require_movie(self.turntable)
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
    ) -> tuple[list[str], np.ndarray | None]:
        """Writes the files of one object, ``NAME.*`` by the section's title.

        Args:
            gaussians: the object, of any size anywhere.
            shown: the object as turntable and viewer have it, at the origin in units of its
                longest side; None: as it is.
            view: from where they look.
            section: of the page, which gets what is made here.
            device: that renders.
            comments: lines for the header of a ``.ply``.

        Returns:
            Sentences about what formats cannot hold and about the mesh, and the turntable
            ``[F, S, S, 3]`` uint8, if one was made.

        Raises:
            UserError: a file cannot be written, or the object has no surface.
        """
        base, turn = self.folder / section.title, None
        STAGES.begin("Gaussians")
        said = []
        for kind in self.splats:
            path = base.with_name(base.name + splat_suffix(kind))
            said.append(write_gaussians(path, gaussians, kind, comments=comments))
        if self.turntable != "none" or self.page:
            STAGES.begin("turntable")
            seen = gaussians if shown is None else shown
            turn = turntable_frames(
                seen.to(device), size=self.size, frames=self.frames, **asdict(view)
            )
            if self.turntable != "none":
                STAGES.begin(f"{self.turntable} file")
                save_turntable(base.with_name(f"{base.name}.{self.turntable}"), turn)
            section.turntable, section.gaussians = turn, seen
            self._write_page(section, meshes=False)
        if self.mesh:  # what takes longest comes last: all else is there to look at
            STAGES.begin("mesh")
            start = time.perf_counter()
            options = self.surface, self.axes, device, self.texture
            mesh = write_meshes(base, gaussians, self.mesh, *options)
            seconds = time.perf_counter() - start
            closed = "closed" if mesh.is_watertight() else "open"
            counts = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces, {closed}"
            said.append(f"Mesh: {counts}, {seconds:.1f} s.")
            section.mesh = mesh if shown is None else None
            self._write_page(section, meshes=True)
        STAGES.begin("rest")
        return [*filter(None, said)], turn

    def _write_page(self, section: Section, meshes: bool) -> None:
        """The page, if it is wanted; the second time it also leads to the meshes."""
        if self.page:
            STAGES.begin("page")
            ends = [end for end in self.suffixes(meshes) if end != ".html"]
            section.files = [section.title + end for end in ends]
            reconstruction_page(self.folder / f"{section.title}.html", section)


@dataclass(kw_only=True)
class ExportJob(ObjectFiles):
    """What to write for each input.

    Attributes:
        device: device that renders.
        view: from where turntables and pages look, in units of the object's longest side.
    """

    device: torch.device
    view: Viewpoint = Viewpoint()


def find_gaussians(inputs: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Files as they are given, each once; of a folder, what may hold Gaussians in it, sorted.

    A .glb that holds a mesh is passed over: the commands put them beside the Gaussians. So are
    names that begin with a dot: other programs hide files by it, and it marks what a killed command
    left unfinished.

    Returns:
        The files, and the inputs that are missing or hold none, with the reason.

    Raises:
        UserError: there is no input.
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
        inside = sorted(p for p in path.glob("[!.]*") if p.suffix.lower() in SPLAT_SUFFIXES)
        inside = [p for p in inside if p.suffix.lower() != ".glb" or holds_gaussians(p)]
        files.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no .ply, .splat, .spz or .glb files"))
    return list(files), failures


def holds_gaussians(path: Path) -> bool:
    """Whether a .glb holds Gaussians, or what cannot be told; a mesh is neither."""
    try:
        return splat_kind(path) is not None
    except UserError:  # it is refused with this reason when it is read
        return True


def export(name: str, path: Path, job: ExportJob) -> str:
    """Writes everything that was asked for of one file of Gaussians.

    Args:
        name: stem of the files that are written.
        path: the Gaussians.
        job: what to write.

    Returns:
        A line about what was written.

    Raises:
        UserError: the input cannot be read, has no surface, or a file cannot be written.
    """
    gaussians, count = to_be_written(read_gaussians(path), job.min_opacity)
    drawn = job.page or job.turntable != "none"
    shown = gaussians.in_unit(*unit_frame(gaussians)) if drawn else gaussians
    section = Section(name, table=[("Gaussians", f"{gaussians.num:,}")], **asdict(job.view))
    said, _ = job.write(gaussians, shown, job.view, section, job.device, comments_of(path))
    return " ".join([f"{name}: {count}", *said])
