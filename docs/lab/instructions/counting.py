"""Instruction counts of the CUDA kernels, from running their PTX without a GPU (``tests/ptx``).

PTX is not yet machine code. The certain optimizations of ptxas are applied before counting:
products are fused with the sums that are their only readers; unused results, moves of registers and
reads of parameters, which become operands, are not counted. The remaining difference from the
disassembly are addresses that ptxas computes once and reuses.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from ptx.launch import Interpreter, interpreted
from ptx.machine import Count, opcodes, units
from ptx.parse import SPACES, Program
from torch import Tensor

from . import sass
from .estimate import ASKED

_NAME = re.compile(r"(?:\w+__locals__)?_?(\w+?)(?:_[0-9a-f]{8})+_cuda_kernel_forward")
_DROPPED = ("move", "parameter")


@dataclass(frozen=True)
class Executed:
    """Instructions executed by all launches of a kernel.

    Attributes:
        name: of the kernel.
        counts: instructions of warps by the kinds of ``sass.KINDS``, with "atomic", and with
            "routine" for a division or root that is many; and ``ASKED``: "bytes" of global memory,
            its "sectors" of 32 bytes, "first" of them that the launch had not touched, the sectors
            of threads' "own" memory, and of shared memory "passes", "conflicts" among them, and
            "together", the passes if a warp's lanes could be served at once.
        lanes: mean number of active lanes of 32 per instruction.
        splits: share of branches that diverge in a warp.
        code: the PTX.
        times: number of warps that executed each instruction of the PTX.
        blocks: of threads, of all launches.
    """

    name: str
    counts: dict[str, int]
    lanes: float
    splits: float
    code: Sequence[sass.Instruction]
    times: Sequence[int]
    blocks: int


def executed(machine: Interpreter) -> dict[str, Executed]:
    """Return the counts of an interpreter, by entry."""
    return {
        entry: _sum(program, times, machine.counts[entry], machine.blocks[entry])
        for entry, (program, times) in machine.executed.items()
    }


def _sum(program: Program, times: list[int], asked: np.ndarray, blocks: int) -> Executed:
    names = [*opcodes()]
    read = {x for i in program.code for x in (*i.given[: i.reads], i.guard)}
    counts: Counter[str] = Counter()
    fields = [name for name, _ in Count._fields_]
    steps = lanes = jumps = splits = 0
    for i, warps, row in zip(program.code, times, asked):
        kind, more = units()[i.op], dict(zip(fields, map(int, row)))
        memory = kind in ("load", "store")
        if kind != "atomic" and i.writes and not read & {*i.to[: i.writes]}:
            continue
        if memory:
            kind = {"param": "parameter", "": "generic"}.get(SPACES[i.space], SPACES[i.space])
            if kind == "generic":  # the compiler does not know, the addresses do
                kind = "global" if more["bytes"] else "shared" if more["passes"] else "local"
        if kind in _DROPPED:
            continue
        twice = kind == "integer" and names[i.op].endswith("64")  # 32 bits at a time
        counts[kind] += warps * (1 + twice)
        steps, lanes = steps + warps, lanes + more["lanes"]
        jumps, splits = jumps + warps * (kind == "jump"), splits + more["splits"]
        if memory or kind == "atomic":
            more["own"] = more.pop("sectors") if kind == "local" else 0
            counts.update({name: more.get(name, 0) for name in ASKED})
    jump = {"bra": "BRA", "ret": "EXIT", "exit": "EXIT"}
    code = [
        sass.Instruction(
            jump.get(names[i.op], names[i.op]),
            i.guard < 0,
            i.target if names[i.op] == "bra" else None,
        )
        for i in program.code
    ]
    found = _NAME.fullmatch(program.name)
    name = found[1] if found else program.name
    share = splits / jumps if jumps else 0.0
    return Executed(name, dict(counts), lanes / steps, share, code, times, blocks)


def count(
    run: Callable[[], Sequence[Tensor]], wanted: Iterable[Tensor], multiprocessors: int
) -> dict[str, dict[str, Executed]]:
    """Count the instructions of a call on a fake device: "forward", and "gradient"."""
    options = {"counting": True, "contract": ".*"}
    with interpreted(multiprocessors, **options) as machine:
        outputs = [x for x in run() if x.requires_grad]
    found = {"forward": executed(machine)}
    if outputs:
        cotangents = [torch.randn_like(x) for x in outputs]
        with interpreted(multiprocessors, **options) as machine:
            torch.autograd.grad(outputs, [*wanted], cotangents, allow_unused=True)
        found["gradient"] = executed(machine)
    return found
