"""``gamba data objaverse``: G-Objaverse's views of a local copy, or Objaverse's meshes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro
from msgspec import Meta

from gamba_warp.batch import counted
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder, write_json
from gamba_warp.untrusted.ranges import ranged

_SHOWN = 20  # failures that are told one by one; the record has all


@ranged
def data_objaverse_command(
    out: tyro.conf.Positional[Path],
    source: str,
    index: Path | None = None,
    uids: tuple[Path, ...] = (),
    without: tuple[Path, ...] = (),
    quality: Path | None = None,
    min_views: Annotated[int, Meta(ge=1, le=10_000)] = 40,
    copy: bool = False,
    depth: bool = False,
    shard: str = "0/1",
    limit: Annotated[int, Meta(ge=1, le=10**9)] | None = None,
    workers: Annotated[int, Meta(ge=1, le=256)] = 1,
) -> int:
    """Make a dataset of a local copy of G-Objaverse, or download Objaverse's meshes.

    Folders are linked, tars unpacked as far as training needs them. What is there is skipped, so a
    run that was stopped goes on. OUT/objaverse.json records the choice. docs/datasets.md has the
    commands for the paper's training set.

    Args:
        out: folder to make or to go on with.
        source: folder of G-Objaverse (folders or tars); or "objaverse": meshes by that package.
        index: gobjaverse_280k_index_to_objaverse.json; lists by Objaverse's names need it.
        uids: take only what each of these lists names (lvis-annotations.json.gz, ...).
        without: take nothing that one of these lists names (gobjaverse_280k_Poor-quality.json).
        quality: category_annotation.json: leave out what it calls Poor-quality.
        min_views: complete views that an object of G-Objaverse must have; published are 40.
        copy: copy the files of folders in place of linking them.
        depth: also make depth pictures of the _nd.exr files; needs the package OpenEXR.
        shard: i/n takes every n-th object from the i-th, for n machines.
        limit: stop after this many objects.
        workers: downloads at once.
    """
    from ..data.render import parse_shard
    from .objaverse_depth import check_package
    from .objaverse_lists import Lists
    from .objaverse_meshes import PACKAGE, load_package, take_meshes
    from .objaverse_views import find_rendered, take_views

    first, count = parse_shard(shard)
    lists = Lists(index, uids, without, quality)
    meshes = source == PACKAGE
    if depth:
        check_package()
    if meshes:
        load_package()
    objects = {} if meshes else find_rendered(Path(source))
    if not meshes and out.resolve() == Path(source).resolve():
        raise UserError(f"{out}: is --source itself; choose another folder")
    chosen = lists.choose(None if meshes else objects)
    names = chosen.names[first::count][:limit]
    out = output_folder(out)
    for what, number in chosen.counts.items():
        print(f"{number:>9,} {what}")
    if meshes:
        taken, failures = take_meshes(names, out, workers)
    else:
        taken, failures = take_views(objects, names, out, min_views, copy, depth)
    mark = "" if count == 1 else f".{first}-{count}"
    known = {name: chosen.uids[name] for name in names if name in chosen.uids}
    record = {"source": source, "counts": chosen.counts, "shard": shard, "objects": len(names)}
    record |= {"objaverse": known, "left_out": failures}
    write_json(out / f"objaverse{mark}.json", record)
    there = len(names) - taken - len(failures)
    found = f"{there:,} were there, {len(failures):,} left out"
    print(f"{counted(taken, 'object')} put into {out}, {found}")
    for name, reason in list(failures.items())[:_SHOWN]:
        print(f"left out: {name}: {reason}", file=sys.stderr)
    if len(failures) > _SHOWN:
        rest = len(failures) - _SHOWN
        print(f"left out: {rest:,} more, see {out / f'objaverse{mark}.json'}", file=sys.stderr)
    following = "gamba data render {} --size 512 --out DATA" if meshes else "gamba train {} ..."
    print(f"next: {following.format(out)}")
    return 1 if failures else 0
