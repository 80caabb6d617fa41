"""Sixteen adjacent channels as one SIMD value: the C++ of the CPU kernels of ``[B, L, D]``.

It has the compiler's vector types, which become AVX-512, AVX2 or NEON instructions.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
import warp as wp
from torch import Tensor

from .native import native

W = 16  # channels of a lane group: one cache line of float32
lanes = wp.types.vector(W, wp.float32)
WARP_DTYPES = {
    torch.float32: wp.float32,
    torch.float16: wp.float16,
    torch.bfloat16: wp.bfloat16,
}

_HERE = Path(__file__).parent


def prelude(degree: int, table: bool = False) -> str:
    """C++ text of the arithmetic on lanes, ``lanes.h``.

    Args:
        degree: of the polynomial in ``exp2_parts_`` and ``exp2_rise_``, 2 to 6.
        table: whether a table takes its place where the processor has AVX-512.
    """
    return native(_HERE / "lanes.h", DEGREE=degree, TABLE=table)


PRELUDE = prelude(5)
# C++ text of ``rows_``, ``read_``, ``write_`` and ``put_`` of a tensor, which follows that.
ROWS = native(_HERE / "rows.h")

_STREAMED = 32 << 20  # bytes: no cache of a few cores holds a result of this size


def streams(results: Sequence[Tensor]) -> bool:
    """True if results ``[B, L, D]`` may be written past the caches: they are too large for these.

    Of float32 each, dense, with whole cache lines; results without elements do not count.
    """
    written = [x for x in results if x.numel()]
    return bool(written) and all(
        x.dtype == torch.float32
        and x.shape[-1] % W == 0
        and x.data_ptr() % 64 == 0
        and 4 * x.numel() >= _STREAMED
        for x in written
    )
