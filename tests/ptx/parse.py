"""PTX as text to a program that ``machine.cpp`` executes: one for each entry of a module.

Registers, constants and special registers lie in a warp's file, a slot for each lane; operands are
places in it. What is not known, an operation or a kind of operand, is refused by its name.
"""

import ctypes
import re
from dataclasses import dataclass, field

from .machine import LOCAL, SPECIAL, Constant, Instruction, Refused, opcodes

SPACES = ("", "global", "shared", "local", "param")  # as Space of machine.cpp
NEWEST = 9  # major version of PTX whose text this reads
_SIZES = {"b8": 1, "u8": 1, "s8": 1, "b16": 2, "u16": 2, "s16": 2, "pred": 4, "b32": 4, "u32": 4}
_SIZES |= {"s32": 4, "f32": 4, "b64": 8, "u64": 8, "s64": 8, "f64": 8}
_WIDE = {"b64", "u64", "s64", "f64"}
# What an access says of caches, or of the order in which others see it.
_IGNORED = {"nc", "relaxed", "gpu", "cta", "sys", "weak", "volatile", "ca", "cg", "cs"}
_DECLARATION = re.compile(r"\.(shared|local)\s+\.align\s+(\d+)\s+\.b8\s+([\w$]+)\[(\d*)\]")
_PARAMETER = re.compile(r"\.param\s+(?:\.align\s+(\d+)\s+)?\.(\w+)\s+([\w$]+)(?:\[(\d+)\])?")
_ENTRY = re.compile(r"\.entry\s+([\w$]+)\s*\((.*?)\)([^{;]*)\{", re.S)


@dataclass(eq=False)
class Program:
    """An entry, decoded.

    Attributes:
        name: of the entry.
        text: a line for each instruction.
        code: the instructions.
        constants: what lies in a warp's file at the beginning.
        file_size: bytes of a warp's file.
        params: places and sizes of the parameters, and their size together.
        shared_size: bytes of shared memory that the text declares; what a launch adds follows.
        shared_unit: it is watched by 1 << this bytes: 2 where an access may be smaller than 4.
        local_size: bytes of a thread's own memory.
        special: places of ``SPECIAL`` in a warp's file, or -1.
        most_threads: of a block, or 0.
    """

    name: str
    text: list[str] = field(default_factory=list)
    code: ctypes.Array | None = None
    constants: ctypes.Array | None = None
    file_size: int = 0
    params: list[tuple[int, int]] = field(default_factory=list)
    params_size: int = 0
    shared_size: int = 0
    shared_unit: int = 2
    local_size: int = 0
    special: list[int] = field(default_factory=list)
    most_threads: int = 0


def read(text: str, entries: str = "") -> dict[str, Program]:
    """The programs of a module's PTX, by the names of their entries.

    Args:
        text: the module.
        entries: a regular expression that is in the names of those wanted.

    Raises:
        Refused: the text has what is not known here, which the error names.
    """
    text = re.sub(r"/\*.*?\*/|//[^\n]*", "", text.replace("\0", ""), flags=re.S)
    version = re.search(r"\.version\s+((\d+)\.\d+)", text)
    if version is None or int(version[2]) > NEWEST:
        raise Refused(f"PTX of version {version and version[1]}, known is {NEWEST}")
    shared = _DECLARATION.findall(text[: text.find(".entry")])
    programs = {}
    for found in _ENTRY.finditer(text):
        if not re.search(entries, found[1]):
            continue
        depth, end = 1, found.end()
        while depth:
            depth += {"{": 1, "}": -1}.get(text[end], 0)
            end += 1
        programs[found[1]] = _Entry(*found.groups()).read(text[found.end() : end - 1], shared)
    return programs


