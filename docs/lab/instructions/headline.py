"""Instruction counts of kernels in the first cases of the benchmarks: counts.json, counts.md."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import torch
import warp as wp

from gamba_warp.kernels.bench.cases.raster_scene import LEAVES, orbit_cameras, shell
from gamba_warp.kernels.bench.static.dry_run import MULTIPROCESSORS
from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.rasterize import depth_quantile, rasterization
from gamba_warp.kernels.rasterize.harmonics import colors_seen_from
from gamba_warp.kernels.runtime import tables

from . import peer_page
from .counting import Executed, count
from .estimate import DEVICES, LANES, SECTOR, cycles, every
from .report import TOKENS, WIDTH, count_scan

FORMAT = "gamba_warp.counts.1"
GAUSSIANS, SIDE = 16384, 512
# Result of a case: the executed kernels, and by kernel, or for all (""), the unit of the counts: a
# text, and the number of units in warps.
Counts = dict[str, dict[str, Executed]]
Units = dict[str, list[tuple[str, float]]]
# One ends at once where the lists have room, the other is a single thread.
_LEFT_OUT = ("composite_unlisted", "composite_vjp_unlisted", "note")


def _scan(case: str) -> tuple[Counts, Units]:
    counted, shape, _ = count_scan(case)
    number = TOKENS * WIDTH * shape.states / LANES
    return counted, {"": [("(b, t, d, n), of a thread", number)]}


def _conv(dtype: torch.dtype) -> tuple[Counts, Units]:
    x = torch.randn(1, TOKENS, WIDTH).to(dtype).requires_grad_()
    weight, bias = (torch.randn(*size, requires_grad=True) for size in ((WIDTH, 4), (WIDTH,)))
    run = partial(causal_conv1d, x, weight, bias, activation="silu")
    counted = count(lambda: [run()], (x, weight, bias), MULTIPROCESSORS)
    return counted, {"": [("(b, t, d), of a thread", x.numel() / LANES)]}


def _raster(multiprocessors: int, quantile: bool = False) -> tuple[Counts, Units]:
    """A view of the benchmark's shell; the fewer multiprocessors, the fewer warps share a tile."""
    viewmats, Ks = orbit_cameras(1, SIDE)
    splats = {k: x.requires_grad_(not quantile) for k, x in shell(GAUSSIANS).items()}
    meta: dict = {}

    def run():
        renders, alphas, found = rasterization(
            **splats, viewmats=viewmats, Ks=Ks, width=SIDE, height=SIDE
        )
        meta.update(pairs_walked=found["pairs_walked"])
        return [depth_quantile(found)] if quantile else [renders, alphas]

    counted = count(run, [splats[name] for name in LEAVES], multiprocessors)
    pixel = ("pixel, of a thread", SIDE * SIDE / LANES)
    pair = ("pair, of a warp", float(meta["pairs_walked"]))
    found: Units = {"": [("Gaussian, of a thread", GAUSSIANS / LANES)], "quantile": [pixel]}
    return counted, found | {"composite": [pair, pixel], "composite_vjp": [pair, pixel]}


def _harmonics(degree: int) -> tuple[Counts, Units]:
    shapes = (1, GAUSSIANS, (degree + 1) ** 2, 3), (1, GAUSSIANS, 3), (1, 1, 3)
    inputs = [torch.randn(shape, requires_grad=True) for shape in shapes]
    counted = count(lambda: [colors_seen_from(degree, *inputs)], inputs, MULTIPROCESSORS)
    return counted, {"": [("Gaussian, of a thread", GAUSSIANS / LANES)]}


CASES: dict[tuple[str, str], Callable[[], tuple[Counts, Units]]] = {
    **{("scan", name + more): partial(_scan, name + more)
       for name in ("bfloat16", "float32") for more in ("", ", in segments")},
    ("conv", "bfloat16"): partial(_conv, torch.bfloat16),
    ("conv", "float32"): partial(_conv, torch.float32),
    ("raster", "whole tiles"): partial(_raster, 0),
    ("raster", "quarters of tiles"): partial(_raster, MULTIPROCESSORS),
    ("raster", "depth of a transmittance"): partial(_raster, 0, quantile=True),
    ("raster", "harmonics of degree 3"): partial(_harmonics, 3),
}  # fmt: skip


def rows_of(op: str, case: str, seen: set[str]) -> Iterator[dict]:
    """Yield the rows of the kernels that no earlier case launched."""
    torch.manual_seed(0)
    counted, found = CASES[op, case]()
    for direction, kernels in counted.items():
        for entry, ran in kernels.items():
            if entry in seen or ran.name in _LEFT_OUT:
                continue
            seen.add(entry)
            limits = {f"sm_{arch}": cycles(device, ran.counts) for arch, device in DEVICES.items()}
            for unit, number in found.get(ran.name, found[""]):
                each = {kind: x / number for kind, x in sorted(ran.counts.items())}
                yield {
                    **dict(op=op, kernel=ran.name, case=case, direction=direction, per=unit),
                    **dict(number=number, each={"all": every(each)} | each),
                    **dict(lanes=ran.lanes, splits=ran.splits),
                    "cycles": {
                        arch: {k: x / number for k, x in of.items()} for arch, of in limits.items()
                    },
                }


