"""PTX of other projects' kernels, from their source packages and nvcc.

Packages and compiler come from the index of pip into a folder outside the repository. A kernel is
instantiated with the template arguments that its host code chooses for a shape, and compiled with
the flags of its setup.py.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import struct
import subprocess
import sys
import sysconfig
import tarfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import torch
from torch import Tensor

from .contract import contracted
from .counting import Executed, executed
from .launch import ARCHITECTURE, Interpreter
from .machine import Missing
from .parse import Program, read

PACKAGES = {"mamba-ssm": "2.3.2.post1", "causal-conv1d": "1.7.0", "gsplat": "1.5.3"}
_COMPILER = ("nvidia-cuda-nvcc", "nvidia-nvvm", "nvidia-cuda-crt")
# pip asks a source package for its metadata, which needs no compiler where these are set.
_NO_BUILD = {"MAMBA_SKIP_CUDA_BUILD": "TRUE", "CAUSAL_CONV1D_SKIP_CUDA_BUILD": "TRUE"}
_NO_BUILD |= {"BUILD_NO_CUDA": "1"}
# Their setup.py say C++17, with which torch's headers do not compile.
_FLAGS = ["-O3", "-std=c++20", "--use_fast_math", "--expt-relaxed-constexpr"]
_KINDS = product(("HALF", "BFLOAT16", "BFLOAT162"), ("OPERATORS", "CONVERSIONS"))
_HALVES = [f"-U__CUDA_NO_{kind}_{what}__" for kind, what in _KINDS] + ["--expt-extended-lambda"]
FLAGS = dict.fromkeys(("mamba-ssm", "causal-conv1d"), _HALVES)
FLAGS["gsplat"] = ["-diag-suppress", "20012,186"]
INCLUDES = {
    "mamba-ssm": ["csrc/selective_scan"],
    "causal-conv1d": ["csrc"],
    "gsplat": [f"gsplat/cuda/{name}" for name in ("include", "csrc", "csrc/third_party/glm")],
}
# An entry that does nothing; its name says the bytes of shared memory that the host asks for.
_SHARED = "\ntemplate <int bytes> __global__ void shared_bytes() {{}}\n"
_SHARED += "template __global__ void shared_bytes<{}>();\n"
_OTHER = "(?!_Z12shared_bytes)"


class Peers:
    """The source packages and a compiler.

    Args:
        folder: for all that is downloaded, and the PTX.

    Raises:
        Missing: pip cannot get one of them, or there is no compiler for the host.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        site = Path(sysconfig.get_path("purelib"))
        cuda = next((site / "nvidia").glob("cu[0-9]*/include/cuda_runtime.h"), None)
        if cuda is None or torch.version.cuda is None:
            raise Missing("torch without CUDA: its headers are needed")
        self.nvcc = folder / "nvcc" / "nvidia" / cuda.parents[1].name / "bin" / "nvcc"
        api = "torch/include/torch/csrc/api/include"
        self.headers = [cuda.parent, cuda.parent / "cccl", site / "torch/include", site / api]
        if not self.nvcc.exists():
            wanted = [f"{name}=={torch.version.cuda}.*" for name in _COMPILER]
            _pip("install", "--no-deps", "--target", folder / "nvcc", *wanted)
        for name, version in PACKAGES.items():
            if not self.source(name).is_dir():
                chosen = ("--no-deps", "--no-build-isolation", "--no-binary", name)
                _pip("download", *chosen, "--dest", folder, f"{name}=={version}")
                with tarfile.open(f"{self.source(name)}.tar.gz") as packed:
                    packed.extractall(folder, filter="data")

    def source(self, package: str) -> Path:
        """Return the folder of a package's sources."""
        return self.folder / f"{package.replace('-', '_')}-{PACKAGES[package]}"

    def compile(self, package: str, text: str, shared: str = "0", entry: str = _OTHER):
        """Compile a text that has one of a package's kernels.

        Args:
            package: whose folders and flags are used.
            text: CUDA C++.
            shared: constant expression for the bytes of shared memory of a launch.
            entry: a regular expression at the beginning of the kernel's name.

        Returns:
            The program, its products contracted with sums, and the bytes of shared memory.

        Raises:
            Missing: nvcc fails.
        """
        text += _SHARED.format(shared)
        command = [str(self.nvcc), "-ptx", f"-arch=compute_{ARCHITECTURE}"]
        command += [*_FLAGS, *FLAGS[package]]
        command += [f"-I{self.source(package) / name}" for name in INCLUDES[package]]
        command += [f"-I{path}" for path in self.headers]
        key = hashlib.sha256(" ".join([*command, text]).encode()).hexdigest()[:16]
        path = self.folder / f"{key}.cu"
        ptx = path.with_suffix(".ptx")
        if not ptx.exists():
            path.write_text(text)
            done = subprocess.run([*command, path, "-o", ptx], capture_output=True, text=True)
            if done.returncode:
                raise Missing(f"nvcc: {done.stderr.strip().splitlines()[-1:]}")
        found = ptx.read_text()
        (program,) = read(found, f"^{entry}").values()
        (size,) = re.findall(r"_Z12shared_bytesILi(\d+)E", found)[:1]
        return contracted(program), int(size)