def _up(at: int, align: int) -> int:
    return -(-at // align) * align


class _Entry:
    """State while an entry is read: places by names."""

    def __init__(self, name: str, parameters: str, attributes: str):
        self.program = Program(name)
        self.symbols: dict[str, int] = {}
        self.registers: dict[str, tuple[int, bool]] = {}  # place and whether it is wide
        self.wide: dict[str, bool] = {name: False for name in SPECIAL}  # names, or how they begin
        self.constants: dict[tuple[int, bool], int] = {}
        most = re.search(r"\.maxntid\s+(\d+)", attributes)
        self.program.most_threads = int(most[1]) if most else 0
        at = 0
        for align, kind, symbol, count in _PARAMETER.findall(parameters):
            size = _SIZES[kind] * int(count or 1)
            at = _up(at, int(align or size))
            self.program.params.append((at, size))
            self.symbols[symbol] = at
            at += size
        self.program.params_size = at

    def read(self, body: str, shared: list[tuple[str, str, str, str]]) -> Program:
        program, labels, statements = self.program, {}, []
        scopes: list[dict[str, str]] = []  # of inline code: names of registers, as known here
        for statement in body.split(";"):
            while found := re.match(r"\s*([{}]|([\w$]+):)", statement):
                if found[2]:
                    labels[found[2]] = len(statements)
                elif found[1] == "{":
                    scopes.append({})
                elif scopes:
                    scopes.pop()
                statement = statement[found.end() :]
            statement = statement.strip()
            if declared := re.match(r"\.reg\s+\.(\w+)\s+(.*)", statement, re.S):
                for register in re.split(r"\s*,\s*", declared[2]):
                    name = register.split("<")[0]
                    if scopes:
                        scopes[-1][name] = name = f"%{name.lstrip('%')}_{len(self.wide)}_"
                    self.wide[name] = declared[1] in _WIDE
                continue
            for own in scopes:
                statement = re.sub(r"%?\w+", lambda m, own=own: own.get(m[0], m[0]), statement)
            if declared := _DECLARATION.match(statement):
                self._declare(*declared.groups())
            elif quotient := re.match(r"div\.approx(\.ftz)?\.f32\s+(\S+), (\S+), (\S+)", statement):
                # as ptxas has it, in two instructions
                self.wide["%inverse_"] = False
                statements.append(f"rcp.approx.ftz.f32 %inverse_, {quotient[4]}")
                statements.append(f"mul.ftz.f32 {quotient[2]}, {quotient[3]}, %inverse_")
            elif statement and not statement.startswith("."):
                statements.append(statement)
        statements.append("ret")
        # of those declared for all entries the one without a size comes last: a launch gives it
        for declaration in sorted(shared, key=lambda x: not x[3]):
            if declaration[2] in body:
                self._declare(*declaration)
        program.text, program.code = statements, (Instruction * len(statements))()
        for instruction, statement in zip(program.code, statements):
            try:
                self._decode(instruction, statement, labels)
            except (AttributeError, KeyError, ValueError, IndexError) as error:
                raise Refused(f"{program.name}: {statement!r}: {error!r}") from error
        kinds = [opcodes()[name][0] for name in ("ld", "st")]
        accesses = (i for i in program.code if i.op in kinds and SPACES[i.space] in ("", "shared"))
        if any(i.size < 4 for i in accesses):
            program.shared_unit = 1
        program.special = [self.registers.get(name, (-1,))[0] for name in SPECIAL]
        found = [(at, value, wide) for (value, wide), at in self.constants.items()]
        program.constants = (Constant * len(found))(*found)
        return program

    def _declare(self, space: str, align: str, name: str, size: str) -> None:
        at = _up(getattr(self.program, f"{space}_size"), int(align))
        self.symbols[name] = at + (LOCAL if space == "local" else 0)
        setattr(self.program, f"{space}_size", _up(at + int(size or 0), 4))

    def _room(self, wide: bool) -> int:
        at = self.program.file_size
        self.program.file_size += 256 if wide else 128
        return at

    def _is_wide(self, register: str) -> bool:
        if register not in self.wide:
            register = register.rstrip("0123456789")
        return self.wide[register]

    def _place(self, operand: str, wide: bool) -> int:
        """Return the place of a register, number or address in the file."""
        if operand.startswith("%"):
            if operand not in self.registers:
                self.registers[operand] = self._room(self._is_wide(operand)), self._is_wide(operand)
            at, found = self.registers[operand]
            if found != wide:
                raise ValueError(f"{operand} has {64 if found else 32} bits")
            return at
        if operand.startswith(("0f", "0d")):
            value = int(operand[2:], 16)
        elif re.fullmatch(r"-?\d\w*", operand):
            value = int(operand.rstrip("U"), 0)
        else:
            name, _, more = operand.partition("+")
            value = self.symbols[name] + int(more or 0)
        key = value & (2**64 - 1 if wide else 2**32 - 1), wide
        if key not in self.constants:
            self.constants[key] = self._room(wide)
        return self.constants[key]

    def _decode(self, i: Instruction, statement: str, labels: dict[str, int]) -> None:
        guard, name, rest = re.match(r"(?:@(!?%\w+)\s+)?([\w.]+)\s*(.*)", statement, re.S).groups()
        i.guard, i.inverted = -1, bool(guard and guard[0] == "!")
        if guard:
            i.guard = self._place(guard.lstrip("!"), False)
        operands = [x for x in re.split(r"[\s,{}|]+", rest) if x]
        first, *words = name.split(".")
        if first == "bra":
            i.op, i.target = opcodes()["bra"][0], labels[operands[0]]
            return
        if name in ("bar.sync", "barrier.sync", "bar.red.popc.u32"):
            if operands.pop(len(words) > 1) != "0":
                raise ValueError("a barrier with a number")
            name = name.replace("barrier", "bar")
        if first in ("ld", "st", "atom"):
            words = [x for x in words if x not in _IGNORED]
            space = words.pop(0) if words[0] in SPACES else ""
            i.space, i.vector = SPACES.index(space), 1
            (address,) = (x for x in operands if x.startswith("["))
            (address, offset) = re.fullmatch(r"\[([%\w$]+)(?:\+(-?\w+))?\]", address).groups()
            i.offset = int(offset or "0", 0)
            i.wide_address = not address.startswith("%") or self._is_wide(address)
            operands = [address if x.startswith("[") else x for x in operands]
            if words[0] in ("v2", "v4"):
                i.vector = int(words.pop(0)[1:])
            i.size, i.is_signed = _SIZES[words[-1]], words[-1][0] == "s"
            name = ".".join([first, *words]) if first == "atom" else first
        if first == "cvt" and words[-1][1:] == "32" and self._is_wide(operands[1]):
            name += " of 64"  # the lower half of a register
        if first == "mov" and "{" in rest:
            name += " to 2" if rest[0] == "{" else " of 2"
        if first == "shfl" and "|" not in rest:
            self.wide["%inside_"] = False  # which nobody reads
            operands.insert(1, "%inside_")
        if name not in opcodes():
            raise ValueError(f"{name} is not known")
        i.op, widths, i.writes = opcodes()[name]
        if first in ("ld", "st"):
            values = operands[:-1] if first == "ld" else operands[1:]
            registers = [x for x in values if x.startswith("%")]
            i.wide = self._is_wide(registers[0]) if registers else i.size == 8
            i.writes = i.vector if first == "ld" else 0
            widths = ["Q" if i.wide else "W"] * (i.vector + 1)
            widths[i.writes] = "Q" if i.wide_address else "W"
        if len(operands) != len(widths):
            raise ValueError(f"{len(operands)} operands, known are {len(widths)}")
        places = [self._place(x, width == "Q") for x, width in zip(operands, widths)]
        i.reads = len(places) - i.writes
        for k, at in enumerate(places):
            if k < i.writes:
                i.to[k] = at
            else:
                i.given[k - i.writes] = at
