"""Page of the report of ``make instructions``: that of ``gamba bench --static``, extended."""

from __future__ import annotations

from gamba_warp.kernels.bench.static.report import full_name, static_markdown
from gamba_warp.kernels.runtime import tables

_NO_DISASSEMBLER = """
No disassembler was found (nvdisasm on PATH, in CUDA_HOME or inside Triton): instructions are not
counted here, and no times are estimated.
"""
_LOOPS = """
Instructions in the largest innermost loop of {}, by kind. **memory** counts 32-bit words of a
thread through the load and store unit. **convert** holds packing; a bfloat16 is widened by a shift,
which is in **integer** with addresses, comparisons and selections. **multiply** holds integer
products and moves of constants, which the float unit executes.
"""
_KINDS = ("float", "special", "integer", "multiply", "convert", "global", "shared", "local")
_KINDS += ("shuffle", "barrier", "tensor")


def _table(header: list[str], rows: list[list[object]]) -> str:
    return tables.markdown(header, [[*map(str, row)] for row in rows])


def loops(document: dict) -> list[str]:
    """Content of the hottest loop of each kernel."""
    arch = list(document["machines"])[-1]
    rows = [r for r in document["kernels"] if r["arch"] == arch and "loop" in r]
    if not rows:
        return ["## Instructions", _NO_DISASSEMBLER]
    table: list[list[object]] = []
    for row in rows:
        loop = row["loop"]
        every = sum(loop.values()) - loop.get("passes", 0)
        kinds = [loop.get(kind, 0) for kind in _KINDS]
        table.append([full_name(row), row["case"], every, *kinds, loop.get("passes", 0)])
    header = ["kernel", "case", "all", *_KINDS, "memory"]
    return ["## Instructions of the hottest loop", _LOOPS.format(arch), _table(header, table), ""]


_ESTIMATES = """
**Estimates from counts, not measurements.** The instructions of each loop in the disassembly, times
how often that loop turned when the kernel's PTX was executed ({tokens} tokens, {width} channels;
two segments where the case says "in segments"): ptxas keeps PTX's loops, so its numbers of
instructions and exact turns go together (what a branch skips counts in part, as in PTX on average).
Every unit works in every cycle; the busiest sets the time, on the multiprocessor with the most
blocks. Stalls, barriers and misses are not in it: a real time is longer. The shape has {length}
tokens and {channels} channels, and 16 sequences, or one where it says "in segments"; there
`scan_forward` is the walk that gives each segment's last state. Milliseconds. **L1** is the cache
and shared memory together, 128 bytes per cycle; lanes that read the same word share it. **per
element** are instructions of a thread for one (batch, token, channel, state).

{devices}
"""
_LIMITS = ("issue", "special", "float32", "integer", "L1", "dram")


def estimates(document: dict) -> list[str]:
    """Least times of the scan's kernels; empty without a disassembler."""
    rows = [row for row in document["kernels"] if "estimate" in row]
    if not rows:
        return []
    devices = "\n".join(
        f"- {arch}: {d['name']}, {d['multiprocessors']} multiprocessors of 4 schedulers,"
        f" {d['float_lanes']} float, 64 integer and 16 special lanes,"
        f" {d['clock'] / 1e9:.2f} GHz, {d['bandwidth'] / 1e12:.2f} TB/s."
        for arch, d in document["devices"].items()
    )
    header = ["kernel", "case", "arch", "per element", "special", "float", "integer"]
    header += [f"{name}, ms" for name in _LIMITS] + ["least, ms", "limit"]
    table: list[list[object]] = []
    for row in rows:
        found, each = row["estimate"], row["per_element"]
        kinds = [f"{each.get(kind, 0):.2f}" for kind in ("all", "special", "float", "integer")]
        limits = [f"{found[name]:.2f}" for name in _LIMITS]
        last = [f"**{found['ms']:.2f}**", found["limit"]]
        table.append([full_name(row), row["case"], row["arch"], *kinds, *limits, *last])
    text = _ESTIMATES.format(devices=devices, **document["scan"])
    return [
        "## Least times of the scan, estimated",
        text,
        _table(header, table),
        "",
    ]


def markdown(document: dict) -> str:
    """Page of the documents of ``report``."""
    text = static_markdown(document, "make instructions")
    return "\n".join([text, *loops(document), *estimates(document)])
