"""``gamba data pack``: the views of a dataset, decoded and resized once, in a few large files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from gamba_warp.batch import counted
from gamba_warp.untrusted.ranges import ranged


@ranged
def data_pack_command(
    data: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    size: Annotated[int, Meta(ge=1, le=4096)] | None = 128,
    split: Literal["all", "train", "val", "test"] = "all",
    format: Literal["arrays", "webdataset"] = "arrays",
    shard_mb: Annotated[int, Meta(ge=1, le=100_000)] = 256,
    limit: Annotated[int, Meta(ge=1, le=10**9)] | None = None,
    workers: Annotated[int, Meta(ge=0, le=1024)] = 0,
) -> int:
    """Decode the views of a dataset once, and write them into a few large files.

    Every command that takes a dataset takes the pack. Its views at SIZE are those of the files, to
    the bit; larger ones are enlarged. A command that was stopped goes on with the next shard.

    Args:
        data: the dataset.
        out: folder of the pack to make or to go on with.
        size: height of the pictures, pixels; None keeps that of the files.
        split: pack only the objects of this part of the set.
        format: arrays that are mapped into memory, or WebDataset's .tar files of the same arrays.
        shard_mb: a file ends with the object that passes this size, megabytes.
        limit: stop after this many objects.
        workers: number of threads that decode; 0 means one per core.
    """
    from gamba_warp.kernels.runtime.system import cores

    from .pack import PackSettings, write_pack

    settings = PackSettings(size, split, format, shard_mb << 20)
    done = write_pack(data, out, settings, workers or cores(), limit)
    if done.there:
        print(f"{counted(done.there, 'object')} in {out} already")
    made = counted(done.written, "object"), counted(done.shards, "shard")
    print(f"packed {made[0]} into {out}, {made[1]}", end="")
    print(f", {len(done.failures)} failed")
    for uid, reason in sorted(done.failures.items()):
        print(f"failed: {uid}: {reason}", file=sys.stderr)
    return 1 if done.failures else 0
