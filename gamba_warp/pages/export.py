"""All that ``gamba export`` writes of one file of Gaussians."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

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


@dataclass
class ExportJob:
    """What to write for each input.

    Attributes:
        folder: folder of the results.
        mesh: formats of the mesh.
        splats: formats of the Gaussians.
        page: whether a page with a 3D viewer is written.
        turntable: ``gif``, ``mp4`` or ``none``.
        surface: how the mesh is made.
        texture: side of its texture, pixels; 0: none.
        axes: axes of the meshes, but of .glb.
        min_opacity: fainter Gaussians are left out; None: those that are never drawn.
        size: side of the turntable's frames, pixels.
        frames: views of one turn.
        device: device that renders.
        view: from where turntables and pages look, in units of the object's longest side.
    """

    folder: Path
    mesh: tuple[MeshFormat, ...]
    splats: tuple[SplatFormat, ...]
    page: bool
    turntable: str
    surface: SurfaceOptions
    texture: int
    axes: Axes
    min_opacity: float | None
    size: int
    frames: int
    device: torch.device
    view: Viewpoint = Viewpoint()

    def suffixes(self) -> list[str]:
        """What follows the name of an input in each of its files."""
        found = mesh_suffixes(self.mesh, self.texture)
        found += [splat_suffix(kind) for kind in self.splats]
        found += [f".{self.turntable}"] if self.turntable != "none" else []
        return found + ([".html"] if self.page else [])

    def require(self) -> None:
        """Refuses what needs a library that is not installed (ModuleNotFoundError)."""
        require_movie(self.turntable)
        if self.mesh:
            self.surface.require(self.texture)


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
        inside = [p for p in inside if p.suffix.lower() != ".glb" or not _is_mesh(p)]
        files.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no .ply, .splat, .spz or .glb files"))
    return list(files), failures


def _is_mesh(path: Path) -> bool:
    try:
        return splat_kind(path) is None
    except UserError:  # it is refused with this reason when it is read
        return False


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
    said, comments = [f"{name}: {count}"], comments_of(path)
    for kind in job.splats:
        target = job.folder / (name + splat_suffix(kind))
        said += filter(None, [write_gaussians(target, gaussians, kind, comments=comments)])
    page = job.folder / f"{name}.html"
    section = _write_pictures(page, gaussians, job)
    if not job.mesh:
        return " ".join(said)
    start = time.perf_counter()
    base, options = job.folder / name, job.surface
    found = write_meshes(base, gaussians, job.mesh, options, job.axes, job.device, job.texture)
    if section is not None:  # the page again, which leads to the meshes, too
        section.files = [*section.files, *(name + s for s in mesh_suffixes(job.mesh, job.texture))]
        reconstruction_page(page, section)
    closed = "closed" if found.is_watertight() else "open"
    counts = f"{len(found.vertices):,} vertices, {len(found.faces):,} faces, {closed}"
    seconds = time.perf_counter() - start
    return " ".join([*said, f"Mesh: {counts}, {seconds:.1f} s."])


def _write_pictures(page: Path, gaussians: Gaussians, job: ExportJob) -> Section | None:
    """The page and the turntables, of the object at the origin with longest side 1."""
    if not job.page and job.turntable == "none":
        return None
    files = [page.stem + splat_suffix(kind) for kind in job.splats]
    moved = gaussians.in_unit(*unit_frame(gaussians)).to(job.device)
    turn = turntable_frames(moved, size=job.size, frames=job.frames, **asdict(job.view))
    if job.turntable != "none":
        files.append(f"{page.stem}.{job.turntable}")
        save_turntable(page.with_name(files[-1]), turn)
    return write_page(page, page.stem, gaussians, turn, job.view, files) if job.page else None


def write_page(
    path: Path,
    title: str,
    gaussians: Gaussians,
    turntable: np.ndarray | None = None,
    view: Viewpoint | None = None,
    files: Sequence[str] = (),
) -> Section:
    """Writes a page with a 3D viewer, of an object of any size anywhere.

    Args:
        path: the .html file.
        title: heading of the page.
        gaussians: one object.
        turntable: frames ``[T, S, S, 3]`` uint8 of one turn, or None.
        view: where the viewer starts, in units of the object's longest side.
        files: names of files beside the page, which it offers for download.

    Returns:
        What is on it.

    Raises:
        UserError: the object has no extent, or the file cannot be written.
    """
    moved = gaussians.in_unit(*unit_frame(gaussians))
    table = [("Gaussians", f"{gaussians.num:,}")]
    camera = asdict(view or Viewpoint())
    section = Section(
        title, turntable=turntable, gaussians=moved, table=table, files=files, **camera
    )
    reconstruction_page(path, section)
    return section
