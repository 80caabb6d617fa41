"""Launches on CUDA by the interpreter, on tensors of the CPU."""

import contextlib
import ctypes
import functools
import itertools
import math
import re
import zlib
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import torch
from warp._src import context as warp_context

from gamba_warp.kernels.runtime.views import StructValue

from .contract import contracted
from .machine import FAULTS, Array, Count, Finding, Launch, Missing, compiled, entry_of, library
from .parse import Program, read
from .simulated import simulated

ARCHITECTURE = 80  # the PTX of the kernels for sm_90 is the same
MOST_STEPS = 20_000_000  # instructions of a warp; those of a test's kernels take under a million
MOST_FINDINGS = 64


@functools.cache
def programs(module, block_dim: int, architecture: int = ARCHITECTURE) -> tuple[dict, dict]:
    """A Warp module's programs by entry, and what Warp notes of the entries.

    The PTX lies in Warp's folder of compiled kernels, by the module's hash.

    Raises:
        Missing: it cannot be kept.
        Refused: as ``read``.
    """
    try:
        ((path, notes),) = compiled(module, block_dim, arch=architecture, use_ptx=True)
        return read(path.read_text(errors="replace")), notes
    except OSError as error:
        raise Missing(f"the PTX of {module.name} cannot be kept: {error}") from error


