"""The report of ``gamba bench --static`` as a page."""

from __future__ import annotations

from collections.abc import Callable

_EXPLANATION = """
Written by `gamba bench --static`, not by hand: the kernels were compiled ahead of time, and the
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


def static_markdown(document: dict) -> str:
    """The report as a page with one table per op."""
    versions = ", ".join(f"{name} {version}" for name, version in document["versions"].items())
    text = _EXPLANATION.format(" and ".join(document["machines"]))
    lines = ["# What the CUDA kernels take", text, f"{versions}.", ""]
    header, columns = ["kernel", "case", *_COLUMNS], _COLUMNS.values()
    tables: dict[str, dict[tuple, list[dict]]] = {}
    for row in document["kernels"]:
        name = f"`{row['kernel']}`" + (" (gradient)" if row["direction"] == "gradient" else "")
        tables.setdefault(row["op"], {}).setdefault((name, row["case"]), []).append(row)
    for op, table in tables.items():
        lines += [f"## {op}", "", f"| {' | '.join(header)} |", "|" + " --- |" * len(header)]
        for names, rows in table.items():
            cells = [" / ".join(dict.fromkeys(str(c(row)) for row in rows)) for c in columns]
            lines.append(f"| {' | '.join([*names, *cells])} |")
        lines.append("")
    return "\n".join(lines + _loops(document) + _estimates(document))


def _table(header: list[str], rows: list[list[object]]) -> list[str]:
    lines = [f"| {' | '.join(header)} |", "|" + " --- |" * len(header)]
    return lines + [f"| {' | '.join(map(str, row))} |" for row in rows] + [""]


def _name(row: dict) -> str:
    return f"`{row['kernel']}`" + (" (gradient)" if row["direction"] == "gradient" else "")


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


def _loops(document: dict) -> list[str]:
    arch = list(document["machines"])[-1]
    rows = [r for r in document["kernels"] if r["arch"] == arch and "loop" in r]
    if not rows:
        return ["## Instructions", _NO_DISASSEMBLER]
    table: list[list[object]] = []
    for row in rows:
        loop = row["loop"]
        every = sum(loop.values()) - loop.get("passes", 0)
        kinds = [loop.get(kind, 0) for kind in _KINDS]
        table.append([_name(row), row["case"], every, *kinds, loop.get("passes", 0)])
    header = ["kernel", "case", "all", *_KINDS, "memory"]
    return ["## Instructions of the hottest loop", _LOOPS.format(arch), *_table(header, table)]


_ESTIMATES = """
**Estimates from counts, not measurements.** Each loop turns as often as the shape says, conditions
are all taken to hold, and every unit works in every cycle; the busiest sets the time, on the
multiprocessor with the most blocks. Stalls, barriers, bank conflicts and misses are not in it: a
real time is longer. The shape has {length} tokens and {channels} channels, and 16 sequences, or
one where it says "in segments". Milliseconds; **memory** is a bound from above, as words that
threads share count for each of them, and does not set the time. **per element** are instructions of
a thread for one (batch, token, channel, state).

{devices}
"""
_LIMITS = ("issue", "special", "float32", "integer", "dram", "memory")


def _estimates(document: dict) -> list[str]:
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
        table.append([_name(row), row["case"], row["arch"], *kinds, *limits, *last])
    text = _ESTIMATES.format(devices=devices, **document["scan"])
    return ["## Least times of the scan, estimated", text, *_table(header, table)]
