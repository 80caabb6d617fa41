"""Instructions of a kernel from a disassembler, with their kinds and loops.

``nvdisasm`` is part of CUDA's toolkit and of Triton. Loops are natural loops: those of a jump back
to a dominator of the jump.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

# Operations of each kind, by their name before the first dot. Others are "integer" (with
# comparisons, selections and bits), or "uniform" if they begin with U.
KINDS = {
    "float": ("FADD", "FMUL", "FFMA", "FADD32I", "FMUL32I", "FFMA32I"),
    "special": ("MUFU",),
    "multiply": ("IMAD", "HFMA2", "HADD2", "HMUL2"),  # on the float unit; moves constants as well
    "convert": ("F2F", "F2FP", "F2I", "I2F", "I2FP", "F2IP", "FRND"),
    "global": ("LDG", "STG", "LD", "ST", "RED", "ATOM", "ATOMG", "LDGSTS"),
    "shared": ("LDS", "STS", "ATOMS", "LDSM"),
    "local": ("LDL", "STL"),
    "shuffle": ("SHFL", "REDUX", "VOTE", "MATCH"),
    "constant": ("LDC",),
    "barrier": ("BAR", "WARPSYNC", "DEPBAR", "LDGDEPBAR", "MEMBAR"),
    "jump": ("BRA", "BSSY", "BSYNC", "EXIT", "CALL", "RET", "BREAK", "BRX", "JMP", "NOP", "BMOV"),
    "tensor": ("HMMA", "IMMA", "DMMA", "HGMMA"),
    "uniform": (),
    "integer": (),
}
_KIND = {operation: kind for kind, operations in KINDS.items() for operation in operations}
_MEMORY = ("global", "shared", "local", "shuffle")
_LINE = re.compile(r"\s*/\*([0-9a-f]{4,})\*/\s+(?:@!?U?P\w+\s+)?([A-Z][\w.]*)\s*([^;]*);")
_JUMPS = ("BRA", "BRA.", "CALL")  # sm_80 jumps far with a call that never returns
_LABEL = re.compile(r"(\.L_\w+):")
_TARGET = re.compile(r"`\((\.L_\w+)\)")


@dataclass(frozen=True)
class Instruction:
    """One instruction.

    Attributes:
        operation: with its modifiers, e.g. "LDS.128".
        always: it has no condition.
        target: index of its jump target, or None.
    """

    operation: str
    always: bool
    target: int | None

    @property
    def kind(self) -> str:
        """One of ``KINDS``."""
        name = self.operation.split(".")[0]
        return _KIND.get(name, "uniform" if name[0] == "U" or name == "R2UR" else "integer")

    @property
    def passes(self) -> int:
        """32-bit words of a thread that go through the load and store unit; 0 for other units."""
        if self.kind not in _MEMORY:
            return 0
        modifiers = self.operation.split(".")[1:]
        return 4 if "128" in modifiers else 2 if "64" in modifiers else 1


@dataclass(frozen=True)
class Loop:
    """A natural loop.

    Attributes:
        first: index of its first instruction, where every iteration begins.
        body: indices of its instructions, including those of inner loops.
        inside: inner loops, in order.
    """

    first: int
    body: frozenset[int]
    inside: tuple[Loop, ...]


def find_nvdisasm() -> Path | None:
    """Find NVIDIA's disassembler: on PATH, in CUDA_HOME or CUDA_PATH, or inside Triton."""
    folders = [
        Path(os.environ[name]) / "bin"
        for name in ("CUDA_HOME", "CUDA_PATH")
        if os.environ.get(name)
    ]
    triton = importlib.util.find_spec("triton")
    if triton is not None and triton.origin:
        folders.append(Path(triton.origin).parent / "backends" / "nvidia" / "bin")
    found = shutil.which("nvdisasm")
    if found is None:
        found = shutil.which("nvdisasm", path=os.pathsep.join(map(str, folders)))
    return Path(found) if found else None


def disassemble(tool: Path, cubin: Path) -> str:
    """Return the output of ``nvdisasm -c`` for a binary.

    Raises:
        ValueError: the tool fails, for example if it is older than the binary.
    """
    done = subprocess.run([tool, "-c", cubin], capture_output=True, encoding="utf-8")
    if done.returncode:
        raise ValueError(f"{tool.name} fails: {done.stderr.strip().splitlines()[-1:]}")
    return done.stdout