def _pip(*arguments: object) -> None:
    command = [sys.executable, "-m", "pip", *map(str, arguments), "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | _NO_BUILD)
    if done.returncode:
        raise Missing(f"pip: {(done.stderr.strip() or 'no reason').splitlines()[-1]}")


def structure(text: str, name: str) -> type[ctypes.Structure]:
    """Return a structure of parameters from the text of a C++ header."""
    pattern = rf"struct {name}\s*(?::\s*public (\w+))?\s*\{{(.*?)\n\}};"
    ((base, body),) = re.findall(pattern, text, re.S)
    (index,) = re.findall(r"using index_t = uint(\d+)_t", text)
    types = {"int": ctypes.c_int, "bool": ctypes.c_bool}
    types["index_t"] = ctypes.c_uint32 if index == "32" else ctypes.c_uint64
    fields = []
    for line in re.sub(r"//.*|using [^;]*;", "", body).split(";")[:-1]:
        kind, names = re.fullmatch(r"\s*(\w+)(.*)", line, re.S).groups()
        made = ctypes.c_void_p if "*" in line else types[kind]
        names = re.sub(r"\*|__restrict__", "", names)
        fields += [(field.strip(), made) for field in names.split(",")]
    return type(name, (structure(text, base) if base else ctypes.Structure,), {"_fields_": fields})


def filled(text: str, name: str, tensors: dict[str, Tensor], axes: dict[str, str], **numbers):
    """Return the bytes of a structure of a C++ header.

    Args:
        text: the header.
        name: of the structure.
        tensors: by name; the address of one is ``<name>_ptr``.
        axes: names of its axes, whose strides are ``<name>_<axis>_stride`` where the structure has
            them.
        numbers: its other fields; those not named are 0.
    """
    made = structure(text, name)(**numbers)
    for name, x in tensors.items():
        setattr(made, f"{name}_ptr", x.data_ptr())
        for axis, stride in zip(axes[name].split(), x.stride()):
            if hasattr(made, f"{name}_{axis}_stride"):
                setattr(made, f"{name}_{axis}_stride", stride)
    return bytes(made)


def packed(program: Program, values: Sequence[Tensor | float | int | None]) -> list[bytes]:
    """Return the bytes of separate parameters; None stands for a missing tensor."""

    def one(value, size: int) -> bytes:
        if isinstance(value, float):
            return struct.pack("f", value)
        number = value.data_ptr() if isinstance(value, Tensor) else value or 0
        return int(number).to_bytes(size, "little")

    sizes = [size for _, size in program.params]
    return [one(value, size) for value, size in zip(values, sizes, strict=True)]


def execute(compiled: tuple[Program, int], params: list[bytes], tensors, *sizes) -> list[Executed]:
    """Execute and count a kernel; ``sizes``: threads of a block and blocks, three of each.

    Raises:
        ValueError: the interpreter reports something, which it names.
    """
    program, shared = compiled
    machine = Interpreter(counting=True)
    machine.execute(program, params, tensors, (*sizes, shared))
    if machine.findings:
        raise ValueError(machine.findings[0])
    return [*executed(machine).values()]
