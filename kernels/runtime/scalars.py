"""The leaves of ``lanes.py`` for one channel per thread, for CUDA kernels.

Each is plain Warp, or a line of C++ that also compiles for a CPU, where the tests run it.
"""

import torch
import warp as wp

from .lanes import WARP_DTYPES

VALUE = wp.float32
WIDTH = 1
LOG2E = 1.4426950408889634

# Each of the two is one instruction on the special function unit, with a relative error of about
# 2^-22. Denormals count as 0.
EXP2 = """
auto exp2_ = [](float v) -> float {
#if defined(__CUDA_ARCH__)
    float r;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
    return r;
#else
    return ::exp2f(v);
#endif
};
"""
RECIPROCAL = """
auto reciprocal_ = [](float v) -> float {
#if defined(__CUDA_ARCH__)
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
    return r;
#else
    return 1.0f / v;
#endif
};
"""


# The product of two int32 in one instruction, as addresses need it.
WIDE = """
auto wide_ = [](int a, int b) -> long long {
#if defined(__CUDA_ARCH__)
    long long r;
    asm("mul.wide.s32 %0, %1, %2;" : "=l"(r) : "r"(a), "r"(b));
    return r;
#else
    return (long long)a * b;
#endif
};
"""


@wp.func_native(EXP2 + "return exp2_(x);")
def exp2(x: float) -> float: ...


@wp.func_native(RECIPROCAL + "return reciprocal_(x);")
def reciprocal(x: float) -> float: ...


@wp.func
def sigmoid(x: float) -> float:
    return reciprocal(1.0 + exp2(-wp.static(LOG2E) * x))  # 0 where the power is infinite


# It has no branch and is relatively accurate for x << 0, as the one in lanes.py.
@wp.func
def softplus(x: float) -> float:
    e = exp2(-wp.static(LOG2E) * wp.abs(x))
    s = e * reciprocal(e + 2.0)
    w = s * s
    p = 0.20010849594358543 + w * (0.13999569703388653 + w * 0.1401223282424694)
    return wp.max(x, 0.0) + 2.0 * s * (1.0 + w * (0.33333206564805135 + w * p))


# This is the sigmoid, from the exponential that ``softplus`` uses as well.
@wp.func
def softplus_slope(x: float) -> float:
    e = exp2(-wp.static(LOG2E) * wp.abs(x))
    return wp.where(x < 0.0, e, 1.0) * reciprocal(1.0 + e)


@wp.func
def times(a: float, b: float) -> float:
    return a * b


@wp.func
def fma(a: float, b: float, c: float) -> float:
    return a * b + c


def _accessors(dtype: torch.dtype):
    scalar = WARP_DTYPES[dtype]

    @wp.func
    def load(x_in: wp.array3d(dtype=scalar), b: int, t: int, d: int, width: int) -> float:
        return float(x_in[b, t, d])

    @wp.func
    def store(x_out: wp.array3d(dtype=scalar), b: int, t: int, d: int, width: int, v: float):
        x_out[b, t, d] = scalar(v)

    return load, store


ACCESSORS = {dtype: _accessors(dtype) for dtype in WARP_DTYPES}
