"""Arithmetic of one number per thread, for CUDA kernels that Warp makes of Python."""

import warp as wp

LOG2E = 1.4426950408889634


# An instruction of the special function unit, with an error of about 2^-22; denormals are 0.
@wp.func_native('float r; asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r;')
def exp2(x: float) -> float: ...
