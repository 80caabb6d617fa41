"""Resources of the CUDA kernels, found without a GPU.

The operators report which kernels they would launch (``dry_run.py``), Warp compiles these ahead of
time, and the binaries hold their resources (``cubin.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.rasterize import depth_quantile, rasterization
from gamba_warp.kernels.rasterize.harmonics import colors_seen_from
from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state

from .cubin import RESERVED, Resources, read_cubin
from .dry_run import Launch, launches_of
from .machine import compiled, entry_of


class Multiprocessor(NamedTuple):
    """Limits of a multiprocessor (CUDA C++ Programming Guide, compute capabilities).

    Attributes:
        registers: 32 bits each, a quarter for each of its four parts.
        warps: resident.
        blocks: resident.
        shared: bytes for blocks, including their ``RESERVED``.
    """

    registers: int
    warps: int
    blocks: int
    shared: int


MACHINES = {
    80: Multiprocessor(65536, 64, 32, 164 << 10),  # A100
    90: Multiprocessor(65536, 64, 32, 228 << 10),  # H100, H200
}


def resident_warps(machine: Multiprocessor, block: int, registers: int, shared: int) -> int:
    """Return the number of a kernel's warps that a multiprocessor holds at a time.

    A warp's registers are allocated 256 at a time and come from one quarter; a block's shared
    memory 128 bytes at a time, with what the system reserves.

    Args:
        machine: its limits.
        block: threads of a block.
        registers: of a thread, 1 to 255.
        shared: bytes of a block, static and dynamic.
    """
    warps = -(-block // 32)
    of_warp = -(-32 * registers // 256) * 256
    return warps * min(
        machine.registers // 4 // of_warp * 4 // warps,
        machine.shared // (-(-(shared + RESERVED) // 128) * 128),
        machine.warps // warps,
        machine.blocks,
    )


LENGTH, CHANNELS = 16961, 1024  # of the scan in the paper's model


def _on_cuda(gradient: bool, *shapes: tuple[int, ...], dtype=torch.float32) -> list[Tensor]:
    return [torch.empty(s, dtype=dtype, device="cuda", requires_grad=gradient) for s in shapes]


def _scan(batch: int, dtype, states: int = 16, mode="mamba", last: bool = False) -> list[Tensor]:
    """Scan at the paper's size, with all options; a single sequence is cut into segments."""
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
    """Render 16,384 Gaussians at 512 x 512; few views cut the work of a tile into parts.

    With ``depth``, return only the depth of a transmittance, without gradients.
    """
    num = 16384
    shapes = (num, 3), (num, 4), (num, 3), (num,), (views, 4, 4)
    means, quats, scales, opacities, viewmats = _on_cuda(geometry and not depth, *shapes)
    (colors,), (Ks,) = _on_cuda(not depth, (num, 3)), _on_cuda(False, (views, 3, 3))
    splats = means, quats, scales, opacities, colors
    renders, alphas, meta = rasterization(*splats, viewmats, Ks, 512, 512, render_mode=mode)
    return [depth_quantile(meta)] if depth else [renders, alphas]


def _harmonics(degree: int) -> list[Tensor]:
    """Compute colours of 16,384 Gaussians in two views."""
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
    """A kernel, and the first case that launches it."""

    op: str
    case: str
    direction: str
    launch: Launch

    @property
    def name(self) -> str:
        """Name of the kernel's function, without a leading underscore."""
        return self.launch.kernel.func.__name__.lstrip("_")


def find_kernels() -> list[Entry]:
    """Return every kernel that the operators launch on CUDA in ``CASES``, once."""
    found: dict[Launch, Entry] = {}
    for (op, case), run in CASES.items():
        for direction, launches in launches_of(run).items():
            for launch in launches:
                found.setdefault(launch, Entry(op, case, direction, launch))
    return list(found.values())


def compile_kernel(launch: Launch) -> dict[int, tuple[Resources, int]]:
    """Return a kernel's resources and the bytes of its dynamic shared memory, by architecture.

    What is in Warp's cache of compiled kernels is not compiled again.
    """
    made = compiled(launch.kernel.module, launch.block, arch=list(MACHINES), use_ptx=False)
    found = {}
    for architecture, (path, notes) in zip(MACHINES, made):
        kernels = read_cubin(path.read_bytes())
        symbol = entry_of(launch.kernel, kernels)
        found[architecture] = kernels[symbol], notes.get(f"{symbol}_smem_bytes", 0)
    return found
