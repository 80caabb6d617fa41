"""Native leaves of the CPU kernels: sixteen adjacent channels as one SIMD value.

A leaf is a little C++ with the compiler's vector types, which become AVX-512, AVX2 or NEON
instructions. The loops around them, and all that is not arithmetic on lanes, are Warp kernels.
"""

from pathlib import Path

import torch
import warp as wp

from .native import native

W = 16  # channels of a lane group: one cache line of float32
lanes = wp.types.vector(W, wp.float32)
LANES = "wp::vec_t<16, float>"
WARP_DTYPES = {
    torch.float32: wp.float32,
    torch.float16: wp.float16,
    torch.bfloat16: wp.bfloat16,
}

_HERE = Path(__file__).parent
VECTORS = native(_HERE / "vectors.h")


def prelude(degree: int, table: bool = False) -> str:
    """C++ text of the arithmetic on lanes, ``lanes.h``.

    Args:
        degree: of the polynomial in ``exp2_parts_`` and ``exp2_rise_``, 2 to 6.
        table: whether a table takes its place where the processor has AVX-512.
    """
    return native(_HERE / "lanes.h", DEGREE=degree, TABLE=table)


PRELUDE = prelude(5)


@wp.func_native(PRELUDE + f"{LANES} r; *(F*)&r = sigmoid_(*(const F*)&x); return r;")
def sigmoid(x: lanes) -> lanes: ...


@wp.func_native(VECTORS + f"{LANES} r; *(F*)&r = *(const F*)&a * *(const F*)&b; return r;")
def times(a: lanes, b: lanes) -> lanes: ...


@wp.func_native(
    PRELUDE + f"{LANES} r; *(F*)&r = fma_(*(const F*)&a, *(const F*)&b, *(const F*)&c); return r;"
)
def fma(a: lanes, b: lanes, c: lanes) -> lanes: ...
