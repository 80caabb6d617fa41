"""Rows of a ``[B, L, D]`` tensor as lanes: element types, strides and ragged ends, in C++ text.

A row is dense in D; tokens and batch elements may be strided. Lanes past ``width`` are read as 0
and not written.
"""

import torch
import warp as wp

from .lanes import LANES, PRELUDE, WARP_DTYPES, W, fma, lanes, sigmoid, times

__all__ = ["ACCESSORS", "ELEMENTS", "VALUE", "WIDTH", "fma", "rows", "sigmoid", "times"]

VALUE, WIDTH = lanes, W  # with the rest, the names that scalars.py shares

ELEMENTS = """
typedef _Float16 H __attribute__((vector_size(32), aligned(2)));
typedef unsigned short S __attribute__((vector_size(32), aligned(2)));
auto widen = [](unsigned short s) -> float {
    int i = (int)s << 16;
    float f;
    __builtin_memcpy(&f, &i, 4);
    return f;
};
auto bits = [](float f) -> int { int i; __builtin_memcpy(&i, &f, 4); return i; };
auto narrow = [](I i) -> I {  // to nearest, ties to even; NaN stays a NaN
    I is_nan = (i & 0x7fffffff) > 0x7f800000;
    I rounded = (i + 0x7fff + ((i >> 16) & 1)) >> 16;
    return (is_nan ? (i >> 16) | 0x40 : rounded) & 0xffff;
};
"""
# by dtype: element type, lanes from *p, a lane from p[i], *p from lanes v, p[i] from a lane of v
_CODE = {
    torch.float32: ("float", "*(const F*)p", "p[i]", "*(F*)p = v", "p[i] = v[i]"),
    torch.float16: (
        "_Float16",
        "__builtin_convertvector(*(const H*)p, F)",
        "(float)p[i]",
        "*(H*)p = __builtin_convertvector(v, H)",
        "p[i] = (_Float16)v[i]",
    ),
    torch.bfloat16: (
        "unsigned short",
        "(F)(__builtin_convertvector(*(const S*)p, I) << 16)",
        "widen(p[i])",
        "*(S*)p = __builtin_convertvector(narrow((I)v), S)",
        "p[i] = (unsigned short)narrow(I{} + bits(v[i]))[0]",
    ),
}
_ROWS = """
TYPE* const NAME_rows = (TYPE*)((char*)NAME_in.data + (size_t)b * NAME_in.strides[0]
    + (size_t)t0 * NAME_in.strides[1]) + d;
const size_t NAME_step = NAME_in.strides[1] / sizeof(TYPE);
auto read_NAME = [&](int t) -> F {
    const TYPE* p = NAME_rows + t * NAME_step;
    if (width >= 16) return READ;
    F v = F{};
    for (int i = 0; i < width; ++i) v[i] = READ_ONE;
    return v;
};
auto write_NAME = [&](int t, F v) {
    TYPE* p = NAME_rows + t * NAME_step;
    if (width >= 16) WRITE;
    else for (int i = 0; i < width; ++i) WRITE_ONE;
};
auto fetch_NAME = [&](int t, int at) { __builtin_prefetch(NAME_rows + t * NAME_step + at); };
"""


def rows(name: str, dtype: torch.dtype) -> str:
    """C++ text: ``read_NAME(t)``, ``write_NAME(t, v)`` and ``fetch_NAME(t, at)``.

    They address the array NAME_in [B, L, D] from batch element ``b``, token ``t0`` and channel
    ``d`` on, ``width`` channels; all four must be in scope.
    """
    parts = zip(("TYPE", "READ_ONE", "READ", "WRITE_ONE", "WRITE"), _ordered(dtype))
    text = _ROWS.replace("NAME", name)
    for part, code in parts:
        text = text.replace(part, code)
    return text


def _ordered(dtype: torch.dtype) -> tuple[str, ...]:
    element, read, read_one, write, write_one = _CODE[dtype]
    return element, read_one, read, write_one, write


def _accessors(dtype: torch.dtype):
    scalar = WARP_DTYPES[dtype]
    prelude = PRELUDE + ELEMENTS + "const int t0 = t;" + rows("x", dtype)

    @wp.func_native(prelude + f"{LANES} r; *(F*)&r = read_x(0); return r;")
    def load(x_in: wp.array3d(dtype=scalar), b: int, t: int, d: int, width: int) -> lanes: ...

    @wp.func_native(prelude + "write_x(0, *(const F*)&v);")
    def store(x_in: wp.array3d(dtype=scalar), b: int, t: int, d: int, width: int, v: lanes): ...

    return load, store


# By element type, ``(load, store)``: both address row [b, t] from channel d on.
ACCESSORS = {dtype: _accessors(dtype) for dtype in WARP_DTYPES}
