"""Arithmetic of one number per thread, for CUDA kernels that Warp makes of Python."""

import warp as wp

LOG2E = 1.4426950408889634


# One instruction on the special function unit, with a relative error of about 2^-22. Denormals count
# as 0.
@wp.func_native('float r; asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r;')
def exp2(x: float) -> float: ...
