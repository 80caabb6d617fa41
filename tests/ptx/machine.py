"""The interpreter's library, built at first use, and its structures as ``machine.cpp`` has them."""

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from ctypes import POINTER, c_int32, c_int64, c_uint64
from pathlib import Path

import warp as wp

_SOURCES = [Path(__file__).with_name(name) for name in ("machine.cpp", "opcodes.h")]
# Products are contracted with sums only where an operation says so; integers overflow as in PTX.
_FLAGS = "-O2 -march=native -ffp-contract=off -fno-math-errno -fwrapv -std=c++17 -shared -fPIC"

SPECIAL = ("%tid.x", "%ntid.x", *(f"%ctaid.{x}" for x in "xyz"), *(f"%nctaid.{x}" for x in "xyz"))
SPECIAL += ("%laneid",)
LOCAL = 2 << 56
FAULTS = (
    "out of bounds",
    "misaligned",
    "depends on what nobody wrote",
    "race in shared memory",
    "race in global memory",
    "divergent barrier",
    "deadlock",
    "mask of lanes that are not there",
    "no end",
)


class Missing(Exception):
    """What is needed to execute PTX is not on this machine; the reason."""


class Refused(Exception):
    """The PTX has what the interpreter does not know, by its name."""


def _structure(**fields):
    return type("Structure", (ctypes.Structure,), {"_fields_": [*fields.items()]})


_place = dict.fromkeys(("op", "guard", "inverted", "target", "writes", "reads"), c_int32)
_access = ("space", "size", "vector", "is_signed", "wide", "wide_address")
Instruction = _structure(
    **_place, to=c_int32 * 4, sources=c_int32 * 5, **dict.fromkeys(_access, c_int32), offset=c_int64
)
Constant = _structure(at=c_int64, value=c_uint64, wide=c_int64)
Array = _structure(base=c_uint64, size=c_uint64, unit=c_int64)
Finding = _structure(
    **dict.fromkeys(("fault", "at", "block", "thread"), c_int32), address=c_uint64, times=c_int64
)
_sizes = ("instructions", "constant_count", "file_size", "params_size", "array_count")
Launch = _structure(
    code=POINTER(Instruction),
    constants=POINTER(Constant),
    params=ctypes.c_void_p,
    arrays=POINTER(Array),
    **dict.fromkeys((*_sizes, "shared_size", "local_size", "threads"), c_int64),
    grid=c_int64 * 3,
    special=c_int64 * len(SPECIAL),
    seed=c_uint64,
    approximate=c_uint64,
    limit=c_int64,
    findings=POINTER(Finding),
    most_findings=c_int64,
    found=c_int64,
    executed=POINTER(c_int64),
    steps=c_int64,
)


@functools.cache
def library() -> ctypes.CDLL:
    """The interpreter, from Warp's folder of compiled kernels or built into it.

    Raises:
        Missing: there is no NVRTC or no compiler, it fails, or the folder cannot be written.
    """
    wp.init()
    if wp.get_cuda_toolkit_version() is None:
        raise Missing("no NVRTC: this build of warp-lang cannot compile for CUDA")
    compiler = next(filter(None, map(shutil.which, ("g++", "clang++"))), None)
    if compiler is None:
        raise Missing("no C++ compiler (g++ or clang++)")
    text = b"".join(path.read_bytes() for path in _SOURCES) + f"{compiler} {_FLAGS}".encode()
    folder = Path(wp.config.kernel_cache_dir)
    path = folder / f"gamba-warp-ptx-{hashlib.sha256(text).hexdigest()[:16]}.so"
    try:
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder) as made:  # two processes may build it
                new = Path(made) / path.name
                command = [compiler, *_FLAGS.split(), str(_SOURCES[0]), "-o", str(new)]
                subprocess.run(command, check=True, capture_output=True, text=True)
                os.replace(new, path)
    except subprocess.CalledProcessError as error:
        raise Missing(f"{compiler}: {error.stderr.strip().splitlines()[-1]}") from error
    except OSError as error:
        raise Missing(f"the interpreter cannot be kept: {error}") from error
    made = ctypes.CDLL(str(path))
    made.opcode_name.restype = made.opcode_operands.restype = ctypes.c_char_p
    return made


@functools.cache
def opcodes() -> dict[str, tuple[int, str, int]]:
    """Of each operation its number, its operands' widths, and how many of them it writes."""
    names = iter(lambda: library().opcode_name(len(found)), None)
    found: dict[str, tuple[int, str, int]] = {}
    for name in names:
        number = len(found)
        operands = library().opcode_operands(number).decode()
        found[name.decode()] = number, operands, library().opcode_writes(number)
    return found
