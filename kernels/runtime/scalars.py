"""Arithmetic of one number per thread, for CUDA kernels that Warp makes of Python."""

import warp as wp

LOG2E = 1.4426950408889634


# Each of the two is one instruction on the special function unit, with a relative error of about
# 2^-22. Denormals count as 0.
@wp.func_native('float r; asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r;')
def exp2(x: float) -> float: ...


@wp.func_native('float r; asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r;')
def reciprocal(x: float) -> float: ...


@wp.func_native('asm volatile("" : "+r"(x)); return x;')
def opaque(x: int) -> int:
    """Return x, so that values computed from it before need not stay in registers."""
    ...
