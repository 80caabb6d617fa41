"""Process of a group that trains repeatedly according to a plan, and records the results.

Run as ``python -m helpers.nodes.worker PLAN RESULT``. The plan is a JSON list of ``["copy", from,
to]``, done by the first process, and of ``[name, arguments by rank, largest size of a file by rank
or null]``. The result, RESULT with the rank appended, is an object of ``[code, line]`` by name.
"""

import contextlib
import json
import shutil
import sys
from pathlib import Path

import torch
import tyro

from gamba_warp.errors import UserError
from gamba_warp.train import checkpoint
from gamba_warp.train.config import TrainConfig
from gamba_warp.train.ddp import world
from gamba_warp.train.loop import train
from helpers.disk import full_at


def main() -> None:
    plan, result = map(Path, sys.argv[1:])
    torch.set_num_threads(1)
    checkpoint.KEPT = 9
    ends = {}
    with world("cpu") as place:
        if not place.main:  # as if each had its own disk: only the first can read a checkpoint
            checkpoint.read_run = None
        for name, arguments, limits in json.loads(plan.read_text()):
            if name == "copy":
                with place.raise_on_all():
                    if place.main:
                        shutil.copytree(arguments, limits)
                continue
            limit = limits[place.rank]
            full = contextlib.nullcontext() if limit is None else full_at(limit)
            kind = tyro.conf.OmitArgPrefixes[TrainConfig]
            config = tyro.cli(kind, args=arguments[place.rank])
            try:
                with full:
                    ends[name] = [train(config, place), ""]
            except UserError as error:
                ends[name] = [2, str(error)]
    result.with_name(f"{result.name}{place.rank}").write_text(json.dumps(ends))


if __name__ == "__main__":
    main()
