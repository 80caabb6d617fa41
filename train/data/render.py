"""Mesh files to posed RGBA views, as ``gamba_warp.data.dataset`` reads them.

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
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from gamba_warp.cameras import intrinsics
from gamba_warp.data.dataset import write_split
from gamba_warp.data.layouts import read_json
from gamba_warp.errors import UserError
from gamba_warp.files import write_json
from gamba_warp.formats.meshes import SUFFIXES, default_up, load_mesh
from gamba_warp.images import to_uint8

from .poses import sample_poses
from .raycast import Lights, RayCaster

CATALOGUE = "catalogue.json"  # beside the meshes: names and attribution, see ``find_meshes``
DEPTH_UNIT = 1e-4  # object units; 16 bits then reach 6.5


@dataclass(frozen=True)
class Mesh:
    """One object to render.

    Attributes:
        path: its file.
        uid: its folder in the dataset.
        name: what it is called.
        group: name of the objects that belong on one side of a split.
        attribution: who made it, and under which licence.
        rotation: ``[3, 3]``, turns the file's points upright first, or None.
    """

    path: Path
    uid: str
    name: str
    group: str
    attribution: dict[str, str]
    rotation: list[list[float]] | None = None


@dataclass(frozen=True)
class Settings:
    """What decides the pixels; every ``transforms.json`` keeps it.

    Attributes:
        views: number of views of an object.
        size: side of the square pictures, pixels.
        fov: vertical field of view, degrees.
        seed: seed of cameras and lights.
        depth: whether depth pictures are written, too.
        format: "webp-lossless" or "png".
        up: the axis that points up in the files, "y" or "z", or "auto" by the suffix.
    """

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
        UserError: the mesh cannot be read, or the folder cannot be written.
    """
    up = default_up(mesh.path) if settings.up == "auto" else settings.up
    model, transform, scale = load_mesh(mesh.path).normalized(up, mesh.rotation)
    digest = hashlib.sha256(f"{settings.seed} {mesh.uid}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    caster = RayCaster(model, Lights.sample(rng))
    used = model.vertices[np.unique(model.faces)]
    poses = sample_poses(used, settings.views, settings.fov, rng)
    # The name is always the same, so that runs that are killed leave no more than one folder.
    part = out / f".{mesh.uid}.part"
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


def still_missing(meshes: Sequence[Mesh], out: Path, settings: Settings) -> list[Mesh]:
    """The objects that are not in the dataset ``out`` yet.

    Raises:
        UserError: an object in it was rendered with other settings.
    """
    return [mesh for mesh in meshes if not _is_done(out / mesh.uid, settings)]


def render_meshes(
    meshes: Sequence[Mesh], out: Path, settings: Settings, workers: int
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Renders objects into a dataset, with a progress bar, and writes its split anew.

    Args:
        meshes: the objects.
        out: the dataset's folder, which is there.
        settings: what decides the pixels.
        workers: processes; 0 means one per core.

    Returns:
        By uid, what was missing in the files of a mesh and replaced; and by uid, why an object
        could not be rendered.
    """
    warnings: dict[str, list[str]] = {}
    failures: dict[str, str] = {}
    found = _run(meshes, out, settings, workers)
    for mesh, result in tqdm(found, total=len(meshes), unit="object"):
        if isinstance(result, str):
            failures[mesh.uid] = result
        elif result:
            warnings[mesh.uid] = result
    write_split(out, _groups(out))
    return warnings, failures


def check_options(settings: Settings, workers: int, limit: int | None) -> None:
    """Checks the options' ranges.

    Raises:
        UserError: an option is out of its range.
    """
    for name, value, low, high in (
        ("--views", settings.views, 1, 10_000),
        ("--size", settings.size, 8, 4096),
        ("--fov", settings.fov, 5, 120),
        ("--workers", workers, 0, 1024),
        ("--limit", 1 if limit is None else limit, 1, 10**9),
    ):
        if not low <= value <= high:
            raise UserError(f"{name} {value}: must be {low} to {high}")


def parse_shard(shard: str) -> tuple[int, int]:
    """The numbers i and n of ``i/n``.

    Raises:
        UserError: it is not of that form, or not 0 <= i < n.
    """
    match = re.fullmatch(r"(\d+)/(\d+)", shard)
    if not match or not int(match[1]) < int(match[2]):
        raise UserError(f"--shard {shard}: expected i/n with 0 <= i < n, such as 0/4")
    return int(match[1]), int(match[2])


def _is_done(folder: Path, settings: Settings) -> bool:
    """Whether the object is there. With other settings it is refused, so that none are mixed."""
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
    """The group of each object that is there, by uid."""
    found = sorted(out.glob("[!.]*/transforms.json"))
    return {path.parent.name: read_json(path).get("group", path.parent.name) for path in found}


def _run(
    meshes: Sequence[Mesh], out: Path, settings: Settings, workers: int
) -> Iterator[tuple[Mesh, list[str] | str]]:
    """Yields each mesh with its warnings, or with the reason why it failed, when it is ready."""
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
