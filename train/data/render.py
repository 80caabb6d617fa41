"""`gamba data render`: mesh files to posed RGBA views, as ``gamba_warp.data.dataset`` reads them.

The world of the views is z-up, the object's bounding box is centred in it, its longest side is 1.
``applied_transform`` and ``applied_scale`` in ``transforms.json`` say how the file's points got
there: ``x_world = applied_scale · (applied_transform · [x_file, 1])``.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import re
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from PIL import Image
from tqdm import tqdm

from gamba_warp.cameras import intrinsics
from gamba_warp.conventions import DEFAULT_FOV
from gamba_warp.data.dataset import write_split
from gamba_warp.data.layouts import read_json
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder, write_json
from gamba_warp.formats.meshes import SUFFIXES, default_up, load_mesh
from gamba_warp.images import to_uint8

from .poses import sample_poses
from .raycast import Lights, RayCaster

CATALOGUE = "catalogue.json"  # beside the meshes: names and attribution, see ``find_meshes``
DEPTH_UNIT = 1e-4  # object units; 16 bits then reach 6.5


@dataclass(frozen=True)
class Mesh:
    """One object to render: its file, its name in the dataset, and what is known of it."""

    path: Path
    uid: str
    name: str
    group: str
    attribution: dict[str, str]
    rotation: list[list[float]] | None = None  # turns the file's points upright first


@dataclass(frozen=True)
class Settings:
    """What decides the pixels; kept in every ``transforms.json``."""

    views: int
    size: int
    fov: float
    seed: int
    depth: bool
    format: str
    up: str


def find_meshes(folder: Path) -> list[Mesh]:
    """All mesh files under a folder, sorted by uid.

    ``catalogue.json`` in the folder, if there, has ``objects``: a list of ``model`` (path in the
    folder), ``uid``, ``name``, ``group`` (of variants that belong on one side of a split) and
    ``attribution``. Other meshes are named by their path.

    Raises:
        UserError: no such folder, no meshes, a bad catalogue, or two objects with one uid.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder")
    catalogue = folder / CATALOGUE
    entries = read_json(catalogue).get("objects", []) if catalogue.exists() else []
    if not all(isinstance(e, dict) and "model" in e and "uid" in e for e in entries):
        raise UserError(f"{catalogue}: each of its objects needs a model and a uid")
    known = {entry["model"]: entry for entry in entries}
    meshes: dict[str, Mesh] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in SUFFIXES or not path.is_file():
            continue
        relative = path.relative_to(folder)
        if any(part.startswith(".") for part in relative.parts):
            continue
        entry = known.get(relative.as_posix(), {})
        uid = str(entry.get("uid") or _uid(relative))
        if uid in meshes and not entry:
            uid = f"{uid}-{path.suffix[1:].lower()}"
        if uid in meshes:
            raise UserError(f"{path} and {meshes[uid].path} would both be '{uid}'")
        name, group = str(entry.get("name") or path.stem), str(entry.get("group") or uid)
        known_of = entry.get("attribution") or {}
        meshes[uid] = Mesh(path, uid, name, group, known_of, entry.get("rotation"))
    if not meshes:
        raise UserError(f"{folder}: no mesh files ({', '.join(SUFFIXES)})")
    return [meshes[uid] for uid in sorted(meshes)]


def _uid(relative: Path) -> str:
    """A folder's name from a path; ``chair/chair.obj`` is just ``chair``."""
    parts = list(relative.with_suffix("").parts)
    if len(parts) > 1 and parts[-1] == parts[-2]:
        parts.pop()
    return re.sub(r"[^\w.-]+", "_", "-".join(parts)).lstrip(".")


