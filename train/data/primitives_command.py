"""``gamba data primitives``: objects of simple solids, to train on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from msgspec import Meta

from gamba_warp.untrusted.ranges import Seed, ranged


@ranged
def data_primitives_command(
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    count: Annotated[int, Meta(ge=1, le=100_000)] = 200,
    seed: Seed = 0,
) -> int:
    """Make objects of simple solids with made-up textures, free of anybody's rights (.glb).

    An object depends on the seed and its number alone; those that are there already are kept.

    Args:
        out: folder for the models and catalogue.json.
        count: number of objects.
        seed: seed of all objects.
    """
    from .primitives import make_primitives

    make_primitives(out, count, seed)
    print(f"{count} models in {out}; next: gamba data render {out} --out DATA")
    return 0
