"""C++ of the kernels: headers as text, and kernels that are functions of them.

The kernels of ``[B, L, D]`` hold sixteen adjacent channels as one SIMD value, in the compiler's
vector types, which become AVX-512, AVX2 or NEON instructions (``lanes.h``).
"""

from __future__ import annotations

import linecache
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from .views import is_transposed

_INCLUDE = re.compile(r'^[ \t]*#include "(.+)"[ \t]*\n', re.MULTILINE)


def native(path: Path) -> str:
    """The text of a C++ header, with those that it includes in their place, each once.

    So the text holds all that is compiled: the hash of a Warp module, by which compiled kernels are
    saved, follows every file's contents.

    Args:
        path: of the file; an ``#include "..."`` in it is relative to it.

    Raises:
        OSError: a file cannot be read.
    """
    return f"\n{_read(path, set())}"


def _read(path: Path, seen: set[Path]) -> str:
    if path in seen:
        return ""
    seen.add(path)
    text = path.read_text(encoding="utf-8")
    return _INCLUDE.sub(lambda found: _read((path.parent / found[1]).resolve(), seen), text)


def constants(name: str, **values: object) -> str:
    """The text of a C++ struct of constants, a template argument of a kernel's functions.

    Args:
        name: of the struct.
        **values: its members, numbers or bools; a float keeps all its digits.
    """

    def member(key: str, x: object) -> str:
        kind = {bool: "bool", int: "int", float: "float"}[type(x)]
        literal = f"{x!r}f" if kind == "float" else str(x).lower()
        return f"    static constexpr {kind} {key} = {literal};\n"

    return f"\nstruct {name} {{\n{''.join(member(*item) for item in values.items())}}};\n"


def _group(name: str, arguments: Mapping[str, Any]) -> str:
    """C++ text of a local struct of references to arguments, without the ending of their names."""
    members = "".join(f"const decltype({x})& {x.removesuffix(f'_{name}')}; " for x in arguments)
    return f"const struct {{ {members}}} {name} = {{{', '.join(arguments)}}};\n"


def native_kernel(
    name: str,
    function: str,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    header: str,
    indices: str = "task",
    grouped: bool = False,
    **options: Any,
) -> Any:
    """A kernel for ``launch`` that is C++: a function of ``header``, called for each task.

    Args:
        name: of the kernel.
        function: of the header, maybe with template arguments. It is called with the indices and
            the arguments, in the order that they have here.
        inputs: Warp types by names, first those that are read.
        outputs: of those that are written.
        header: from ``native``.
        indices: names of the launch's dimensions, the first of which is cut for the threads.
        grouped: True to give the function two structs in place of the arguments: ``in.u`` and
            ``out.y`` are those that are named ``u_in`` and ``y_out``.
        **options: of ``wp.kernel``.
    """
    arguments = {**inputs, **outputs}
    names, text = ", ".join(arguments), f"{function}({indices}, {', '.join(arguments)});"
    if grouped:
        text = f"{_group('in', inputs)}{_group('out', outputs)}{function}({indices}, in, out);"
    source = (
        f"def {name}_native({indices}, {names}): ...\n"
        f"def {name}(offset, {names}):\n"
        f"    {indices} = wp.tid()\n"
        f"    {name}_native(offset + {indices}, {names})\n"
    )
    native_types = dict.fromkeys(map(str.strip, indices.split(",")), int)
    every = {"offset": int, **arguments}
    return _kernel(name, source, text, native_types | arguments, every, header, **options)


def cuda_kernel(
    name: str,
    function: str,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    header: str,
    shared: int,
    bounds: int | tuple[int, int],
) -> Any:
    """A CUDA kernel that is C++: a function of ``header``, maybe with template arguments.

    It is called with the number of the block and that of the thread in it, the block's shared
    memory, and the arguments. Launches have two dimensions, blocks and their threads.

    Args:
        name: as those below, of ``native_kernel``.
        function: of the header.
        inputs: Warp types by names.
        outputs: the same.
        header: only for CUDA.
        shared: floats of shared memory.
        bounds: threads of a block, and maybe the least number of blocks on a multiprocessor.
    """
    arguments = {**inputs, **outputs}
    names = ", ".join(arguments)
    source = (
        f"def {name}_native(index, lane, shared, {names}): ...\n"
        f"def {name}({names}):\n"
        f"    index, lane = wp.tid()\n"
        f'    shared = wp.tile_empty(shape=({shared},), dtype=float, storage="shared")\n'
        f"    {name}_native(index, lane, shared, {names})\n"
    )
    memory: Any = wp.tile[float, shared]  # pyright: ignore[reportIndexIssue] (in its stub a function)
    native_types = {"index": int, "lane": int, "shared": memory, **arguments}
    text = f"{function}(index, lane, shared.data.ptr, {names});"
    options = {"launch_bounds": bounds, "grid_stride": False}
    return _kernel(name, source, text, native_types, arguments, header, **options)


def _kernel(
    name: str,
    source: str,
    text: str,
    native_types: dict,
    arguments: dict,
    header: str,
    **options: Any,
) -> Any:
    """The kernel of a source, which calls the C++ ``text`` as ``{name}_native``.

    Args:
        native_types: of the arguments of the C++.
        arguments: of those of the kernel.
        options: of ``wp.kernel``.
    """
    # Warp reads the source of a kernel, and finds it there, as debuggers do.
    file = f"<{name}({', '.join(arguments)})>"
    linecache.cache[file] = len(source), None, source.splitlines(True), file
    namespace: dict[str, Any] = {"__name__": __name__, "wp": wp}
    exec(compile(source, file, "exec"), namespace)
    native, kernel = namespace[f"{name}_native"], namespace[name]
    native.__annotations__, kernel.__annotations__ = native_types, arguments
    namespace[f"{name}_native"] = wp.func_native(text)(native)
    build = wp.ModuleBuildOptions(extra_cpu_preamble=header, extra_cuda_preamble=header)
    options["module_options"] = {"extra_build_options": build}
    return wp.kernel(kernel, enable_backward=False, module="unique", **options)


W = 16  # channels of a lane group: one cache line of float32
lanes = wp.types.vector(W, wp.float32)
WARP_DTYPES = {
    torch.float32: wp.float32,
    torch.float16: wp.float16,
    torch.bfloat16: wp.bfloat16,
}

_STREAMED = 32 << 20  # bytes: no cache of a few cores holds a result of this size


def streams(results: Sequence[Tensor]) -> bool:
    """True if results ``[B, L, D]`` may be written past the caches: they are too large for these.

    Of float32 each, dense, with whole cache lines; results without elements do not count.
    """
    written = [x for x in results if x.numel()]
    return bool(written) and all(
        x.dtype == torch.float32
        and x.shape[1 if is_transposed(x) else 2] % W == 0
        and x.data_ptr() % 64 == 0
        and 4 * x.numel() >= _STREAMED
        for x in written
    )
