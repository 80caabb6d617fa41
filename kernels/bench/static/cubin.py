"""What a compiled CUDA binary says of its kernels, read from the file itself.

A cubin is an ELF file. Attributes in ``.nv.info`` hold registers and stack, the sizes of
``.nv.shared.*`` sections the static shared memory, and ``.text.*`` the instructions, 16 bytes each
from sm_70 on, with the operation in the lowest 12 bits.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

_SYMBOLS = 2  # section type
_REGISTERS, _FRAME = 0x2F, 0x11  # attributes
_LOAD_LOCAL, _STORE_LOCAL = 0x983, 0x387  # operations LDL and STL
_STACK_POINTER = 1  # register R1
RESERVED = 1024  # bytes of shared memory that the system takes per block, from sm_80 on


@dataclass(frozen=True)
class Section:
    """A part of the file.

    Attributes:
        name: e.g. ".text.KERNEL".
        kind: the ELF type.
        data: its bytes; empty for memory that is only reserved.
        size: of it, or of the memory that it reserves.
    """

    name: str
    kind: int
    data: bytes
    size: int


@dataclass(frozen=True)
class Resources:
    """What a kernel takes.

    Attributes:
        registers: of a thread.
        frame: bytes of stack of a thread, in local memory: arrays that are indexed at run time,
            and spilled registers.
        shared: static shared memory of a block, bytes, without what the system reserves.
        instructions: of the kernel, those of functions it calls not counted.
        local_loads: instructions that load from local memory.
        local_stores: instructions that store to it.
        reloads: of ``local_loads`` those at a fixed place of the stack, which is how a spilled
            register is fetched; no kernel has more spills than these.
    """

    registers: int
    frame: int
    shared: int
    instructions: int
    local_loads: int
    local_stores: int
    reloads: int


def read_cubin(cubin: bytes) -> dict[str, Resources]:
    """The kernels of a binary by name.

    Raises:
        ValueError: not an ELF file of 64 bits, or a damaged one.
    """
    if cubin[:5] != b"\x7fELF\x02":
        raise ValueError("not a cubin: no ELF file of 64 bits")
    try:
        return _read(list(sections(cubin)))
    except (struct.error, LookupError, ValueError) as error:
        raise ValueError(f"a damaged cubin: {error}") from error


def _read(parts: list[Section]) -> dict[str, Resources]:
    by_name = {part.name: part for part in parts}
    names = _symbols(parts)
    info = list(_attributes(by_name[".nv.info"].data)) if ".nv.info" in by_name else []
    registers = {names[i]: value for kind, i, value in info if kind == _REGISTERS}
    frames = {names[i]: value for kind, i, value in info if kind == _FRAME}
    hidden = RESERVED if ".nv.shared.reserved.0" in by_name else 0  # then the sections hold it too
    kernels = {}
    for name, part in by_name.items():
        kernel = name.removeprefix(".text.")
        if kernel == name or kernel not in registers or f".nv.info.{kernel}" not in by_name:
            continue
        shared = by_name.get(f".nv.shared.{kernel}")
        kernels[kernel] = Resources(
            registers[kernel],
            frames.get(kernel, 0),
            max(0, shared.size - hidden) if shared else 0,
            len(part.data) // 16,
            *_local(part.data),
        )
    return kernels


def sections(elf: bytes) -> Iterator[Section]:
    """Yields the sections of an ELF file of 64 bits."""
    (table,) = struct.unpack_from("<Q", elf, 40)
    size, count, names = struct.unpack_from("<HHH", elf, 58)
    (strings,) = struct.unpack_from("<Q", elf, table + names * size + 24)
    for i in range(count):
        name, kind, _, _, start, length = struct.unpack_from("<IIQQQQ", elf, table + i * size)
        data = b"" if kind == 8 else elf[start : start + length]  # 8: takes no room in the file
        yield Section(_text(elf, strings + name), kind, data, length)


def _text(data: bytes, start: int) -> str:
    return data[start : data.index(b"\0", start)].decode()


def _symbols(parts: list[Section]) -> list[str]:
    """Names of the symbols in the order of the table."""
    strings = [part.data for part in parts if part.name == ".strtab"][0]
    table = [part.data for part in parts if part.kind == _SYMBOLS][0]
    return [
        _text(strings, struct.unpack_from("<I", table, at)[0]) for at in range(0, len(table), 24)
    ]


def _attributes(info: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields attribute, symbol and value of those that belong to a symbol."""
    at = 0
    while at < len(info):
        form, attribute, payload = struct.unpack_from("<BBH", info, at)
        if form == 4 and payload == 8:  # else the value is in the place of the length
            yield attribute, *struct.unpack_from("<II", info, at + 4)
        at += 4 + (payload if form == 4 else 0)


def _local(code: bytes) -> tuple[int, int, int]:
    """Loads and stores of local memory, and those of the loads that are at a fixed place."""
    loads = stores = fixed = 0
    for (word,) in struct.iter_unpack("<Q8x", code):
        operation = word & 0xFFF
        loads += operation == _LOAD_LOCAL
        stores += operation == _STORE_LOCAL
        fixed += operation == _LOAD_LOCAL and word >> 24 & 0xFF == _STACK_POINTER
    return loads, stores, fixed
