"""Mesh files to posed RGBA views, as ``gamba_warp.data.dataset`` reads them.

The world of the views is z-up, the object's bounding box is centred in it, its longest side is 1.
``applied_transform`` and ``applied_scale`` in ``transforms.json`` say how the file's points got
there: ``x_world = applied_scale · (applied_transform · [x_file, 1])``.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from PIL import Image

from gamba_warp.batch import progress_bar
from gamba_warp.cameras import intrinsics
from gamba_warp.data import gso
from gamba_warp.data.dataset import write_split
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_folder, write_json
from gamba_warp.formats.catalogue import Mesh
from gamba_warp.formats.meshes import default_up, load_mesh
from gamba_warp.images import to_uint8
from gamba_warp.untrusted.children import Failed, run_each
from gamba_warp.untrusted.documents import read_document
from gamba_warp.untrusted.names import plain_name

from .poses import ring_poses, sample_poses
from .raycast import Lights, RayCaster
from .settings import Settings

DEPTH_UNIT = 1e-4  # object units; 16 bits then reach 6.5


def render_object(mesh: Mesh, out: Path, settings: Settings) -> list[str]:
    """Renders one object into ``out/<uid>``, which appears only when complete.

    The same mesh, uid and settings give the same files, whatever else is rendered beside it.

    Returns:
        What was missing in the mesh's files and replaced.

    Raises:
        UserError: the mesh cannot be read, or the folder cannot be written.
    """
    up = default_up(mesh.path) if settings.up == "auto" else settings.up
    digest = hashlib.sha256(f"{settings.seed} {mesh.uid}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    # From a source of its own, so that views without these changes stay what they were.
    stretch, fov = settings.drawn(np.random.default_rng(int.from_bytes(digest[8:16], "big")))
    turn = np.diag(stretch) @ (np.eye(3) if mesh.rotation is None else np.array(mesh.rotation))
    model, transform, scale = load_mesh(mesh.path).normalized(up, turn)
    caster = RayCaster(model, Lights.sample(rng, settings.light == "varied"))
    used = model.vertices[np.unique(model.faces)]
    if settings.poses == "gso":
        poses = ring_poses(used, fov, gso.ELEVATIONS, gso.AZIMUTHS)[: settings.views]
    else:
        poses = sample_poses(used, settings.views, fov, rng, settings.fronts, settings.spread)
    plain_name(mesh.uid, str(mesh.path))
    suffix, options = "webp", {"lossless": True, "method": 2, "quality": 50}
    if settings.format == "png":
        suffix, options = "png", {}
    with atomic_folder(out / mesh.uid) as part:
        frames = []
        for index, pose in enumerate(poses):
            picture, depth = caster.render(pose, settings.size, fov)
            frame = {"file_path": f"{index:03d}.{suffix}", "transform_matrix": pose.tolist()}
            Image.fromarray(to_uint8(picture)).save(part / frame["file_path"], **options)
            if settings.depth:
                backs = caster.last_depth(pose, settings.size, fov)
                for which, values in (("depth", depth), ("back", backs)):
                    steps = np.clip(np.rint(values / DEPTH_UNIT), 0, 65535).astype(np.uint16)
                    frame[f"{which}_file_path"] = f"{index:03d}_{which}.png"
                    Image.fromarray(steps).save(part / frame[f"{which}_file_path"])
            frames.append(frame)
        K = intrinsics(settings.size, settings.size, fov).double()
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
    return model.warnings


def still_missing(
    meshes: Sequence[Mesh], out: Path, settings: Settings
) -> tuple[list[Mesh], dict[str, str]]:
    """The objects that are not in the dataset ``out`` yet; and, by uid, those damaged there.

    Raises:
        UserError: an object in it was rendered with other settings.
    """
    missing: list[Mesh] = []
    damaged: dict[str, str] = {}
    for mesh in meshes:
        path = out / mesh.uid / "transforms.json"
        if not path.exists():
            missing.append(mesh)
            continue
        try:
            stored = read_document(path, _Stored).settings
        except UserError as error:
            damaged[mesh.uid] = f"{error}; remove {path.parent} to render it again"
            continue
        if stored is None or _UNNAMED | stored != vars(settings):
            raise UserError(
                f"{path}: was rendered with other settings ({stored}); choose another --out"
            )
    return missing, damaged


# Sets that were made before these settings existed do not name them.
_UNNAMED = {f.name: f.default for f in fields(Settings) if f.default is not MISSING}


class _Stored(msgspec.Struct):
    """What a rendered object's ``transforms.json`` says of how it was made."""

    settings: dict[str, Any] | None = None
    group: str | None = None


def render_meshes(
    meshes: Sequence[Mesh],
    out: Path,
    settings: Settings,
    workers: int,
    groups: Mapping[str, str] | None = None,
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Renders objects into a dataset, with a progress bar, and writes its split anew.

    Args:
        meshes: the objects.
        out: the dataset's folder, which is there.
        settings: what decides the pixels.
        workers: processes; 0 means one per core.
        groups: the groups of objects that are there already, by uid, where they are other ones
            than when these were rendered; None: they are not.

    Returns:
        By uid, what was missing in the files of a mesh and replaced; and by uid, why an object
        could not be rendered.
    """
    warnings: dict[str, list[str]] = {}
    failures: dict[str, str] = {}
    workers = min(workers or os.cpu_count() or 1, len(meshes))
    threads = 1 if workers > 1 else torch.get_num_threads()
    attempt = partial(_attempt, out=out, settings=settings, threads=threads)
    found = run_each(attempt, meshes, workers=workers)
    for index, result in progress_bar(found, total=len(meshes), unit="object"):
        mesh = meshes[index]
        if isinstance(result, Failed):
            failures[mesh.uid] = f"{mesh.path}: {result.reason}"
        elif isinstance(result, str):
            failures[mesh.uid] = result
        elif result:
            warnings[mesh.uid] = result
    stored = {}
    for path in sorted(out.glob("[!.]*/transforms.json")):
        with suppress(UserError):  # readers of the dataset say so, each time
            stored[path.parent.name] = read_document(path, _Stored).group or path.parent.name
    changed = {uid: group for uid, group in (groups or {}).items() if uid in stored}
    write_split(out, stored | changed)
    return warnings, failures


def _attempt(mesh: Mesh, out: Path, settings: Settings, threads: int) -> list[str] | str:
    """In a child process: the mesh's warnings, or the reason why it failed."""
    torch.set_num_threads(threads)
    try:
        return render_object(mesh, out, settings)
    except UserError as error:
        return str(error)
    except MemoryError:
        return f"{mesh.path}: not enough memory"
    except Exception as error:  # one odd file must not stop the others
        return f"{mesh.path}: {type(error).__name__}: {error}"
