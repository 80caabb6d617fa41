"""Resources of the CUDA kernels, found without a GPU: ``gamba bench --static``.

The operators say which kernels they would launch (``dry_run.py``), these are compiled ahead of
time, and the binaries say what they take (``cubin.py``). Nothing runs, so no time is measured.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from gamba_warp.versions import __version__

from ...causal_conv1d import causal_conv1d
from ...rasterize import depth_quantile, rasterization
from ...rasterize.harmonics import colors_seen_from
from ...runtime import tables
from ...selective_scan import selective_scan, selective_scan_state
from .cubin import RESERVED, Resources, read_cubin
from .dry_run import Launch, can_dry_run, launches_of

FORMAT = "gamba_warp.static.2"


class NoCompiler(Exception):
    """The CUDA kernels cannot be found or compiled here."""


class Machine(NamedTuple):
    """A multiprocessor's limits (CUDA C++ Programming Guide, compute capabilities).

    Attributes:
        registers: 32 bits each, a quarter for each of its four parts.
        warps: resident.
        blocks: resident.
        shared: bytes for blocks, their ``RESERVED`` counted.
    """

    registers: int
    warps: int
    blocks: int
    shared: int


MACHINES = {
    80: Machine(65536, 64, 32, 164 << 10),  # A100
    90: Machine(65536, 64, 32, 228 << 10),  # H100, H200
}


class Occupancy(NamedTuple):
    """Blocks and warps of a kernel that a multiprocessor holds at a time.

    Attributes:
        blocks: resident.
        warps: resident.
        share: of the most warps that it holds.
        limit: what is used up first: "registers", "shared memory", "warps" or "blocks".
    """

    blocks: int
    warps: int
    share: float
    limit: str


def occupancy(machine: Machine, block: int, registers: int, shared: int) -> Occupancy:
    """Blocks that fit on a multiprocessor.

    A warp's registers are handed out 256 at a time and come from one quarter; a block's shared
    memory 128 bytes at a time, with what the system reserves.

    Args:
        machine: its limits.
        block: threads of a block.
        registers: of a thread, 1 to 255.
        shared: bytes of a block, static and dynamic.
    """
    warps = -(-block // 32)
    of_warp = -(-32 * registers // 256) * 256
    blocks, limit = min(
        (machine.registers // 4 // of_warp * 4 // warps, "registers"),
        (machine.shared // (-(-(shared + RESERVED) // 128) * 128), "shared memory"),
        (machine.warps // warps, "warps"),
        (machine.blocks, "blocks"),
        key=lambda fit: fit[0],
    )
    return Occupancy(blocks, blocks * warps, blocks * warps / machine.warps, limit)


LENGTH, CHANNELS = 16961, 1024  # of the scan in the paper's model


def _on_cuda(gradient: bool, *shapes: tuple[int, ...], dtype=torch.float32) -> list[Tensor]:
    return [torch.empty(s, dtype=dtype, device="cuda", requires_grad=gradient) for s in shapes]


def _scan(batch: int, dtype, states: int = 16, mode="mamba", last: bool = False) -> list[Tensor]:
    """The paper's size, prefix and all; a single sequence is cut into segments."""
    token, state = (batch, LENGTH, CHANNELS), (batch, LENGTH, states)
    u, delta, z, B, C = _on_cuda(True, *[token] * 3, *[state] * 2, dtype=dtype)
    row = (CHANNELS,)
    A, D, bias, first = _on_cuda(True, (*row, states), row, row, (batch, CHANNELS, states))
    options: dict[str, Any] = dict(delta_bias=bias, delta_softplus=True, discretization=mode)
    if last:
        return [selective_scan_state(u, delta, A, B, **options)]
    options |= dict(D=D, z=z, initial_state=first, return_last_state=True)
    return list(selective_scan(u, delta, A, B, C, **options))


def _conv(dtype) -> list[Tensor]:
    x, weight, bias = ((1, 16384, 1024), (1024, 4), (1024,))
    (x,), parameters = _on_cuda(True, x, dtype=dtype), _on_cuda(True, weight, bias)
    return [causal_conv1d(x, *parameters, activation="silu")]