@dataclass
class Interpreter:
    """Executes launches, and keeps what it finds.

    Attributes:
        seed: of the order of all that has none on a GPU; 0: in order.
        approximate: how the approximate units err, within what is documented of them: 0 not at all,
            1 to one side, else as drawn from this number.
        contract: kernels whose products are contracted with sums: their keys, a regular expression.
        counting: whether it counts what instructions ask for, at some cost.
        findings: a line each.
        executed: by entry its program, and by instruction how many warps executed it.
        blocks: by entry, those of all launches.
        counts: where it is counting, by entry and instruction the fields of ``Count``.
        trace: after each launch a checksum of all the memory that it was given.
        steps: instructions of warps.
    """

    seed: int = 0
    approximate: int = 0
    contract: str = ""
    counting: bool = False
    findings: list[str] = field(default_factory=list)
    executed: dict[str, tuple[Program, list[int]]] = field(default_factory=dict)
    blocks: Counter[str] = field(default_factory=Counter)
    counts: dict[str, np.ndarray] = field(default_factory=dict)
    trace: list[int] = field(default_factory=list)
    steps: int = 0

    def launch(self, kernel, dim, arguments, block_dim: int, device) -> None:
        """As ``launch_on_stream``."""
        of_module, notes = programs(kernel.module, block_dim)
        name = entry_of(kernel, of_module)
        bounds = warp_context._build_launch_bounds_from_tuple(dim, kernel.adj.kernel_dim)
        packed = [
            warp_context.pack_arg(kernel, wanted.type, wanted.label, value, "cpu")
            for wanted, value in zip(kernel.adj.args, arguments, strict=True)
        ]
        params = [bytes(value) for value in (bounds, *packed)]
        program, blocks = of_module[name], -(-bounds.size // block_dim)
        if re.fullmatch(self.contract, kernel.key):
            program = contracted(program)
        sizes = block_dim, blocks, notes.get(f"{name}_smem_bytes", 0)
        self.execute(program, params, _tensors(arguments), sizes)

    def execute(self, program: Program, params: list[bytes], tensors, sizes) -> None:
        """Runs an entry.

        Args:
            program: from ``read``.
            params: the bytes of each parameter.
            tensors: what may be touched.
            sizes: threads of a block, blocks (a number, or three), and bytes of shared memory
                beside the text's.
        """
        shapes = [x if isinstance(x, tuple) else (x, 1, 1) for x in sizes[:2]]
        threads, blocks = map(math.prod, shapes)
        assert [len(x) for x in params] == [size for _, size in program.params], program.name
        # more blocks have more directions on a GPU, and more bits than a shadow has here
        assert blocks < 1 << 18 and blocks * threads <= 1 << 24, f"{program.name}: {blocks} blocks"
        assert not program.most_threads or threads <= program.most_threads, program.name
        blob = bytearray(program.params_size)
        for value, (at, size) in zip(params, program.params):
            blob[at : at + size] = value
        count, arrays = len(program.text), _arrays(tensors)
        findings, executed = (Finding * MOST_FINDINGS)(), (ctypes.c_int64 * count)()
        asked = np.zeros((count, len(Count._fields_)), np.int64)
        launch = Launch(
            code=ctypes.addressof(program.code),
            constants=ctypes.addressof(program.constants),
            params=ctypes.addressof((ctypes.c_char * len(blob)).from_buffer(blob)),
            arrays=ctypes.addressof(arrays),
            constant_count=len(program.constants),
            file_size=program.file_size,
            params_size=len(blob),
            array_count=len(arrays),
            shared_size=program.shared_size + sizes[2],
            shared_unit=program.shared_unit,
            local_size=program.local_size,
            threads=shapes[0],
            blocks=shapes[1],
            special=tuple(program.special),
            seed=self.seed and self.seed + 1000 * len(self.trace),
            approximate=self.approximate,
            limit=MOST_STEPS,
            findings=ctypes.addressof(findings),
            most_findings=MOST_FINDINGS,
            executed=ctypes.addressof(executed),
            counts=asked.ctypes.data if self.counting else None,
        )
        library().run(ctypes.byref(launch))
        self.steps += launch.steps
        self.blocks[program.name] += blocks
        contents = ((ctypes.c_char * x.size).from_address(x.base) for x in arrays)
        self.trace.append(sum(map(zlib.crc32, contents)))  # their addresses have no order
        _, counts = self.executed.setdefault(program.name, (program, [0] * count))
        counts[:] = map(sum, zip(counts, executed))
        if self.counting:
            self.counts[program.name] = self.counts.get(program.name, 0) + asked
        for found in findings[: launch.found]:
            where = f"{program.name}: {program.text[found.at]!r}"
            thread = f"block {found.block}, thread {found.thread}"
            self.findings.append(f"{FAULTS[found.fault]}: {where}, {thread}, {found.times} times")


def _tensors(values) -> list[torch.Tensor]:
    """The tensors that a launch is given, those inside of structs too."""
    found = []
    for value in values:
        if isinstance(value, StructValue):
            found += _tensors(value.values)
        elif isinstance(owner := getattr(value, "owner", value), torch.Tensor):
            found.append(owner)
    return found


def _arrays(tensors):
    """The memory of tensors, in order: each dense piece of one; what overlaps is one array."""
    merged: list[list[int]] = []
    for begin, end, unit in sorted(piece for x in tensors if x.numel() for piece in _pieces(x)):
        if merged and begin < merged[-1][1]:
            merged[-1][1:] = max(end, merged[-1][1]), min(unit, merged[-1][2])
        else:
            merged.append([begin, end, unit])
    found = [(begin, end - begin, min(unit, 2)) for begin, end, unit in merged]
    return (Array * len(found))(*found)


def _pieces(x: torch.Tensor):
    """Return the begin and end of each dense piece of a tensor's memory, and its unit."""
    size, dense, apart = x.element_size(), 1, []
    for stride, length in sorted(zip(x.stride(), x.shape)):
        if stride <= dense or length == 1:
            dense += (length - 1) * stride if length > 1 else 0
        else:
            apart.append(range(0, length * stride, stride))
    for places in itertools.product(*apart):
        begin = x.data_ptr() + size * sum(places)
        yield begin, begin + size * dense, size.bit_length() - 1


@contextlib.contextmanager
def interpreted(multiprocessors: int = 132, **options):
    """Inside, operators on tensors of the CPU take their CUDA path; gives its ``Interpreter``.

    Memory that nobody has written is full of NaN, or 77.
    """
    made = Interpreter(**options)
    before = {(owner, name): getattr(owner, name) for owner, name in _MAKERS}
    for (owner, name), make in before.items():
        setattr(owner, name, _poisoned(make))
    try:
        with simulated(made.launch, multiprocessors):
            yield made
    finally:
        for (owner, name), make in before.items():
            setattr(owner, name, make)


_MAKERS = (torch, "empty"), (torch, "empty_like"), (torch.Tensor, "new_empty")


def _poisoned(make):
    def poisoned(*args, **options):
        x = make(*args, **options)
        return x.fill_(torch.nan if x.is_floating_point() else 77)

    return poisoned
