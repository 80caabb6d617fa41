"""All that ``gamba export`` writes of one file of Gaussians."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from ..errors import UserError
from ..formats.glb import save_glb
from ..formats.ply import Frame, load_ply, save_ply
from ..formats.splat import save_splat
from ..gaussians import Gaussians
from ..surfaces.extract import SurfaceOptions, moved_to_unit, unit_frame
from ..surfaces.files import MeshFormat, write_meshes
from .page import Section, reconstruction_page
from .turntable import save_turntable, turntable_frames

Format = Literal["ply", "splat", "glb", "html", "gif", "mp4"]


@dataclass
class Job:
    """What to write for each input.

    Attributes:
        folder: where.
        mesh: formats of the mesh.
        formats: of the Gaussians, pages and turntables.
        surface: how the mesh is made.
        frame: axes of ``.ply, .obj, .stl``.
        min_opacity: fainter Gaussians are left out.
        size: side of the turntable's frames, pixels.
        frames: views of one turn.
        device: where to render.
    """

    folder: Path
    mesh: tuple[MeshFormat, ...]
    formats: tuple[Format, ...]
    surface: SurfaceOptions
    frame: Frame
    min_opacity: float
    size: int
    frames: int
    device: torch.device


def find_gaussians(inputs: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Files as they are given, each once; of a folder, the .ply files in it, sorted.

    Returns:
        The files, and the folders that hold none or cannot be read, with the reason.
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
        inside = sorted(p for p in path.iterdir() if p.suffix.lower() == ".ply")
        files.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no .ply files"))
    return list(files), failures


def export(name: str, path: Path, job: Job) -> str:
    """Writes everything that was asked for of one file of Gaussians; returns a line about it.

    Raises:
        UserError: the input cannot be read, has no surface, or would be overwritten.
    """
    targets = [job.folder / f"{name}-mesh.{kind}" for kind in job.mesh]
    targets += [job.folder / f"{name}.{kind}" for kind in job.formats]
    for target in targets:
        if target.exists() and target.samefile(path):
            raise UserError(f"{path}: would be overwritten; give another --out")
    gaussians = load_ply(path)
    gaussians = gaussians.select(gaussians.opacities >= job.min_opacity)
    if gaussians.num == 0:
        raise UserError(f"no Gaussian has an opacity of {job.min_opacity:g} or more")
    for kind in job.formats:
        target = job.folder / f"{name}.{kind}"
        if kind == "ply":
            save_ply(target, gaussians, frame=job.frame)
        elif kind in ("splat", "glb"):
            {"splat": save_splat, "glb": save_glb}[kind](target, gaussians)
    _write_pictures(name, gaussians, job)
    if not job.mesh:
        return f"{name}: {gaussians.num:,} Gaussians"
    start = time.perf_counter()
    found = write_meshes(job.folder / name, gaussians, job.mesh, job.surface, job.frame, job.device)
    closed = "closed" if found.is_closed() else "open"
    counts = f"{len(found.vertices):,} vertices, {len(found.faces):,} faces, {closed}"
    return f"{name}: {counts}, {time.perf_counter() - start:.1f} s"


def _write_pictures(name: str, gaussians: Gaussians, job: Job) -> None:
    """The page and the turntables, of the object at the origin with longest side 1."""
    kinds = [kind for kind in job.formats if kind in ("html", "gif", "mp4")]
    if not kinds:
        return
    moved = moved_to_unit(gaussians, *unit_frame(gaussians)).to(job.device)
    turn = turntable_frames(moved, size=job.size, frames=job.frames)
    for kind in kinds:
        target = job.folder / f"{name}.{kind}"
        if kind != "html":
            save_turntable(target, turn)
            continue
        table = [("Gaussians", f"{gaussians.num:,}")]
        reconstruction_page(target, Section(name, turntable=turn, gaussians=moved, table=table))
