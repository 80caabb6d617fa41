"""Page of the instruction counts: ``PYTHONPATH=tests python -m ptx.counts [--peers]``.

Writes docs/lab/benchmarks/counts.json and counts.md; with ``--peers`` it also counts other
libraries' kernels again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from unittest.mock import patch

import torch
import warp as wp

from gamba_warp.files import write_json, write_text
from gamba_warp.kernels.cases.raster import LEAVES, orbit_cameras, shell
from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.rasterize.harmonics import colors_seen_from
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.kernels.selective_scan.cuda import launch as scan_cuda

from . import counting, peers
from .counting import GAUSSIANS, SIDE, STATES, Counts
from .dry_run import MULTIPROCESSORS
from .machine import Missing

PAGE = Path(__file__).parents[2] / "docs" / "lab" / "benchmarks" / "counts.md"
LENGTH, LANES = 16961, 32  # of the scan in the paper's model; of a warp
# The executed part of it: whole chunks, two blocks of channels; one segment, or two for several.
TOKENS, WIDTH, SEGMENTS = 1024, 128, 2
# One ends at once where the lists have room, the other is a single thread.
_LEFT_OUT = ("composite_unlisted", "composite_vjp_unlisted", "note")
# By kernel, or for all (""), the unit of the counts: a text, and the number of units in warps.
Units = dict[str, list[tuple[str, float]]]


def _scan(batch: int, dtype: torch.dtype) -> tuple[Counts, Units]:
    tuning = counting.scan_tuning(batch, LENGTH)
    tuning = tuning._replace(
        segments=min(tuning.segments, SEGMENTS), back_segments=min(tuning.back_segments, SEGMENTS)
    )
    inputs = counting.scan_inputs(TOKENS, WIDTH, dtype)
    inputs["initial_state"] = torch.zeros(1, WIDTH, STATES, requires_grad=True)
    run = partial(selective_scan, **inputs, delta_softplus=True, return_last_state=True)
    with patch.object(scan_cuda, "FORCED", tuning):
        counted = counting.count(run, inputs.values(), MULTIPROCESSORS)
    return counted, {"": [("(b, t, d, n), of a thread", TOKENS * WIDTH * STATES / LANES)]}


def _conv(dtype: torch.dtype) -> tuple[Counts, Units]:
    inputs = counting.conv_inputs(TOKENS, WIDTH, dtype)
    run = partial(causal_conv1d, *inputs, activation="silu")
    counted = counting.count(lambda: [run()], inputs, MULTIPROCESSORS)
    return counted, {"": [("(b, t, d), of a thread", TOKENS * WIDTH / LANES)]}


def _raster(multiprocessors: int) -> tuple[Counts, Units]:
    """Count a view of the benchmark's shell; fewer multiprocessors give a tile fewer warps."""
    viewmats, Ks = orbit_cameras(1, SIDE)
    leaves = {k: x.requires_grad_() for k, x in shell(GAUSSIANS).items()}
    cameras = dict(viewmats=viewmats, Ks=Ks, width=SIDE, height=SIDE)
    meta: dict = {}

    def run():
        renders, alphas, found = rasterization(**leaves, **cameras)
        meta.update(pairs_walked=found["pairs_walked"])
        return [renders, alphas]

    counted = counting.count(run, [leaves[name] for name in LEAVES], multiprocessors)
    pixel = ("pixel, of a thread", SIDE * SIDE / LANES)
    pair = ("pair, of a warp", float(meta["pairs_walked"]))
    units: Units = {"": [("Gaussian, of a thread", GAUSSIANS / LANES)]}
    return counted, units | {"composite": [pair, pixel], "composite_vjp": [pair, pixel]}


def _harmonics(degree: int) -> tuple[Counts, Units]:
    shapes = (1, GAUSSIANS, (degree + 1) ** 2, 3), (1, GAUSSIANS, 3), (1, 1, 3)
    inputs = [torch.randn(shape, requires_grad=True) for shape in shapes]
    counted = counting.count(lambda: [colors_seen_from(degree, *inputs)], inputs, MULTIPROCESSORS)
    return counted, {"": [("Gaussian, of a thread", GAUSSIANS / LANES)]}


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
            if entry in seen or ran.name in _LEFT_OUT:
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


_TEXT = """# What the CUDA kernels execute

Counts, not times: the kernels' PTX was executed without a GPU, beside that of other libraries
([`python -m ptx.counts`](../../../tests/ptx/README.md)). `counts.json` has each kernel's
instructions by kind, sectors of global memory and passes of shared memory.

"""


def markdown(document: dict) -> str:
    """Return the page of a document.

    A row of its ``kernels`` has ``op, kernel, case, direction, per`` (the unit), ``number`` (warps'
    worth of units) and ``each`` (counts per unit). Its ``peers`` are of ``peers.compare``.
    """
    return _TEXT + peers.markdown(document["peers"])


def main() -> None:
    """Count, and write both files."""
    document = json.loads(PAGE.with_suffix(".json").read_text())
    if "--peers" in sys.argv:
        document["peers"] = peers.compare(PAGE.parents[3] / "out" / "peers")
    seen: set[str] = set()
    document["versions"], document["kernels"] = versions(), []
    for op, case in CASES:
        print(f"counted: {op}, {case}")
        document["kernels"] += rows_of(op, case, seen)
    write_json(PAGE.with_suffix(".json"), document)
    write_text(PAGE, markdown(document))


if __name__ == "__main__":
    try:
        main()
    except Missing as reason:
        sys.exit(f"nothing can be executed: {reason}")
