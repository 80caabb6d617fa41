"""Renders mesh files to posed RGBA views for ``gamba_warp.data.dataset``.

The world of the views is z-up; the object's bounding box is centred and its longest side is 1.
``applied_transform`` and ``applied_scale`` in ``transforms.json`` map the file's points to it:
``x_world = applied_scale · (applied_transform · [x_file, 1])``.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import ArrayLike
from PIL import Image

from gamba_warp.batch import progress_bar
from gamba_warp.cameras import intrinsics
from gamba_warp.data import gso
from gamba_warp.data.dataset import write_split
from gamba_warp.devices import quiet_warp
from gamba_warp.errors import UserError
from gamba_warp.files import atomic_folder, write_json
from gamba_warp.formats.catalogue import Mesh
from gamba_warp.formats.meshes import TexturedMesh, default_up, load_mesh
from gamba_warp.images import to_uint8
from gamba_warp.untrusted.children import Failed, run_each
from gamba_warp.untrusted.documents import read_document
from gamba_warp.untrusted.names import plain_name

from .poses import ring_poses, sample_poses
from .raycast import Lights, RayCaster
from .settings import Settings

DEPTH_UNIT = 1e-4  # object units; 16 bits then reach 6.5


@dataclass
class Views:
    """Images of one object, with their cameras.

    Attributes:
        images: ``[V, S, S, 4]`` uint8 RGBA, colour not premultiplied.
        poses: ``[V, 4, 4]`` float64 camera to world, OpenGL frame, object units.
        K: ``[3, 3]`` float64, pixels, of all views.
        depths: ``[V, S, S]`` uint16 depth of the first surface, in steps of ``DEPTH_UNIT``, 0
            without one; None unless the settings ask for depth.
        backs: as ``depths``, of the last surface.
        transform: ``[3, 4]``, from the file's points to the world before scaling.
        scale: object units per unit of the file.
    """

    images: np.ndarray
    poses: np.ndarray
    K: np.ndarray
    depths: np.ndarray | None
    backs: np.ndarray | None
    transform: np.ndarray
    scale: float


def draw_views(
    model: TexturedMesh, uid: str, settings: Settings, rotation: ArrayLike | None = None
) -> Views:
    """Render the views of one object; deterministic in the arguments.

    Args:
        model: the object in the file's frame; ``settings.up`` is "y" or "z".
        uid: name of the object; with the settings' seed it seeds cameras and lights.
        settings: options of the images.
        rotation: ``[3, 3]``, applied to the file's points first; None: not rotated.
    """
    digest = hashlib.sha256(f"{settings.seed} {uid}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    # A separate generator, so that views without these options stay the same.
    stretch, fov = settings.drawn(np.random.default_rng(int.from_bytes(digest[8:16], "big")))
    turn = np.diag(stretch) @ (np.eye(3) if rotation is None else np.asarray(rotation))
    model, transform, scale = model.normalized(settings.up, turn)
    caster = RayCaster(model, Lights.sample(rng, settings.light == "randomized"))
    used = model.vertices[np.unique(model.faces)]
    if settings.poses == "gso":
        poses = ring_poses(used, fov, gso.ELEVATIONS, gso.AZIMUTHS)[: settings.views]
    else:
        poses = sample_poses(used, settings.views, fov, rng, settings.fronts, settings.spread)
    size, images, depths, backs = settings.size, [], [], []
    for pose in poses:
        image, depth = caster.render(pose, size, fov)
        images.append(to_uint8(image))
        if settings.depth:
            depths.append(_steps(depth))
            backs.append(_steps(caster.last_depth(pose, size, fov)))
    near, far = (np.stack(each) if each else None for each in (depths, backs))
    K = intrinsics(size, size, fov).double().numpy()
    return Views(np.stack(images), poses, K, near, far, transform, scale)


def _steps(depth: np.ndarray) -> np.ndarray:
    """Convert depth in object units to the 16-bit steps of depth images."""
    return np.clip(np.rint(depth / DEPTH_UNIT), 0, 65535).astype(np.uint16)


def render_object(mesh: Mesh, out: Path, settings: Settings) -> list[str]:
    """Render one object into ``out/<uid>``, which appears only when complete.

    The same mesh, uid and settings give the same files, independently of other objects.

    Returns:
        Warnings about missing parts of the mesh's files that were replaced.

    Raises:
        UserError: the mesh cannot be read, no image shows it, or the folder cannot be written.
    """
    up = default_up(mesh.path) if settings.up == "auto" else settings.up
    plain_name(mesh.uid, str(mesh.path))
    model = load_mesh(mesh.path, root=mesh.root)
    views = draw_views(model, mesh.uid, replace(settings, up=up), mesh.rotation)
    if not views.images[..., 3].any():
        raise UserError(f"{mesh.path}: all views are empty")
    suffix, options = "webp", {"lossless": True, "method": 2, "quality": 50}
    if settings.format == "png":
        suffix, options = "png", {}
    with atomic_folder(out / mesh.uid) as part:
        frames = []
        for index, pose in enumerate(views.poses):
            frame = {"file_path": f"{index:03d}.{suffix}", "transform_matrix": pose.tolist()}
            Image.fromarray(views.images[index]).save(part / frame["file_path"], **options)
            for which, steps in (("depth", views.depths), ("back", views.backs)):
                if steps is not None:
                    frame[f"{which}_file_path"] = f"{index:03d}_{which}.png"
                    Image.fromarray(steps[index]).save(part / frame[f"{which}_file_path"])
            frames.append(frame)
        values = {
            "uid": mesh.uid,
            "name": mesh.name,
            "group": mesh.group,
            "attribution": mesh.attribution,
            "w": settings.size,
            "h": settings.size,
            "fl_x": views.K[0, 0],
            "fl_y": views.K[1, 1],
            "cx": views.K[0, 2],
            "cy": views.K[1, 2],
            "up": "z",
            "applied_transform": views.transform.tolist(),
            "applied_scale": views.scale,
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
    """Objects that the dataset ``out`` lacks, and by uid those that are damaged in it.

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
        light = str((stored or {}).get("light"))
        light = {"light": _OLDER_LIGHTS[light]} if light in _OLDER_LIGHTS else {}
        if stored is None or _DEFAULTS | stored | light != vars(settings):
            raise UserError(
                f"{path}: was rendered with other settings ({stored}); choose another --out"
            )
    return missing, damaged


