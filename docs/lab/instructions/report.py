"""What the CUDA kernels take, with their instructions counted, and least times of the scan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from gamba_warp.kernels.bench.static.cubin import read_cubin
from gamba_warp.kernels.bench.static.dry_run import MULTIPROCESSORS
from gamba_warp.kernels.bench.static.report import (
    CHANNELS,
    LENGTH,
    SCANS,
    Entry,
    binaries,
    find_kernels,
    static_report,
    symbol_of,
)

from .estimate import DEVICES, Shape, estimate, per_element, scan_work
from .sass import counts, disassemble, executed, find_nvdisasm, innermost, parse

# The shapes of the scan's cases, for the estimates.
SHAPES = {
    name + text: Shape(
        batch, LENGTH, CHANNELS, o.get("states", 16), o["dtype"].itemsize, not o.get("last")
    )
    for name, o in SCANS.items()
    for batch, text in ((16, ""), (1, ", in segments"))
}


def count_instructions(entry: Entry, tool: Path) -> dict[int, dict]:
    """By architecture ``loop``, what the largest innermost loop holds, and the scan's estimate."""
    found = {}
    for arch, path in binaries(entry.launch).items():
        symbol = symbol_of(entry.launch, read_cubin(path.read_bytes()))
        code = parse(disassemble(tool, path), symbol)
        found[arch] = {"loop": dict(counts(code, innermost(code)))}
        if entry.op != "scan":
            continue
        device, shape = DEVICES[arch], SHAPES[entry.case]
        work = scan_work(entry.name, shape, MULTIPROCESSORS)
        total = executed(code, work.turns) if work else None
        if work is None or total is None:
            continue
        least = estimate(device, work, total)
        found[arch]["per_element"] = per_element(work, total)
        found[arch]["estimate"] = asdict(least) | {"ms": least.ms, "limit": least.limit}
    return found


def report(say: Callable[[str], None] = lambda kernel: None) -> dict:
    """The document of ``static_report`` with more, where there is a disassembler.

    Returns:
        It with ``devices`` and ``scan``, and in its kernels ``loop``, ``per_element`` and
        ``estimate``.
    """
    document = static_report(say)
    document["devices"] = {f"sm_{arch}": asdict(device) for arch, device in DEVICES.items()}
    document["scan"] = {"length": LENGTH, "channels": CHANNELS}
    tool = find_nvdisasm()
    if tool is None:
        return document
    rows = iter(document["kernels"])
    for entry in find_kernels():
        for found in count_instructions(entry, tool).values():
            next(rows).update(found)
    return document
