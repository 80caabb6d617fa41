"""Registers, stack and shared memory of kernels, read from a compiled CUDA binary.

A cubin is an ELF file. Attributes in ``.nv.info`` hold registers and stack, the sizes of
``.nv.shared.*`` sections the static shared memory, and ``.text.*`` the instructions, 16 bytes each
from sm_70 on, with the operation in the lowest 12 bits.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

_SECTION = np.dtype("<u4, <u4, V16, <u8, <u8, V24")  # name, kind, .., offset, size, ..
_SYMBOL = np.dtype("<u4, V20")  # name, ..
_EMPTY = 8  # kind of a section that takes no room in the file
_REGISTERS, _FRAME = 0x2F, 0x11  # attributes
_LOAD_LOCAL = 0x983  # operation LDL
_STACK_POINTER = 1  # register R1
RESERVED = 1024  # bytes of shared memory that the system takes per block, from sm_80 on


class Resources(NamedTuple):
    """Resources of a kernel.

    Attributes:
        registers: of a thread.
        frame: bytes of stack of a thread, in local memory: arrays that are indexed at run time,
            and spilled registers.
        shared: static shared memory of a block, bytes, without what the system reserves.
        reloads: instructions that load from a fixed place of the stack, which is how a spilled
            register is fetched; no kernel has more spills than these.
    """

    registers: int
    frame: int
    shared: int
    reloads: int


def read_cubin(cubin: bytes) -> dict[str, Resources]:
    """Return the resources of a binary's kernels by name.

    Raises:
        ValueError: not an ELF file of 64 bits, or a damaged one.
    """
    if cubin[:5] != b"\x7fELF\x02":
        raise ValueError("not a cubin: no ELF file of 64 bits")
    try:
        return _read(cubin)
    except (struct.error, LookupError, ValueError) as error:
        raise ValueError(f"a damaged cubin: {error}") from error


def _read(elf: bytes) -> dict[str, Resources]:
    def text(data: bytes, start: int) -> str:
        return data[start : data.index(b"\0", start)].decode()

    (start,) = struct.unpack_from("<Q", elf, 40)
    _, count, names = struct.unpack_from("<HHH", elf, 58)
    table = np.frombuffer(elf, _SECTION, count, start).tolist()
    strings = table[names][3]
    data, sizes = {}, {}
    for name, kind, _, offset, size, _ in table:
        name = text(elf, strings + name)
        data[name] = b"" if kind == _EMPTY else elf[offset : offset + size]
        sizes[name] = size
    listed = np.frombuffer(data[".symtab"], _SYMBOL).tolist()
    symbols = [text(data[".strtab"], name) for name, _ in listed]
    found: dict[int, dict[str, int]] = {_REGISTERS: {}, _FRAME: {}}
    info, at = data.get(".nv.info", b""), 0
    while at < len(info):
        form, attribute, payload = struct.unpack_from("<BBH", info, at)
        if form == 4 and payload == 8 and attribute in found:
            symbol, value = struct.unpack_from("<II", info, at + 4)
            found[attribute][symbols[symbol]] = value
        at += 4 + (payload if form == 4 else 0)  # else the value is in the place of the length
    hidden = RESERVED if ".nv.shared.reserved.0" in data else 0  # then the sections hold it too
    kernels = {}
    for name, registers in found[_REGISTERS].items():
        if f".text.{name}" not in data or f".nv.info.{name}" not in data:
            continue
        code = np.frombuffer(data[f".text.{name}"], "<u8")[::2]
        reloads = (code & 0xFFF == _LOAD_LOCAL) & (code >> 24 & 0xFF == _STACK_POINTER)
        shared = max(0, sizes.get(f".nv.shared.{name}", 0) - hidden)
        kernels[name] = Resources(registers, found[_FRAME].get(name, 0), shared, int(reloads.sum()))
    return kernels
