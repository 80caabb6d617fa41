"""``gamba data gso``: the 60 objects of the evaluation ``gso``, as views and meshes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro
from msgspec import Meta

from gamba_warp.batch import counted
from gamba_warp.files import output_folder
from gamba_warp.untrusted.ranges import ranged


@ranged
def data_gso_command(
    out: tyro.conf.Positional[Path],
    source: Path,
    size: Annotated[int, Meta(ge=8, le=4096)] = 512,
    shard: str = "0/1",
    limit: Annotated[int, Meta(ge=1, le=10**9)] | None = None,
    workers: Annotated[int, Meta(ge=0, le=1024)] = 0,
) -> int:
    """Make the evaluation "gso" of a copy of Google Scanned Objects: 60 objects, 24 views of each.

    Writes OUT/views (a dataset, all of it the test split; view 0 is the input) and OUT/meshes. What
    is there is skipped, so a run that was stopped goes on. Objects that SOURCE lacks are named;
    the exit code is then 1.

    Args:
        out: folder to make or to go on with.
        source: folder of the set: a folder or a zip of each model, as the Fuel server gives them.
        size: pixels a side; the evaluation's are 512.
        shard: i/n takes every n-th object from the i-th, for n machines.
        limit: stop after this many objects.
        workers: number of processes that render; 0 means one per core.
    """
    from gamba_warp.data import gso

    from ..data.render import parse_shard
    from .gso_views import make_views, take_models

    first, count = parse_shard(shard)
    names = gso.NAMES[first::count][:limit]
    out = output_folder(out)
    failures = take_models(source, out, names)
    made, warnings, failed = make_views(out, names, size, workers)
    for uid, lines in sorted(warnings.items()):
        print(f"warning: {uid}: {'; '.join(lines)}")
    failures |= failed
    missing = f"{len(failures)} of {len(names)} missing"
    print(f"rendered {counted(made, 'object')} into {out / 'views'}, {missing}")
    for name, reason in sorted(failures.items()):
        print(f"missing: {name}: {reason}", file=sys.stderr)
    views, meshes = out / "views", out / "meshes"
    print(f"next: gamba eval-views --protocol gso --checkpoint MODEL --data {views} --out EVAL")
    print(f"      gamba eval-geometry EVAL/gaussians {meshes} --protocol gso --data {views}")
    return 1 if failures else 0
