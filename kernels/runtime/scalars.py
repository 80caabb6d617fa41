"""Arithmetic and types of one number per thread, for CUDA kernels that Warp makes of Python."""

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


@wp.func_native(EXP2 + "return exp2_(x);")
def exp2(x: float) -> float: ...


@wp.func_native(RECIPROCAL + "return reciprocal_(x);")
def reciprocal(x: float) -> float: ...


@wp.func_native('asm volatile("" : "+r"(x)); return x;')
def opaque(x: int) -> int:
    """Return x, so that values computed from it before need not stay in registers."""
    ...
