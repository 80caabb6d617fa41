"""The arithmetic of ``lanes.h`` for one channel per thread, for CUDA kernels."""

import torch
import warp as wp

LOG2E = 1.4426950408889634

# A type, an integer of its bits, and the float that such an integer means.
BITS = {
    torch.float32: {
        "ELEMENT": "float",
        "WORD": "unsigned",
        "WIDEN": "float f; memcpy(&f, &bits, 4); return f;",
    },
    torch.float16: {
        "ELEMENT": "wp::float16",
        "WORD": "unsigned short",
        "WIDEN": "wp::half h; h.u = (unsigned short)bits; return wp::half_to_float(h);",
    },
    torch.bfloat16: {
        "ELEMENT": "wp::bfloat16",
        "WORD": "unsigned short",
        "WIDEN": "unsigned v = bits << 16; float f; memcpy(&f, &v, 4); return f;",
    },
}

# Each of the two is one instruction on the special function unit, with a relative error of about
# 2^-22. Denormals count as 0.
EXP2 = """
auto exp2_ = [](float v) -> float {
    float r;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
    return r;
};
"""
RECIPROCAL = """
auto reciprocal_ = [](float v) -> float {
#ifdef __CUDA_ARCH__
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
    return r;
#else  // the tests run kernels for tile lists on a CPU too
    return 1.0f / v;
#endif
};
"""


# The product of two int32 in one instruction, as addresses need it.
WIDE = """
auto wide_ = [](int a, int b) -> long long {
    long long r;
    asm("mul.wide.s32 %0, %1, %2;" : "=l"(r) : "r"(a), "r"(b));
    return r;
};
"""


@wp.func_native(EXP2 + "return exp2_(x);")
def exp2(x: float) -> float: ...


@wp.func_native(RECIPROCAL + "return reciprocal_(x);")
def reciprocal(x: float) -> float: ...


@wp.func_native('asm volatile("" : "+r"(x)); return x;')
def opaque(x: int) -> int:
    """Return x, so that values computed from it before need not stay in registers."""
    ...


@wp.func
def sigmoid(x: float) -> float:
    return reciprocal(1.0 + exp2(-wp.static(LOG2E) * x))  # 0 where the power is infinite


# It has no branch and is relatively accurate for x << 0, as the one in lanes.h; 2 atanh(s) in one.
@wp.func
def softplus(x: float) -> float:
    e = exp2(-wp.static(LOG2E) * wp.abs(x))
    s = e * reciprocal(e + 2.0)
    w = s * s
    p = 0.40021699188717086 + w * (0.27999139406777306 + w * 0.2802446564849388)
    return wp.max(x, 0.0) + s * (2.0 + w * (0.6666641312961027 + w * p))


# This is the sigmoid, from the exponential that ``softplus`` uses as well.
@wp.func
def softplus_slope(x: float) -> float:
    e = exp2(-wp.static(LOG2E) * wp.abs(x))
    return wp.where(x < 0.0, e, 1.0) * reciprocal(1.0 + e)