# Defaults of settings that older datasets do not name.
_DEFAULTS = {f.name: f.default for f in fields(Settings) if f.default is not MISSING}
_OLDER_LIGHTS = {"usual": "default", "varied": "randomized"}


class _Stored(msgspec.Struct):
    """Settings and group in a rendered object's ``transforms.json``."""

    settings: dict[str, Any] | None = None
    group: str | None = None


def render_meshes(
    meshes: Sequence[Mesh],
    out: Path,
    settings: Settings,
    workers: int,
    groups: Mapping[str, str] | None = None,
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Render objects into a dataset, with a progress bar, and rewrite its split.

    Args:
        meshes: the objects.
        out: the dataset's existing folder.
        settings: options of the images.
        workers: processes; 0 means one per core.
        groups: new groups of objects rendered earlier, by uid; None to keep the stored ones.

    Returns:
        Warnings by uid, about missing parts of a mesh's files that were replaced; and failures by
        uid.
    """
    warnings: dict[str, list[str]] = {}
    failures: dict[str, str] = {}
    workers = min(workers or os.cpu_count() or 1, len(meshes))
    threads = 1 if workers > 1 else torch.get_num_threads()
    attempt = partial(_attempt, out=out, settings=settings, threads=threads)
    results = run_each(attempt, meshes, workers=workers)
    for index, result in progress_bar(results, total=len(meshes), unit="object"):
        mesh = meshes[index]
        if isinstance(result, Failed):
            failures[mesh.uid] = f"{mesh.path}: {result.reason.removeprefix(f'{mesh.path}: ')}"
        elif result:
            warnings[mesh.uid] = result
    stored = {}
    for path in sorted(out.glob("[!.]*/transforms.json")):
        with suppress(UserError):  # readers of the dataset report it
            stored[path.parent.name] = read_document(path, _Stored).group or path.parent.name
    changed = {uid: group for uid, group in (groups or {}).items() if uid in stored}
    write_split(out, stored | changed)
    return warnings, failures


def _attempt(mesh: Mesh, out: Path, settings: Settings, threads: int) -> list[str]:
    """Render in a child process; return the mesh's warnings."""
    quiet_warp()
    torch.set_num_threads(threads)
    return render_object(mesh, out, settings)
