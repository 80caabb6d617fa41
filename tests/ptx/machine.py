"""The interpreter's library, built at first use, and its structures as ``machine.cpp`` has them."""

import ctypes
import functools
import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import warp as wp

_SOURCES = [Path(__file__).with_name(name) for name in ("machine.cpp", "opcodes.h")]
_TEXT = "".join(path.read_text() for path in _SOURCES)
# Products are contracted with sums only where an operation says so; integers overflow as in PTX.
_FLAGS = "-O2 -ffp-contract=off -fno-math-errno -fwrapv -std=c++17 -shared -fPIC"

SPECIAL = tuple(f"%{name}.{x}" for name in ("tid", "ntid", "ctaid", "nctaid") for x in "xyz")
SPECIAL += ("%laneid", "%lanemask_lt")
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
    """A tool to execute PTX is missing on this machine; the message names it."""


class Refused(Exception):
    """The PTX has what the interpreter does not know, by its name."""


def cuda_tool(name: str) -> Path | None:
    """Return a program of CUDA's toolkit: on PATH, in CUDA_HOME or CUDA_PATH, or inside Triton."""
    homes = (os.environ.get(variable) for variable in ("CUDA_HOME", "CUDA_PATH"))
    folders = [Path(home) / "bin" for home in homes if home]
    triton = importlib.util.find_spec("triton")
    if triton is not None and triton.origin:
        folders.append(Path(triton.origin).parent / "backends" / "nvidia" / "bin")
    path = os.pathsep.join([os.environ.get("PATH", ""), *map(str, folders)])
    found = shutil.which(name, path=path)
    return Path(found) if found else None


def compiled(module, block_dim: int, **options) -> list[tuple[Path, dict]]:
    """Compile a Warp module ahead of time, for blocks of this many threads.

    Returns:
        Each binary, in Warp's folder of compiled kernels by the module's hash, and what Warp notes
        of its entries.
    """
    before = module.options["block_dim"]
    module.options["block_dim"] = block_dim
    try:
        paths = [*map(Path, wp.compile_aot_module(module, **options))]
    finally:
        module.options["block_dim"] = before
    notes = (path.with_name(f"{path.name.rsplit('.', 2)[0]}.meta") for path in paths)
    return [(path, json.loads(meta.read_bytes())) for path, meta in zip(paths, notes)]


def entry_of(kernel, names) -> str:
    """Return a kernel's entry; Warp adds a hash that depends on the target to its name."""
    pattern = re.compile(re.escape(kernel.key) + "_[0-9a-f]{8}_cuda_kernel_forward")
    (name,) = filter(pattern.fullmatch, names)
    return name


def _structure(name: str) -> type[ctypes.Structure]:
    """A structure of the C++ by its name, of numbers, arrays and pointers."""
    types = {"s32": ctypes.c_int32, "s64": ctypes.c_int64, "u64": ctypes.c_uint64}
    (body,) = re.findall(rf"^struct {name} \{{(.*?)^\}};", _TEXT, re.S | re.M)
    fields = []
    for line in re.sub(r"//.*", "", body).split(";")[:-1]:
        kind, names = re.fullmatch(r"\s*(?:const )?(\w+\*?) (.*)", line, re.S).groups()
        for field, count in re.findall(r"(\w+)(?:\[(\d+)\])?", names):
            made = types.get(kind, ctypes.c_void_p)
            fields.append((field, made * int(count) if count else made))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


Instruction, Constant, Array = map(_structure, ("Instruction", "Constant", "Array"))
Finding, Count, Launch = map(_structure, ("Finding", "Count", "Launch"))


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
    text = f"{_TEXT} {compiler} {_FLAGS}".encode()
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
    for text in (made.opcode_name, made.opcode_unit, made.opcode_operands):
        text.restype = ctypes.c_char_p
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


@functools.cache
def units() -> list[str]:
    """By an operation's number, what works on it."""
    return [library().opcode_unit(number).decode() for number, *_ in opcodes().values()]
