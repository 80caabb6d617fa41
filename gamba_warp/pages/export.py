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
from ..formats.glb import save_glb
from ..formats.names import ExportFormat, MeshFormat
from ..formats.ply import load_ply, save_ply
from ..formats.splat import save_splat
from ..gaussians import Gaussians
from ..surfaces.extract import moved_to_unit, unit_frame
from ..surfaces.files import write_meshes
from ..surfaces.options import SurfaceOptions
from ..trajectories.paths import Viewpoint
from .page import Section, reconstruction_page
from .turntable import save_turntable, turntable_frames


@dataclass
class ExportJob:
    """What to write for each input.

    Attributes:
        folder: folder of the results.
        mesh: formats of the mesh.
        formats: formats of the Gaussians, of pages and of turntables.
        surface: how the mesh is made.
        axes: axes of ``.ply, .obj, .stl``.
        min_opacity: fainter Gaussians are left out.
        size: side of the turntable's frames, pixels.
        frames: views of one turn.
        device: device that renders.
        view: from where turntables and pages look, in units of the object's longest side.
    """

    folder: Path
    mesh: tuple[MeshFormat, ...]
    formats: tuple[ExportFormat, ...]
    surface: SurfaceOptions
    axes: Axes
    min_opacity: float
    size: int
    frames: int
    device: torch.device
    view: Viewpoint = Viewpoint()

    def suffixes(self) -> list[str]:
        """What follows the name of an input in each of its files."""
        return [f"-mesh.{kind}" for kind in self.mesh] + [f".{kind}" for kind in self.formats]


def find_gaussians(inputs: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Files as they are given, each once; of a folder, the .ply files in it, sorted.

    Names that begin with a dot are passed over: other programs hide files by it, and it marks what
    a killed command left unfinished.

    Returns:
        The files, and the inputs that are missing or hold none, with the reason.

    Raises:
        UserError: there is no input.
    """
    files: dict[Path, None] = {}
    failures = []
    if not inputs:
        raise UserError("give at least one .ply file or folder")
    for path in inputs:
        if not path.is_dir():
            if path.exists():
                files[path] = None
            else:
                failures.append((path, "no such file"))
            continue
        inside = sorted(p for p in path.glob("[!.]*") if p.suffix.lower() == ".ply")
        files.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no .ply files"))
    return list(files), failures


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
    gaussians = load_ply(path)
    gaussians = gaussians.select(gaussians.opacities >= job.min_opacity)
    if gaussians.num == 0:
        raise UserError(f"no Gaussian has an opacity of {job.min_opacity:g} or more")
    for kind in job.formats:
        target = job.folder / f"{name}.{kind}"
        if kind == "ply":
            save_ply(target, gaussians, axes=job.axes)
        elif kind in ("splat", "glb"):
            {"splat": save_splat, "glb": save_glb}[kind](target, gaussians)
    _write_pictures(name, gaussians, job)
    if not job.mesh:
        return f"{name}: {gaussians.num:,} Gaussians"
    start = time.perf_counter()
    found = write_meshes(job.folder / name, gaussians, job.mesh, job.surface, job.axes, job.device)
    closed = "closed" if found.is_watertight() else "open"
    counts = f"{len(found.vertices):,} vertices, {len(found.faces):,} faces, {closed}"
    return f"{name}: {counts}, {time.perf_counter() - start:.1f} s"


def _write_pictures(name: str, gaussians: Gaussians, job: ExportJob) -> None:
    """The page and the turntables, of the object at the origin with longest side 1."""
    kinds = [kind for kind in job.formats if kind in ("html", "gif", "mp4")]
    if not kinds:
        return
    moved = moved_to_unit(gaussians, *unit_frame(gaussians)).to(job.device)
    turn = turntable_frames(moved, size=job.size, frames=job.frames, **asdict(job.view))
    for kind in kinds:
        target = job.folder / f"{name}.{kind}"
        if kind == "html":
            write_page(target, name, gaussians, turn, job.view)
        else:
            save_turntable(target, turn)


def write_page(
    path: Path,
    title: str,
    gaussians: Gaussians,
    turntable: np.ndarray | None = None,
    view: Viewpoint | None = None,
) -> None:
    """Writes a page with a 3D viewer, of an object of any size anywhere.

    Args:
        path: the .html file.
        title: heading of the page.
        gaussians: one object.
        turntable: frames ``[T, S, S, 3]`` uint8 of one turn, or None.
        view: where the viewer starts, in units of the object's longest side.

    Raises:
        UserError: the object has no extent, or the file cannot be written.
    """
    moved = moved_to_unit(gaussians, *unit_frame(gaussians))
    table = [("Gaussians", f"{gaussians.num:,}")]
    camera = asdict(view or Viewpoint())
    section = Section(title, turntable=turntable, gaussians=moved, table=table, **camera)
    reconstruction_page(path, section)