def _raster(views: int, mode="RGB", geometry: bool = True, depth: bool = False) -> list[Tensor]:
    """16,384 Gaussians in pictures of 512 x 512; a tile's work is cut where views are few.

    ``depth`` alone: that of a transmittance, of a rendering without gradients.
    """
    num = 16384
    shapes = (num, 3), (num, 4), (num, 3), (num,), (views, 4, 4)
    means, quats, scales, opacities, viewmats = _on_cuda(geometry and not depth, *shapes)
    (colors,), (Ks,) = _on_cuda(not depth, (num, 3)), _on_cuda(False, (views, 3, 3))
    splats = means, quats, scales, opacities, colors
    renders, alphas, meta = rasterization(*splats, viewmats, Ks, 512, 512, render_mode=mode)
    return [depth_quantile(meta)] if depth else [renders, alphas]


def _harmonics(degree: int) -> list[Tensor]:
    """Colours of 16,384 Gaussians in two views, all gradients."""
    num = 16384
    shapes = (1, num, (degree + 1) ** 2, 3), (1, num, 3), (1, 2, 3)
    return [colors_seen_from(degree, *_on_cuda(True, *shapes))]


_HALF = {"dtype": torch.bfloat16}
SCANS = {
    "bfloat16": _HALF,
    "float32": {"dtype": torch.float32},
    "bfloat16, last state alone": _HALF | {"last": True},
    "bfloat16, bilinear": _HALF | {"mode": "bilinear"},
    "bfloat16, zoh": _HALF | {"mode": "zoh"},
    "bfloat16, 64 states": _HALF | {"states": 64},
}
_RASTERS = {
    "32 views": {"views": 32},
    "2 views, a tile in halves": {"views": 2},
    "1 view, a tile in quarters": {"views": 1},
    "32 views with depth": {"views": 32, "mode": "RGB+D"},
    "32 views, depth alone": {"views": 32, "mode": "D"},
    "32 views, gradients of colours alone": {"views": 32, "geometry": False},
    "depth of a transmittance": {"views": 32, "depth": True},
}
# (op, case) -> a call of the operator; a kernel is listed with the first case that launches it
CASES: dict[tuple[str, str], Callable[[], list[Tensor]]] = {
    **{("scan", name): partial(_scan, 16, **options) for name, options in SCANS.items()},
    **{("scan", f"{name}, in segments"): partial(_scan, 1, **o) for name, o in SCANS.items()},
    ("conv", "bfloat16"): partial(_conv, torch.bfloat16),
    ("conv", "float32"): partial(_conv, torch.float32),
    **{("raster", name): partial(_raster, **options) for name, options in _RASTERS.items()},
    **{("raster", f"harmonics of degree {n}"): partial(_harmonics, n) for n in range(5)},
}


class Entry(NamedTuple):
    """A kernel of the report: what launches it."""

    op: str
    case: str
    direction: str
    launch: Launch

    @property
    def name(self) -> str:
        """The name of the kernel's function, without the underscore of what is private."""
        return self.launch.kernel.func.__name__.lstrip("_")


def find_kernels() -> list[Entry]:
    """Every kernel that the operators launch on CUDA in ``CASES``, once."""
    found: dict[Launch, Entry] = {}
    for (op, case), run in CASES.items():
        for direction, launches in launches_of(run).items():
            for launch in launches:
                found.setdefault(launch, Entry(op, case, direction, launch))
    return list(found.values())


def binaries(launch: Launch) -> dict[int, Path]:
    """Compiles a kernel's module for every architecture of ``MACHINES``; the files.

    What is in Warp's cache of compiled kernels is not compiled again.
    """
    module = launch.kernel.module
    before = module.options["block_dim"]
    module.options["block_dim"] = launch.block
    try:
        paths = wp.compile_aot_module(module, arch=list(MACHINES), use_ptx=False)
    finally:
        module.options["block_dim"] = before
    return dict(zip(MACHINES, map(Path, paths)))


def symbol_of(launch: Launch, names: Iterable[str]) -> str:
    """A kernel's symbol in a binary: Warp gives it a hash that depends on the target."""
    pattern = re.compile(re.escape(launch.kernel.key) + "_[0-9a-f]{8}_cuda_kernel_forward")
    (symbol,) = {name for name in names if pattern.fullmatch(name)}
    return symbol


def compile_kernel(launch: Launch) -> dict[int, tuple[Resources, int]]:
    """By architecture what a kernel takes, and the bytes of its dynamic shared memory."""
    found = {}
    for architecture, path in binaries(launch).items():
        meta = json.loads((path.parent / f"{path.name.rsplit('.', 2)[0]}.meta").read_bytes())
        taken = read_cubin(path.read_bytes())
        symbol = symbol_of(launch, taken)
        found[architecture] = taken[symbol], meta.get(f"{symbol}_smem_bytes", 0)
    return found


