"""Resources and instruction counts of the CUDA kernels, and least times of the scan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch
from ptx.launch import programs

from gamba_warp.kernels.bench.cases.scan_problem import make_inputs
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
from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state
from gamba_warp.kernels.selective_scan.cuda import launch
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning, choose

from .counting import Executed, count
from .estimate import ASKED, DEVICES, Shape, estimate, per_element, scan_work
from .sass import counts, disassemble, executed, find_nvdisasm, innermost, parse

# The shapes of the scan's cases, for the estimates.
SHAPES = {
    name + text: Shape(
        batch, LENGTH, CHANNELS, o.get("states", 16), o["dtype"].itemsize, not o.get("last")
    )
    for name, o in SCANS.items()
    for batch, text in ((16, ""), (1, ", in segments"))
}
# Executed part of them: whole chunks, two blocks of channels; one segment, or two for several.
TOKENS, WIDTH, SEGMENTS = 1024, 128, 2


def tuning_of(shape: Shape) -> Tuning:
    """Tuning of the kernels for a shape."""
    return choose(shape.batch, shape.length, shape.channels, shape.states, 1, MULTIPROCESSORS)


def count_scan(case: str) -> tuple[dict[str, dict[str, Executed]], Shape, Tuning]:
    """Count the instructions of a scan of ``SHAPES``, cut to ``TOKENS`` and ``WIDTH``."""
    options = SCANS[case.removesuffix(", in segments")]
    shape = replace(SHAPES[case], batch=1, length=TOKENS, channels=WIDTH)
    tuning = tuning_of(SHAPES[case])
    tuning = tuning._replace(
        segments=min(tuning.segments, SEGMENTS), back_segments=min(tuning.back_segments, SEGMENTS)
    )
    inputs = make_inputs(1, TOKENS, WIDTH, shape.states)
    inputs["initial_state"] = torch.zeros(1, WIDTH, shape.states)
    for name in ("u", "delta", "z", "B", "C"):
        inputs[name] = inputs[name].to(options["dtype"])
    call = partial(selective_scan, return_last_state=True)
    if not shape.outputs:
        inputs = {k: x for k, x in inputs.items() if k not in ("C", "D", "z")}
        call = selective_scan_state
    inputs = {k: x.requires_grad_() for k, x in inputs.items()}
    mode = {"delta_softplus": True, "discretization": options.get("mode", "mamba")}

    def run():
        found = call(**inputs, **mode)
        return found if isinstance(found, tuple) else (found,)

    before, launch.FORCED = launch.FORCED, tuning
    try:
        return count(run, inputs.values(), MULTIPROCESSORS), shape, tuning
    finally:
        launch.FORCED = before


def count_instructions(entry: Entry, tool: Path, scans: dict) -> dict[int, dict]:
    """Count the largest innermost loop, and estimate the scan, by architecture."""
    found = {}
    for arch, path in binaries(entry.launch).items():
        symbol = symbol_of(entry.launch, read_cubin(path.read_bytes()))
        code = parse(disassemble(tool, path), symbol)
        found[arch] = {"loop": dict(counts(code, innermost(code)))}
        if entry.op != "scan":
            continue
        counted, small, tuning = scans[entry.case]
        work = scan_work(entry.name, small, tuning)
        whole = scan_work(entry.name, SHAPES[entry.case], tuning_of(SHAPES[entry.case]))
        if work is None or whole is None:
            continue
        of_module, _ = programs(entry.launch.kernel.module, entry.launch.block)
        (ran,) = (x for name, x in counted[entry.direction].items() if name in of_module)
        total = executed(code, ran.code, ran.times)
        total.pop("passes")
        each = per_element(total | {name: ran.counts[name] for name in ASKED}, work)
        found[arch] |= {"per_element": each, "estimate": estimate(DEVICES[arch], whole, each)}
    return found


def report(say: Callable[[str], None] = lambda kernel: None) -> dict:
    """Extend the document of ``static_report``, if a disassembler is installed.

    Returns:
        The document with ``devices`` and ``scan``, and in its kernels ``loop``, ``per_element`` and
        ``estimate``.
    """
    document = static_report(say)
    document["devices"] = {f"sm_{arch}": asdict(device) for arch, device in DEVICES.items()}
    document["scan"] = dict(length=LENGTH, channels=CHANNELS, tokens=TOKENS, width=WIDTH)
    tool = find_nvdisasm()
    if tool is None:
        return document
    scans = {}
    for case in SHAPES:
        say(f"executed: scan, {case}")
        scans[case] = count_scan(case)
    rows = iter(document["kernels"])
    for entry in find_kernels():
        for found in count_instructions(entry, tool, scans).values():
            next(rows).update(found)
    return document
