"""``gamba export``: files of Gaussians to meshes, other splat formats, pages and turntables."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from tqdm import tqdm

from .batch import for_each, report
from .errors import UserError
from .files import output_folder
from .gaussians import Gaussians
from .gltf import save_glb
from .mesh_files import MeshFormat, write_meshes
from .page import Section, reconstruction_page
from .ply import Frame, load_ply, save_ply
from .reconstruct import pick_device, unique_names
from .splat import save_splat
from .surfaces import SurfaceOptions, moved_to_unit, unit_frame
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


def export_command(
    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")],
    /,
    out: Path = Path("out"),
    mesh: tuple[MeshFormat, ...] = ("glb",),
    formats: tuple[Format, ...] = (),
    surface: Literal["tsdf", "density"] = "tsdf",
    voxels: int = 128,
    views: int = 64,
    pixels: int = 256,
    faces: int = 0,
    colors: bool = True,
    close_holes: int = 30,
    min_component: float = 0.01,
    largest: bool = False,
    smooth: int = 0,
    frame: Frame = "opengl",
    min_opacity: float = 0.0,
    size: int = 256,
    frames: int = 48,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> int:
    """Turns files of Gaussians into meshes, other splat formats, pages and turntables.

    Meshes are NAME-mesh.FORMAT, all else is NAME.FORMAT; files of that name are replaced.

    Args:
        inputs: Gaussians (.ply in the 3DGS layout), or folders of them.
        out: Folder for the results.
        mesh: Files of the surface; give it without a value for none.
        formats: Files of the Gaussians, a page with a 3D viewer, moving pictures of one turn.
        surface: How: tsdf (fused depth of many views) or density (level set; fattens thin parts).
        voxels: Along the object's longest side.
        views: Pictures from all around, for depth and colours.
        pixels: Side of these pictures.
        faces: Simplify to at most so many; 0 keeps all.
        colors: Colours at the vertices (.stl has none).
        close_holes: Close holes with at most so many edges.
        min_component: Remove parts with a smaller share of the faces.
        largest: Keep the largest part only.
        smooth: Steps of smoothing.
        frame: Axes of all but .splat and .glb; opengl is y up, opencv y down as in the input.
        min_opacity: Leave out Gaussians fainter than this.
        size: Side of the turntable's frames in pixels.
        frames: Number of views in the turntable.
        device: Where to render.
    """
    if size < 16 or frames < 2:
        raise UserError("--size must be at least 16 and --frames at least 2")
    if not mesh and not formats:
        raise UserError("nothing to write: give --mesh or --formats")
    if not 0 <= min_component < 1:
        raise UserError("--min-component is a share, from 0 to under 1")
    options = SurfaceOptions(
        method=surface,
        voxels=voxels,
        views=views,
        pixels=pixels,
        faces=faces,
        colors=colors and set(mesh) != {"stl"},
        close_holes=close_holes,
        min_component=min_component,
        largest=largest,
        smooth=smooth,
    )
    options.check()
    files, failures = find_gaussians(inputs)
    if not files:
        raise UserError("; ".join(f"{path}: {reason}" for path, reason in failures))
    where = pick_device(device)
    job = Job(output_folder(out), mesh, formats, options, frame, min_opacity, size, frames, where)

    def one(name: str, path: Path) -> None:
        tqdm.write(export(name, path, job))

    failures += for_each(unique_names(files), one, "export", "file")
    return report(len(files), "file", failures, out)


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