def static_report(say: Callable[[str], None] = lambda kernel: None) -> dict:
    """Compiles all kernels and says what they take; minutes at first, seconds from the cache.

    Args:
        say: called with a kernel's name before it is compiled.

    Returns:
        ``{format, versions, machines, kernels}``, ready for JSON. A kernel has ``op, kernel, case,
        direction, arch, block`` (threads), the fields of ``Resources``, ``dynamic_shared`` (bytes)
        and the fields of ``Occupancy``.

    Raises:
        NoCompiler: this build of Warp cannot compile for CUDA, or this torch needs a GPU.
    """
    toolkit = wp.get_cuda_toolkit_version()
    if toolkit is None:
        raise NoCompiler("this build of warp-lang cannot compile for CUDA")
    if not can_dry_run():
        raise NoCompiler(f"torch {torch.__version__} needs a GPU for it; torch 2.11 does not")
    rows = []
    for entry in find_kernels():
        say(f"{entry.op}: {entry.name}")
        names = dict(op=entry.op, kernel=entry.name, case=entry.case, direction=entry.direction)
        block = entry.launch.block
        for arch, (used, dynamic) in compile_kernel(entry.launch).items():
            fit = occupancy(MACHINES[arch], block, used.registers, used.shared + dynamic)
            taken = used._asdict() | {"dynamic_shared": dynamic} | fit._asdict()
            rows.append(names | {"arch": f"sm_{arch}", "block": block} | taken)
    nvrtc = ".".join(map(str, toolkit))
    return {
        "format": FORMAT,
        "versions": {"nvrtc": nvrtc, "warp": wp.__version__, "gamba_warp": __version__},
        "machines": {f"sm_{arch}": machine._asdict() for arch, machine in MACHINES.items()},
        "kernels": rows,
    }


_EXPLANATION = """
Written by `{}`, not by hand: the kernels were compiled ahead of time, and the
binaries say what they take. Nothing here was run. **Not measured on a GPU.**

Two figures with a stroke are those of {}, in this order; one stands for both.
**registers** and **stack** are of a thread. Stack is in local memory and holds arrays that are
indexed at run time as well as registers that were spilled. **spills** counts the instructions that
fetch from a fixed place of the stack, which is how a spilled register comes back: 0 means that
nothing is spilled, more is a bound. **shared** is a block's, static and dynamic. **blocks** and
**warps** are what a multiprocessor holds at a time; **of** is their share of the most warps, and
**limit** what is used up first.
"""
_COLUMNS: dict[str, Callable[[dict], object]] = {
    "block": itemgetter("block"),
    "registers": itemgetter("registers"),
    "stack, B": itemgetter("frame"),
    "spills": itemgetter("reloads"),
    "shared, B": lambda row: row["shared"] + row["dynamic_shared"],
    **{name: itemgetter(name) for name in ("instructions", "blocks", "warps")},
    "of": lambda row: f"{row['share']:.0%}",
    "limit": itemgetter("limit"),
}


def full_name(row: dict) -> str:
    """A row's kernel as tables name it."""
    return f"`{row['kernel']}`" + (" (gradient)" if row["direction"] == "gradient" else "")


def static_markdown(document: dict, by: str = "gamba bench --static") -> str:
    """The report as a page with one table per op."""
    versions = ", ".join(f"{name} {version}" for name, version in document["versions"].items())
    text = _EXPLANATION.format(by, " and ".join(document["machines"]))
    lines = ["# What the CUDA kernels take", text, f"{versions}.", ""]
    header, columns = ["kernel", "case", *_COLUMNS], _COLUMNS.values()
    by_op: dict[str, dict[tuple, list[dict]]] = {}
    for row in document["kernels"]:
        names = full_name(row), row["case"]
        by_op.setdefault(row["op"], {}).setdefault(names, []).append(row)
    for op, table in by_op.items():
        cells = [
            [*names, *(" / ".join(dict.fromkeys(str(c(row)) for row in rows)) for c in columns)]
            for names, rows in table.items()
        ]
        lines += [f"## {op}", "", tables.markdown(header, cells), ""]
    return "\n".join(lines)