def headline(say: Callable[[str], None] = lambda case: None) -> dict:
    """Execute all cases; ``{format, versions, kernels}``, ready for JSON; ``peers`` has its own.

    A kernel has ``op, kernel, case, direction, per`` (what its figures are for), ``number`` (warps'
    worth of that), ``each`` (counts for one), ``lanes``, ``splits`` (as ``counting.Executed``), and
    ``cycles`` of a multiprocessor for one, by architecture and unit.
    """
    seen: set[str] = set()
    rows = []
    for op, case in CASES:
        say(f"counted: {op}, {case}")
        rows += rows_of(op, case, seen)
    return {"format": FORMAT, "versions": versions(), "kernels": rows}


def versions() -> dict[str, str]:
    """Versions of the software that makes the PTX."""
    toolkit = wp.get_cuda_toolkit_version() or ()
    return {"nvrtc": ".".join(map(str, toolkit)), "warp": wp.__version__}


_KINDS = ("all", "float", "special", "integer", "multiply", "convert", "global", "shared", "local")
_KINDS += ("shuffle", "barrier", "jump", "atomic", "routine")
_TEXT = f"""# What the CUDA kernels execute

Written by `make instructions`, not by hand: the kernels' PTX was executed without a GPU
([how](../../../tests/ptx/README.md)), and every instruction counted. **These are counts, not
times.**

The scan and the convolution have {TOKENS:,} tokens and {WIDTH} channels, the scan 16 states and, in
segments, two; the rasterizer one view of 512 x 512 of {GAUSSIANS:,} Gaussians (`shell` of
`kernels/bench/cases/raster_scene.py`). A kernel is listed with the first case that launches it, all
gradients asked for.

## Instructions
Instructions of PTX for one of what **per** says: those of a warp for a pair of a Gaussian and a
tile that is walked, else those of a thread. Products that ptxas joins with sums count once; moves
of registers and reads of parameters are left out, as ptxas makes operands of them. **integer**
holds addresses, comparisons and selections, twice where they have 64 bits; **convert** is of
numbers' types; a **routine** is a division or root of many instructions. The disassembly of the
scan ([static.md](static.md)) has 4 to 8 % fewer, mostly integers.

"""
_MEMORY = """
## Memory and lanes
For one of the same. **sectors** are those of 32 bytes of global memory that warps' accesses take
from the L1 cache; **first** those that the launch had not touched before, which at the least come
from or go to device memory; **own** those of threads' own memory; **used** is what lanes asked for,
of the sectors' bytes (above 100 % lanes share them). **passes** of shared memory: 32 lanes at a
time for 4 bytes, 16 for 8, 8 for 16; **conflicts** of banks among them; **together** passes if all
32 lanes could be served at once, which is the least. **lanes** of 32 that come to an instruction,
on average; **split** is the share of branches that part a warp.

**binds** names the unit that takes longest, if each works in every cycle, then the next with its
share of that time: of an A100, and of an H200. **L1** is `together`, `sectors` and `own`, 128 bytes
a cycle; **L1, grouped** the same with `passes`, where that would bind.

"""


def _figure(value: float) -> str:
    return "" if not value else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _binds(cycles: dict[str, float], each: dict[str, float]) -> str:
    (name, most), (after, next_most), *_ = sorted(cycles.items(), key=lambda x: -x[1])
    grouped = cycles["L1"] + each["passes"] - each["together"]
    more = f"; L1, grouped, {grouped / most:.0%}" if grouped > most and name != "L1" else ""
    return f"**{name}**; {after} {next_most / most:.0%}{more}"


def markdown(document: dict) -> str:
    """Page of the document of ``headline``."""
    counts, memory = [], []
    for row in document["kernels"]:
        each = row["each"]
        gradient = " (gradient)" if row["direction"] == "gradient" else ""
        names = [f"`{row['kernel']}`{gradient}", row["case"], row["per"]]
        counts.append([*names, *(_figure(each.get(kind, 0)) for kind in _KINDS)])
        asked = [_figure(each[name]) for name in ("sectors", "first", "own")]
        used = f"{each['bytes'] / SECTOR / each['sectors']:.0%}"
        passes = [_figure(each[name]) for name in ("passes", "conflicts", "together")]
        lanes = [f"{row['lanes']:.1f}", f"{row['splits']:.0%}"]
        binds = [_binds(row["cycles"][arch], each) for arch in ("sm_80", "sm_90")]
        memory.append([*names, *asked, used, *passes, *lanes, *binds])
    names = ["kernel", "case", "per"]
    header = [
        "sectors",
        "first",
        "own",
        "used",
        "passes",
        "conflicts",
        "together",
        "lanes",
        "split",
    ]
    header += ["binds, A100", "binds, H200"]
    tables_ = (
        tables.markdown([*names, *_KINDS], counts),
        tables.markdown([*names, *header], memory),
    )
    beside = "\n" + peer_page.markdown(document["peers"]) if "peers" in document else ""
    return _TEXT + tables_[0] + "\n" + _MEMORY + tables_[1] + "\n" + beside
