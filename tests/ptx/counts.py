"""Page of the instruction counts: ``PYTHONPATH=tests python -m ptx.counts [--peers]``.

Writes docs/lab/benchmarks/counts.json, and the table of counts.md; with ``--peers`` it also counts
other libraries' kernels again. A row of ``kernels`` has ``op, kernel, case, direction, per`` (the
unit), ``number`` (warps' worth of units) and ``each`` (counts per unit).
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch
import warp as wp

from gamba_warp.files import write_json, write_text
from gamba_warp.kernels.cases.raster import LEAVES
from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.rasterize.harmonics import colors_seen_from

from . import counting, peers
from .counting import GAUSSIANS, SIDE, STATES, Counts
from .dry_run import MULTIPROCESSORS

PAGE = Path(__file__).parents[2] / "docs" / "lab" / "benchmarks" / "counts.md"
LENGTH, LANES = 16961, 32  # of the scan in the paper's model; of a warp
# The executed part of it: whole chunks, two blocks of channels; one segment, or two for several.
TOKENS, WIDTH, SEGMENTS = 1024, 128, 2
# By kernel, or for all (""), the unit of the counts: a text, and the number of units in warps.
Units = dict[str, list[tuple[str, float]]]
PER_GAUSSIAN: Units = {"": [("Gaussian, of a thread", GAUSSIANS / LANES)]}


def _scan(batch: int, dtype: torch.dtype) -> tuple[Counts, Units]:
    tuning = counting.scan_tuning(batch, LENGTH)
    parts = {x: min(getattr(tuning, x), SEGMENTS) for x in ("segments", "back_segments")}
    inputs = counting.scan_inputs(TOKENS, WIDTH, dtype)
    inputs["initial_state"] = torch.zeros(1, WIDTH, STATES, requires_grad=True)
    counted = counting.count_scan(inputs, tuning._replace(**parts), return_last_state=True)
    return counted, {"": [("(b, t, d, n), of a thread", TOKENS * WIDTH * STATES / LANES)]}


def _conv(dtype: torch.dtype) -> tuple[Counts, Units]:
    counted = counting.count_conv(TOKENS, WIDTH, dtype)
    return counted, {"": [("(b, t, d), of a thread", TOKENS * WIDTH / LANES)]}


def _raster(multiprocessors: int) -> tuple[Counts, Units]:
    """Count a view of the benchmark's shell; fewer multiprocessors give a tile fewer warps."""
    leaves, cameras = counting.scene()
    meta: dict = {}

    def run():
        *images, found = rasterization(**leaves, **cameras)
        meta.update(pairs_traversed=found["pairs_traversed"])
        return images

    counted = counting.count(run, [leaves[name] for name in LEAVES], multiprocessors)
    each = [("pair, of a warp", float(meta["pairs_traversed"]))]
    each += [("pixel, of a thread", SIDE * SIDE / LANES)]
    return counted, PER_GAUSSIAN | {"composite": each, "composite_vjp": each}


def _harmonics(degree: int) -> tuple[Counts, Units]:
    shapes = (1, GAUSSIANS, (degree + 1) ** 2, 3), (1, GAUSSIANS, 3), (1, 1, 3)
    inputs = [torch.randn(shape, requires_grad=True) for shape in shapes]
    run = partial(colors_seen_from, degree, *inputs)
    return counting.count(run, inputs, MULTIPROCESSORS), PER_GAUSSIAN


CASES: dict[tuple[str, str], Callable[[], tuple[Counts, Units]]] = {
    ("scan", "bfloat16"): partial(_scan, 16, torch.bfloat16),
    ("scan", "bfloat16, in segments"): partial(_scan, 1, torch.bfloat16),
    ("scan", "float32"): partial(_scan, 16, torch.float32),
    ("scan", "float32, in segments"): partial(_scan, 1, torch.float32),
    ("conv", "bfloat16"): partial(_conv, torch.bfloat16),
    ("conv", "float32"): partial(_conv, torch.float32),
    ("raster", "whole tiles"): partial(_raster, 0),
    ("raster", "quarters of tiles"): partial(_raster, MULTIPROCESSORS),
    ("raster", "harmonics of degree 3"): partial(_harmonics, 3),
}


def rows_of(op: str, case: str, seen: set[str]) -> Iterator[dict]:
    """Yield the rows of the kernels that no earlier case launched."""
    torch.manual_seed(0)
    counted, found = CASES[op, case]()
    for direction, kernels in counted.items():
        for entry, ran in kernels.items():
            if entry in seen:
                continue
            seen.add(entry)
            for unit, number in found.get(ran.name, found[""]):
                each = {kind: x / number for kind, x in sorted(ran.counts.items())}
                yield {
                    **dict(op=op, kernel=ran.name, case=case, direction=direction, per=unit),
                    **dict(number=number, each={"all": counting.instructions(each)} | each),
                }


def versions() -> dict[str, str]:
    """Return the versions of the software that makes the PTX."""
    toolkit = wp.get_cuda_toolkit_version() or ()
    return {"nvrtc": ".".join(map(str, toolkit)), "warp": wp.__version__}


def main() -> None:
    """Count, and write the counts, and the table and the versions of the page."""
    document = json.loads(PAGE.with_suffix(".json").read_text())
    if "--peers" in sys.argv:
        document["peers"] = peers.compare(PAGE.parents[3] / "out" / "peers")
    seen: set[str] = set()
    document["versions"], document["kernels"] = versions(), []
    for op, case in CASES:
        print(f"counted: {op}, {case}")
        document["kernels"] += rows_of(op, case, seen)
    write_json(PAGE.with_suffix(".json"), document)
    made = ", ".join(f"{name} {x}" for name, x in document["peers"]["versions"].items())
    page = re.sub(r"(?<=--peers` \()[^)]*", made, PAGE.read_text())
    write_text(PAGE, page.partition("| operator")[0] + peers.table(document["peers"]))


if __name__ == "__main__":
    main()
