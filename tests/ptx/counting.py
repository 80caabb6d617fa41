"""Instructions that kernels execute, counted while their PTX runs without a GPU.

PTX is not machine code. The certain optimizations of ptxas are applied before counting: products
are fused with the sums that are their only readers; unused results, moves of registers and reads of
parameters, which become operands, are not counted. Machine code differs by addresses that ptxas
computes once and reuses.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from gamba_warp.kernels.cases.raster import orbit_cameras, shell
from gamba_warp.kernels.cases.scan import make_inputs
from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.kernels.selective_scan.cuda import launch as scan_cuda

from .dry_run import MULTIPROCESSORS
from .launch import Interpreter, interpreted
from .machine import Count, opcodes, units
from .parse import SPACES, Program

CHANNELS, STATES, WIDTH = 1024, 16, 4  # of the paper's model: of the scan, and the convolution's
GAUSSIANS, SIDE = 16384, 512
# Counts beside instructions: their memory accesses.
ASKED = ("bytes", "sectors", "first", "own", "passes", "conflicts", "together")
_NAME = re.compile(r"(?:\w+__locals__)?_?(\w+?)(?:_[0-9a-f]{8})+_cuda_kernel_forward")


class Executed(NamedTuple):
    """Instructions executed by all launches of a kernel.

    Attributes:
        name: of the kernel.
        counts: instructions of warps by kind, a "routine" being a division or root of many; and
            ``ASKED``: "bytes" of global memory, its "sectors" of 32 bytes, "first" of them that
            the launch had not touched, the sectors of threads' "own" memory, and of shared memory
            "passes", "conflicts" among them, and "together", the passes if a warp's lanes could be
            served at once.
    """

    name: str
    counts: dict[str, float]


Counts = dict[str, dict[str, Executed]]  # by direction and entry


def executed(machine: Interpreter) -> dict[str, Executed]:
    """Return the counts of an interpreter, by entry."""
    ran = machine.executed.items()
    return {k: _sum(program, times, machine.counts[k]) for k, (program, times) in ran}


def _sum(program: Program, times: list[int], asked: np.ndarray) -> Executed:
    names = [*opcodes()]
    read = {x for i in program.code for x in (*i.given[: i.reads], i.guard)}
    counts: Counter[str] = Counter()
    fields = [name for name, _ in Count._fields_]
    for i, warps, row in zip(program.code, times, asked):
        kind, more = units()[i.op], dict(zip(fields, map(int, row)))
        memory = kind in ("load", "store")
        if kind != "atomic" and i.writes and not read & {*i.to[: i.writes]}:
            continue
        if memory:
            kind = {"param": "parameter", "": "generic"}.get(SPACES[i.space], SPACES[i.space])
            if kind == "generic":  # the compiler does not know, the addresses do
                kind = "global" if more["bytes"] else "shared" if more["passes"] else "local"
        if kind in ("move", "parameter"):
            continue
        twice = kind == "integer" and names[i.op].endswith("64")  # 32 bits at a time
        counts[kind] += warps * (1 + twice)
        if memory or kind == "atomic":
            more["own"] = more.pop("sectors") if kind == "local" else 0
            counts.update({name: more.get(name, 0) for name in ASKED})
    found = _NAME.fullmatch(program.name)
    return Executed(found[1] if found else program.name, dict(counts))


def count(
    run: Callable[[], Tensor | Sequence[Tensor]], wanted: Iterable[Tensor], multiprocessors: int
) -> Counts:
    """Count the instructions of a call on an imagined device: "forward", and "gradient"."""
    options = {"counting": True, "contract": ".*"}
    with interpreted(multiprocessors, **options) as machine:
        made = run()
        outputs = [x for x in ([made] if torch.is_tensor(made) else made) if x.requires_grad]
    found = {"forward": executed(machine)}
    if outputs:
        cotangents = [torch.randn_like(x) for x in outputs]
        with interpreted(multiprocessors, **options) as machine:
            torch.autograd.grad(outputs, [*wanted], cotangents, allow_unused=True)
        found["gradient"] = executed(machine)
    return found


def instructions(counts: Mapping[str, float]) -> float:
    """Return the total number of instructions."""
    return sum(number for kind, number in counts.items() if kind not in ASKED)


def scan_tuning(batch: int, length: int) -> scan_cuda.Tuning:
    """Return the tuning that the scan chooses for sequences of the paper's width."""
    return scan_cuda.choose(batch, length, CHANNELS, STATES, 1, MULTIPROCESSORS)


def scan_inputs(length: int, channels: int, dtype: torch.dtype) -> dict[str, Tensor]:
    """Return the scan's inputs of one sequence, which require gradients."""
    inputs = make_inputs(1, length, channels)
    for name in ("u", "delta", "z", "B", "C"):
        inputs[name] = inputs[name].to(dtype)
    return {name: x.requires_grad_() for name, x in inputs.items()}


def count_scan(inputs: dict[str, Tensor], tuning: scan_cuda.Tuning, **options) -> Counts:
    """Count a scan with softplus and gate."""
    run = partial(selective_scan, **inputs, delta_softplus=True, **options)
    with patch.object(scan_cuda, "choose", lambda *_: tuning):
        return count(run, inputs.values(), MULTIPROCESSORS)


def conv_inputs(length: int, channels: int, dtype: torch.dtype) -> list[Tensor]:
    """Return the convolution's inputs of one sequence, which require gradients."""
    torch.manual_seed(0)
    x, weight = torch.randn(1, length, channels).to(dtype), torch.randn(channels, WIDTH)
    return [value.requires_grad_() for value in (x, weight, torch.randn(channels))]


def count_conv(length: int, channels: int, dtype: torch.dtype) -> Counts:
    """Count a convolution of one sequence, with bias and SiLU."""
    inputs = conv_inputs(length, channels, dtype)
    return count(partial(causal_conv1d, *inputs, activation="silu"), inputs, MULTIPROCESSORS)


def scene() -> tuple[dict[str, Tensor], dict]:
    """Return the Gaussians of a view of the benchmark's shell, and the view."""
    viewmats, Ks = orbit_cameras(1, SIDE)
    leaves = {name: x.requires_grad_() for name, x in shell(GAUSSIANS).items()}
    return leaves, dict(viewmats=viewmats, Ks=Ks, width=SIDE, height=SIDE)