def parse(text: str, kernel: str) -> list[Instruction]:
    """Parse the instructions of a kernel, including the functions that it calls.

    Args:
        text: result of ``disassemble``.
        kernel: its symbol.

    Raises:
        ValueError: the text has no such kernel.
    """
    _, found, rest = text.partition(f"\n.text.{kernel}:")
    if not found:
        raise ValueError(f"the disassembly has no kernel {kernel}")
    lines: list[tuple[str, bool, str]] = []
    labels: dict[str, int] = {}
    for line in rest.splitlines():
        if ".section" in line:
            break
        if label := _LABEL.match(line):
            labels[label[1]] = len(lines)
        elif code := _LINE.match(line):
            lines.append((code[2], "@" not in line.split("*/")[1].split(code[2])[0], code[3]))
    found_targets = [_TARGET.search(operands) for _, _, operands in lines]
    return [
        Instruction(name, always, labels.get(to[1]) if to and name[:4] in _JUMPS else None)
        for (name, always, _), to in zip(lines, found_targets)
    ]


def _next(code: Sequence[Instruction], i: int) -> Iterator[int]:
    """Yield the successors of instruction i."""
    target = code[i].target
    if target is not None:
        yield target
    name = code[i].operation.split(".")[0]
    leaves = name in ("BRA", "EXIT", "RET", "BRX") or (
        name == "CALL" and code[i].target is not None
    )
    if i + 1 < len(code) and not (leaves and code[i].always):
        yield i + 1


def find_loops(code: Sequence[Instruction]) -> tuple[Loop, ...]:
    """Find the outermost loops of a kernel, with their inner loops."""
    before: list[list[int]] = [[] for _ in code]
    for i in range(len(code)):
        for j in _next(code, i):
            before[j].append(i)
    bodies: dict[int, set[int]] = {}
    for i, instruction in enumerate(code):
        start = instruction.target
        if start is None or start >= i:
            continue
        body, pending = {start}, [i]  # instructions that reach the jump without passing its target
        while pending:
            at = pending.pop()
            if at not in body:
                body.add(at)
                pending += before[at]
        if 0 not in body or start == 0:  # else a path from the entry avoids the target: not a loop
            bodies[start] = bodies.get(start, set()) | body
    return _nest([(start, frozenset(body)) for start, body in sorted(bodies.items())])


def _nest(bodies: list[tuple[int, frozenset[int]]]) -> tuple[Loop, ...]:
    outer = [
        (start, body)
        for start, body in bodies
        if not any(start in other and body < other for _, other in bodies)
    ]
    return tuple(
        Loop(start, body, _nest([(s, b) for s, b in bodies if s in body and b < body]))
        for start, body in outer
    )


def counts(code: Sequence[Instruction], body: frozenset[int] | None = None) -> Counter[str]:
    """Count instructions of each kind, and "passes"; of all the code or of a part."""
    chosen = code if body is None else [code[i] for i in sorted(body)]
    total = Counter(instruction.kind for instruction in chosen)
    total["passes"] = sum(instruction.passes for instruction in chosen)
    return total


def innermost(code: Sequence[Instruction]) -> frozenset[int]:
    """Body of the largest innermost loop; of a kernel without loops, all of it."""

    def leaves(loops: Sequence[Loop]) -> Iterator[frozenset[int]]:
        for loop in loops:
            yield from leaves(loop.inside) if loop.inside else (loop.body,)

    return max(leaves(find_loops(code)), key=len, default=frozenset(range(len(code))))


def executed(
    code: Sequence[Instruction], ptx: Sequence[Instruction], times: Sequence[int]
) -> dict[str, float]:
    """Estimate the instructions of each kind executed by the warps.

    ptxas keeps the loops of PTX. Each instruction of a loop is assumed to be executed as often as
    those of the same loop in PTX on average, so branches skipped by some warps count in part.

    Args:
        code: of the kernel.
        ptx: its PTX. At each level the largest loops of both are matched in order; the code of an
            unmatched loop belongs to the enclosing one.
        times: number of warps that executed each instruction of the PTX.
    """
    total: dict[str, float] = defaultdict(float)

    def add(mine: Loop, theirs: Loop) -> None:
        same = min(len(mine.inside), len(theirs.inside))
        pairs = [*zip(_largest(mine.inside, same), _largest(theirs.inside, same))]
        body = mine.body.difference(*(loop.body for loop, _ in pairs))
        like = theirs.body.difference(*(loop.body for _, loop in pairs))
        turns = sum(times[i] for i in like) / len(like)
        for kind, number in counts(code, body).items():
            total[kind] += number * turns
        for pair in pairs:
            add(*pair)

    wholes = (Loop(0, frozenset(range(len(x))), find_loops(x)) for x in (code, ptx))
    add(*wholes)
    return dict(total)


def _largest(loops: Sequence[Loop], count: int) -> list[Loop]:
    chosen = sorted(loops, key=lambda loop: len(loop.body), reverse=True)[:count]
    return sorted(chosen, key=lambda loop: loop.first)
