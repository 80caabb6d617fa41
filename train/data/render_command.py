"""``gamba data render``: mesh files to posed RGBA views."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from gamba_warp.batch import counted
from gamba_warp.conventions import DEFAULT_FOV
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder
from gamba_warp.untrusted.ranges import ranged


@ranged
def data_render_command(
    folder: tyro.conf.Positional[Path],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    views: Annotated[int, Meta(ge=1, le=10_000)] = 24,
    size: Annotated[int, Meta(ge=8, le=4096)] = 128,
    fov: Annotated[float, Meta(ge=5, le=120)] = DEFAULT_FOV,
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0,
    depth: bool = False,
    format: Literal["webp-lossless", "png"] = "webp-lossless",
    up: Literal["auto", "y", "z"] = "auto",
    fronts: Annotated[int, Meta(ge=0, le=10_000)] = 1,
    spread: Annotated[float, Meta(ge=0, le=10)] = 0.2,
    stretch: Annotated[float, Meta(ge=1, le=10)] = 1.0,
    fov_spread: Annotated[float, Meta(ge=1, le=4)] = 1.0,
    light: Literal["usual", "varied"] = "usual",
    split: Literal["all", "train", "val", "test"] = "all",
    shard: str = "0/1",
    limit: Annotated[int, Meta(ge=1, le=10**9)] | None = None,
    workers: Annotated[int, Meta(ge=0, le=1024)] = 0,
) -> int:
    """Render posed RGBA views of every mesh in a folder (.obj .glb .gltf .ply .stl .off).

    Objects that are already there are skipped, so a run that was stopped goes on where it was.

    Args:
        folder: meshes, at any depth; a catalogue.json in it may give names and attribution.
        out: the dataset to make or to go on with.
        views: number of views of an object.
        size: pixels a side.
        fov: vertical field of view, degrees.
        seed: seed of cameras and lights; those of an object also depend on its uid.
        depth: also write 16-bit depth pictures, of the first and of the last surface.
        format: format of the pictures; both are lossless.
        up: the axis that points up in the files; auto: y for .obj, .glb and .gltf, z for others.
        fronts: number of views from the front, the first ones.
        spread: largest share by which a camera stands further away than it must.
        stretch: stretch each object along each axis by a factor between 1 / STRETCH and STRETCH.
        fov_spread: draw each object's field of view between FOV / FOV_SPREAD and FOV * FOV_SPREAD.
        light: varied makes the lights of the objects differ more.
        split: render only the objects that lie in this part of the set.
        shard: i/n renders every n-th object from the i-th, for n machines.
        limit: stop after this many objects.
        workers: number of processes; 0 means one per core.
    """
    from gamba_warp.data.dataset import split_of
    from gamba_warp.formats.catalogue import find_meshes

    from .render import Settings, parse_shard, render_meshes, still_missing

    settings = Settings(
        views=views,
        size=size,
        fov=fov,
        seed=seed,
        depth=depth,
        format=format,
        up=up,
        fronts=fronts,
        spread=spread,
        stretch=stretch,
        fov_spread=fov_spread,
        light=light,
    )
    if fov / fov_spread < 5 or fov * fov_spread > 120:
        raise UserError(
            f"--fov-spread {fov_spread:g}: makes fields of view outside 5 to 120 degrees"
        )
    meshes = find_meshes(folder)
    groups = {mesh.uid: mesh.group for mesh in meshes}
    if split != "all":
        meshes = [mesh for mesh in meshes if split_of(mesh.group) == split]
    first, count = parse_shard(shard)
    meshes = meshes[first::count][:limit]
    out = output_folder(out)
    todo, damaged = still_missing(meshes, out, settings)
    if done := len(meshes) - len(todo) - len(damaged):
        print(f"{done} of {counted(len(meshes), 'object')} already in {out}")
    warnings, failures = render_meshes(todo, out, settings, workers, groups)
    for uid, lines in sorted(warnings.items()):
        print(f"warning: {uid}: {'; '.join(lines)}")
    rendered, failures = len(todo) - len(failures), failures | damaged
    print(f"rendered {counted(rendered, 'object')} into {out}, {len(failures)} failed")
    for uid, reason in sorted(failures.items()):
        print(f"failed: {uid}: {reason}", file=sys.stderr)
    return 1 if failures else 0