def render_object(mesh: Mesh, out: Path, settings: Settings) -> list[str]:
    """Renders one object into ``out/<uid>``, which appears only when complete.

    The same mesh, uid and settings give the same files, whatever else is rendered beside it.

    Returns:
        What was missing in the mesh's files and replaced.

    Raises:
        UserError: the mesh cannot be read, or the folder not be written.
    """
    up = default_up(mesh.path) if settings.up == "auto" else settings.up
    model, transform, scale = load_mesh(mesh.path).normalized(up, mesh.rotation)
    digest = hashlib.sha256(f"{settings.seed} {mesh.uid}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    caster = RayCaster(model, Lights.sample(rng))
    used = model.vertices[np.unique(model.faces)]
    poses = sample_poses(used, settings.views, settings.fov, rng)
    part = out / f".{mesh.uid}.part"  # the name of one object's, so that no debris can gather
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        frames = [_write_view(caster, pose, i, part, settings) for i, pose in enumerate(poses)]
        K = intrinsics(settings.size, settings.size, settings.fov).double()
        values = {
            "uid": mesh.uid,
            "name": mesh.name,
            "group": mesh.group,
            "attribution": mesh.attribution,
            "w": settings.size,
            "h": settings.size,
            "fl_x": K[0, 0].item(),
            "fl_y": K[1, 1].item(),
            "cx": K[0, 2].item(),
            "cy": K[1, 2].item(),
            "up": "z",
            "applied_transform": transform.tolist(),
            "applied_scale": scale,
            "warnings": model.warnings,
            "settings": vars(settings),
            "frames": frames,
        }
        if settings.depth:
            values["depth_unit"] = DEPTH_UNIT
        write_json(part / "transforms.json", values)
        os.replace(part, out / mesh.uid)
    except OSError as error:
        raise UserError(f"cannot write {out / mesh.uid}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return model.warnings


def _write_view(
    caster: RayCaster, pose: np.ndarray, index: int, folder: Path, settings: Settings
) -> dict:
    picture, depth = caster.render(pose, settings.size, settings.fov)
    suffix = "png" if settings.format == "png" else "webp"
    options = {} if suffix == "png" else {"lossless": True, "method": 2, "quality": 50}
    name = f"{index:03d}.{suffix}"
    Image.fromarray(to_uint8(picture)).save(folder / name, **options)
    frame = {"file_path": name, "transform_matrix": pose.tolist()}
    if settings.depth:
        steps = np.clip(np.rint(depth / DEPTH_UNIT), 0, 65535).astype(np.uint16)
        frame["depth_file_path"] = f"{index:03d}_depth.png"
        Image.fromarray(steps).save(folder / frame["depth_file_path"])
    return frame


def render_command(
    folder: tyro.conf.Positional[Path],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    views: int = 24,
    size: int = 128,
    fov: float = DEFAULT_FOV,
    seed: int = 0,
    depth: bool = False,
    format: Literal["webp-lossless", "png"] = "webp-lossless",
    up: Literal["auto", "y", "z"] = "auto",
    shard: str = "0/1",
    limit: int | None = None,
    workers: int = 0,
) -> int:
    """Render posed RGBA views of every mesh in a folder (.obj .glb .gltf .ply .stl .off).

    Objects that are already there are skipped, so a run that was stopped goes on where it was.

    Args:
        folder: meshes, at any depth; a catalogue.json in it may give names and attribution.
        out: the dataset to make or to go on with.
        views: per object; view 0 is from the front.
        size: pixels a side.
        fov: vertical field of view, degrees.
        seed: of cameras and lights; each object's also depend on its uid.
        depth: also write 16-bit depth pictures.
        format: of the pictures; both are lossless.
        up: the axis that points up in the files; auto: y for .obj, .glb and .gltf, z for others.
        shard: i/n renders every n-th object from the i-th, for n machines.
        limit: stop after this many objects.
        workers: processes; 0 means one per core.
    """
    settings = Settings(views, size, fov, seed, depth, format, up)
    _check(settings, workers, limit)
    meshes = find_meshes(folder)
    first, count = _parse_shard(shard)
    meshes = meshes[first::count][:limit]
    out = output_folder(out)
    todo = [mesh for mesh in meshes if not _is_done(out / mesh.uid, settings)]
    if len(todo) < len(meshes):
        print(f"{len(meshes) - len(todo)} of {len(meshes)} objects are already in {out}")
    failures, warnings = {}, {}
    for mesh, result in tqdm(_run(todo, out, settings, workers), total=len(todo), unit="object"):
        if isinstance(result, str):
            failures[mesh.uid] = result
        elif result:
            warnings[mesh.uid] = result
    write_split(out, _groups(out))
    for uid, lines in sorted(warnings.items()):
        print(f"warning: {uid}: {'; '.join(lines)}")
    print(f"rendered {len(todo) - len(failures)} objects into {out}, {len(failures)} failed")
    for uid, reason in sorted(failures.items()):
        print(f"failed: {uid}: {reason}", file=sys.stderr)
    return 1 if failures else 0


def _check(settings: Settings, workers: int, limit: int | None) -> None:
    for name, value, low, high in (
        ("--views", settings.views, 1, 10_000),
        ("--size", settings.size, 8, 4096),
        ("--fov", settings.fov, 5, 120),
        ("--workers", workers, 0, 1024),
        ("--limit", 1 if limit is None else limit, 1, 10**9),
    ):
        if not low <= value <= high:
            raise UserError(f"{name} {value}: must be {low} to {high}")


def _parse_shard(shard: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", shard)
    if not match or not int(match[1]) < int(match[2]):
        raise UserError(f"--shard {shard}: expected i/n with 0 <= i < n, such as 0/4")
    return int(match[1]), int(match[2])


def _is_done(folder: Path, settings: Settings) -> bool:
    """Whether the object is there; other settings than ours are an error, not a silent mix."""
    path = folder / "transforms.json"
    if not path.exists():
        return False
    stored = read_json(path).get("settings")
    if stored != vars(settings):
        raise UserError(
            f"{path}: was rendered with other settings ({stored}); choose another --out"
        )
    return True


def _groups(out: Path) -> dict[str, str]:
    """Groups by uid, of all the objects that are there."""
    found = sorted(out.glob("[!.]*/transforms.json"))
    return {path.parent.name: read_json(path).get("group", path.parent.name) for path in found}


def _run(
    meshes: list[Mesh], out: Path, settings: Settings, workers: int
) -> Iterator[tuple[Mesh, list[str] | str]]:
    """(mesh, warnings or the reason why it failed), as they are ready."""
    workers = min(workers or os.cpu_count() or 1, len(meshes))
    if workers <= 1:
        for mesh in meshes:
            yield mesh, _attempt(mesh, out, settings)
        return
    context = multiprocessing.get_context("spawn")  # Open3D's threads do not survive a fork
    with ProcessPoolExecutor(workers, context, initializer=_start_worker) as pool:
        waiting = {pool.submit(_attempt, mesh, out, settings): mesh for mesh in meshes}
        try:
            for future in as_completed(waiting):
                try:
                    yield waiting[future], future.result()
                except BrokenProcessPool:
                    yield waiting[future], "not rendered: a worker process died; run again"
        finally:
            pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    import torch

    torch.set_num_threads(1)


def _attempt(mesh: Mesh, out: Path, settings: Settings) -> list[str] | str:
    try:
        return render_object(mesh, out, settings)
    except UserError as error:
        return str(error)
    except MemoryError:
        return f"{mesh.path}: not enough memory"
    except Exception as error:  # one odd file must not stop the others
        return f"{mesh.path}: {type(error).__name__}: {error}"
