"""C++ of the kernels: an operator's files as the text of native functions and CPU kernels.

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


def native(path: Path, **defines: object) -> str:
    """The text of a C++ file whose parameters are macros, defined before it and undefined after it.

    Files that it includes stand in their place, so that the text holds all that is compiled: the
    hash of a Warp module, by which compiled kernels are saved, follows every file's contents.

    Args:
        path: of the file; an ``#include "..."`` in it is relative to it.
        **defines: macros; a bool is ``true`` or ``false``, a float has all its digits and an f.

    Raises:
        OSError: a file cannot be read.
    """

    def value(x: object) -> str:
        if isinstance(x, bool):
            return str(x).lower()
        return f"{x!r}f" if isinstance(x, float) else str(x)

    before = "".join(f"#define {name} {value(x)}\n" for name, x in defines.items())
    after = "".join(f"#undef {name}\n" for name in defines)
    return f"\n{before}{_read(path)}{after}"


def _read(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    return _INCLUDE.sub(lambda found: _read(path.parent / found[1]), text)


def native_kernel(
    name: str,
    text: str,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    indices: str = "task",
) -> Any:
    """A CPU kernel for ``parallel_launch`` that is C++: the body of one task.

    Args:
        name: of the kernel.
        text: from ``native``; the task's number and the arguments are known in it by their names.
        inputs: Warp types by names, first those that are read.
        outputs: of those that are written.
        indices: names of the launch's dimensions, the first of which is the task's number.
    """
    arguments = {**inputs, **outputs}
    names = ", ".join(arguments)
    source = (
        f"def {name}_task({indices}, {names}): ...\n"
        f"def {name}(offset, {names}):\n"
        f"    {indices} = wp.tid()\n"
        f"    {name}_task(offset + {indices}, {names})\n"
    )
    # Warp reads the source of a kernel, and finds it there, as debuggers do.
    file = f"<{name}({names})>"
    linecache.cache[file] = len(source), None, source.splitlines(True), file
    made: dict[str, Any] = {"__name__": __name__, "wp": wp}
    exec(compile(source, file, "exec"), made)
    task, kernel = made[f"{name}_task"], made[name]
    task.__annotations__ = {**dict.fromkeys(map(str.strip, indices.split(",")), int), **arguments}
    kernel.__annotations__ = {"offset": int, **arguments}
    made[f"{name}_task"] = wp.func_native(text)(task)
    return wp.kernel(kernel, enable_backward=False, module="unique")


W = 16  # channels of a lane group: one cache line of float32
lanes = wp.types.vector(W, wp.float32)
WARP_DTYPES = {
    torch.float32: wp.float32,
    torch.float16: wp.float16,
    torch.bfloat16: wp.bfloat16,
}

_HERE = Path(__file__).parent


def prelude(degree: int, table: bool = False) -> str:
    """C++ text of ``lanes.h``: arithmetic on lanes, and rows of tensors as lanes.

    Args:
        degree: of the polynomial in ``exp2_parts_`` and ``exp2_fm1_``, 2 to 6.
        table: True to use a table instead where the processor has AVX-512.
    """
    return native(_HERE / "lanes.h", DEGREE=degree, TABLE=table)


PRELUDE = prelude(5)

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
