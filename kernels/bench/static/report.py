"""What the CUDA kernels take of a GPU, told without one: ``gamba bench --static``.

The operators say which kernels they would launch (``dry_run.py``), these are compiled ahead of
time, and the binaries say what they take (``cubin.py``). Nothing runs, so no time is measured.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

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


@dataclass(frozen=True)
class Machine:
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


@dataclass(frozen=True)
class Occupancy:
    """How much of a kernel a multiprocessor holds at a time.

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
    fits = {
        "registers": machine.registers // 4 // of_warp * 4 // warps,
        "shared memory": machine.shared // (-(-(shared + RESERVED) // 128) * 128),
        "warps": machine.warps // warps,
        "blocks": machine.blocks,
    }
    limit = min(fits, key=lambda name: fits[name])
    blocks = fits[limit]
    return Occupancy(blocks, blocks * warps, blocks * warps / machine.warps, limit)


LENGTH, CHANNELS = 16961, 1024  # of the scan in the paper's model


def _tensor(*shape: int, dtype=torch.float32, gradient: bool = True) -> Tensor:
    return torch.empty(*shape, dtype=dtype, device="cuda", requires_grad=gradient)


def _scan(
    batch: int, dtype, states: int = 16, mode: str = "mamba", last: bool = False
) -> list[Tensor]:
    """The paper's size, prefix and all; a single sequence is cut into segments."""
    length, channels = LENGTH, CHANNELS
    u, delta, z = (_tensor(batch, length, channels, dtype=dtype) for _ in range(3))
    B, C = (_tensor(batch, length, states, dtype=dtype) for _ in range(2))
    A, D, bias = _tensor(channels, states), _tensor(channels), _tensor(channels)
    options: dict[str, Any] = {"delta_bias": bias, "delta_softplus": True, "discretization": mode}
    if last:
        return [selective_scan_state(u, delta, A, B, **options)]
    state = _tensor(batch, channels, states)
    options |= {"D": D, "z": z, "initial_state": state}
    return list(selective_scan(u, delta, A, B, C, **options, return_last_state=True))


def _conv(dtype) -> list[Tensor]:
    x, weight, bias = _tensor(1, 16384, 1024, dtype=dtype), _tensor(1024, 4), _tensor(1024)
    return [causal_conv1d(x, weight, bias, activation="silu")]


def _raster(views: int, mode: str = "RGB", geometry: bool = True) -> list[Tensor]:
    """16,384 Gaussians in pictures of 512 x 512; a tile's work is cut where views are few."""
    num = 16384
    tensor = partial(_tensor, gradient=geometry)
    means, quats, scales = tensor(num, 3), tensor(num, 4), tensor(num, 3)
    viewmats, Ks = tensor(views, 4, 4), _tensor(views, 3, 3, gradient=False)
    renders, alphas, _ = rasterization(
        *(means, quats, scales, tensor(num), _tensor(num, 3), viewmats, Ks, 512, 512),
        render_mode=mode,
    )
    return [renders, alphas]


def _depth() -> list[Tensor]:
    """Of a rendering without gradients."""
    num, views = 16384, 32
    tensor = partial(_tensor, gradient=False)
    splats = tensor(num, 3), tensor(num, 4), tensor(num, 3), tensor(num), tensor(num, 3)
    *_, meta = rasterization(*splats, tensor(views, 4, 4), tensor(views, 3, 3), 512, 512)
    return [depth_quantile(meta)]


def _harmonics(degree: int) -> list[Tensor]:
    """Colours of 16,384 Gaussians in two views, all gradients."""
    num = 16384
    coefficients, means = _tensor(1, num, (degree + 1) ** 2, 3), _tensor(1, num, 3)
    return [colors_seen_from(degree, coefficients, means, _tensor(1, 2, 3))]


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
}
# (op, case) -> a call of the operator; a kernel is listed with the first case that launches it
CASES: dict[tuple[str, str], Callable[[], list[Tensor]]] = {
    **{("scan", name): partial(_scan, 16, **options) for name, options in SCANS.items()},
    **{("scan", f"{name}, in segments"): partial(_scan, 1, **o) for name, o in SCANS.items()},
    ("conv", "bfloat16"): partial(_conv, torch.bfloat16),
    ("conv", "float32"): partial(_conv, torch.float32),
    **{("raster", name): partial(_raster, **options) for name, options in _RASTERS.items()},
    ("raster", "depth of a transmittance"): _depth,
    **{("raster", f"harmonics of degree {n}"): partial(_harmonics, n) for n in range(5)},
}


@dataclass(frozen=True)
class Entry:
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
        for arch, (used, dynamic) in compile_kernel(entry.launch).items():
            block = entry.launch.block
            fit = occupancy(MACHINES[arch], block, used.registers, used.shared + dynamic)
            names = {"op": entry.op, "kernel": entry.name, "case": entry.case}
            names |= {"direction": entry.direction, "arch": f"sm_{arch}", "block": block}
            rows.append(names | asdict(used) | {"dynamic_shared": dynamic} | asdict(fit))
    nvrtc = ".".join(map(str, toolkit))
    return {
        "format": FORMAT,
        "versions": {"nvrtc": nvrtc, "warp": wp.__version__, "gamba_warp": __version__},
        "machines": {f"sm_{arch}": asdict(machine) for arch, machine in MACHINES.items()},
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
    "block": lambda row: row["block"],
    "registers": lambda row: row["registers"],
    "stack, B": lambda row: row["frame"],
    "spills": lambda row: row["reloads"],
    "shared, B": lambda row: row["shared"] + row["dynamic_shared"],
    "instructions": lambda row: row["instructions"],
    "blocks": lambda row: row["blocks"],
    "warps": lambda row: row["warps"],
    "of": lambda row: f"{row['share']:.0%}",
    "limit": lambda row: row["limit"],
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
