"""Rows of a ``[B, L, D]`` tensor as lanes, in C++ text: element types, strides and ragged ends.

A row is dense in D; tokens and batch elements may be strided. Lanes past ``width`` are read as 0
and not written.
"""

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from .lanes import LANES, PRELUDE, WARP_DTYPES, W, fma, lanes, sigmoid, times

__all__ = [
    "ACCESSORS",
    "ELEMENTS",
    "SETTLE",
    "VALUE",
    "WIDTH",
    "fma",
    "put",
    "rows",
    "settle",
    "sigmoid",
    "streams",
    "times",
]

VALUE, WIDTH = lanes, W  # scalars.py has these names too, as kernels for both devices need them

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
// One instruction where the processor has it: the same bits, but a result below 2^-126 becomes 0.
#if defined(__AVX512BF16__)
typedef __bf16 N __attribute__((vector_size(32), aligned(2)));
auto write_bf16 = [](unsigned short* p, F v) { *(N*)p = __builtin_convertvector(v, N); };
#else
auto write_bf16 = [](unsigned short* p, F v) { *(S*)p = __builtin_convertvector(narrow((I)v), S); };
#endif
"""
# By dtype what replaces the names in ``_ROWS``. TYPE is the element's type; READ gives the lanes at
# p and READ_ONE lane i of them; WRITE stores the lanes v at p and WRITE_ONE lane i of them.
_CODE = {
    torch.float32: {
        "TYPE": "float",
        "READ_ONE": "p[i]",
        "READ": "*(const F*)p",
        "WRITE_ONE": "p[i] = v[i]",
        "WRITE": "*(F*)p = v",
    },
    torch.float16: {
        "TYPE": "_Float16",
        "READ_ONE": "(float)p[i]",
        "READ": "__builtin_convertvector(*(const H*)p, F)",
        "WRITE_ONE": "p[i] = (_Float16)v[i]",
        "WRITE": "*(H*)p = __builtin_convertvector(v, H)",
    },
    torch.bfloat16: {
        "TYPE": "unsigned short",
        "READ_ONE": "widen(p[i])",
        "READ": "(F)(__builtin_convertvector(*(const S*)p, I) << 16)",
        "WRITE_ONE": "p[i] = (unsigned short)narrow(I{} + bits(v[i]))[0]",
        "WRITE": "write_bf16(p, v)",
    },
}
_ROWS = """
TYPE* const NAME_rows = (TYPE*)((char*)ARRAY.data + (size_t)b * ARRAY.strides[0]
    + (size_t)t0 * ARRAY.strides[1]) + d;
const size_t NAME_step = ARRAY.strides[1] / sizeof(TYPE);
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


def rows(array: str, dtype: torch.dtype) -> str:
    """C++ text: ``read_NAME(t)``, ``write_NAME(t, v)`` and ``fetch_NAME(t, at)``.

    They address the ``array`` NAME_in or NAME_out [B, L, D] from batch element ``b``, token ``t0``
    and channel ``d`` on, ``width`` channels; all four must be in scope.
    """
    name = array.removesuffix("_in").removesuffix("_out")
    text = _ROWS.replace("ARRAY", array).replace("NAME", name)
    for part, code in _CODE[dtype].items():
        text = text.replace(part, code)
    return text


# Large results go past the caches: their lines need not be read before they are written, and would
# only push out what is wanted soon. ``stream`` says so, and that all lines are whole.
_PUT = """
typedef float Line __attribute__((vector_size(64), aligned(64)));
auto put_NAME = [&](int t, F v) {
    if (stream) __builtin_nontemporal_store((Line)v, (Line*)(NAME_rows + t * NAME_step));
    else write_NAME(t, v);
};
"""
_STREAMED = 32 << 20  # bytes: no cache of a few cores holds a result of this size


def put(name: str) -> str:
    """C++ text of ``put_NAME(t, v)``, which writes a token's lanes as ``stream`` in scope says.

    The text of ``rows`` for the array must stand before it.
    """
    return _PUT.replace("NAME", name)


def streams(results: Sequence[Tensor]) -> bool:
    """Whether results ``[B, L, D]`` may go past the caches: they are too large to be kept there.

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


# What was written past the caches is seen by other threads from here on.
SETTLE = """
#if defined(__x86_64__)
__builtin_ia32_sfence();
#endif
"""


@wp.func_native(SETTLE)
def settle(): ...


def _accessors(dtype: torch.dtype):
    scalar = WARP_DTYPES[dtype]
    head = PRELUDE + ELEMENTS + "const int t0 = t;"

    @wp.func_native(head + rows("x_in", dtype) + f"{LANES} r; *(F*)&r = read_x(0); return r;")
    def load(x_in: wp.array3d(dtype=scalar), b: int, t: int, d: int, width: int) -> lanes: ...

    @wp.func_native(head + rows("x_out", dtype) + "write_x(0, *(const F*)&v);")
    def store(x_out: wp.array3d(dtype=scalar), b: int, t: int, d: int, width: int, v: lanes): ...

    return load, store


# ``(load, store)`` by element type; both address row [b, t] from channel d on.
ACCESSORS = {dtype: _accessors(dtype) for dtype in WARP_DTYPES}
