"""Leaf functions of the CUDA compositor, in C++."""

import warp as wp

from ...runtime.scalars import exp2 as exp2
from ...runtime.scalars import opaque as opaque
from ...runtime.scalars import reciprocal as reciprocal

wp.set_module_options({"enable_backward": False})


@wp.func_native('float y; asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x)); return y;')
def root(x: wp.float32) -> wp.float32:
    """The square root, to 2 units in the last place."""
    ...


# Arrays are dense. Warp's own indexing multiplies by strides that it reads from the array, which
# costs instructions and, in loops, registers.
@wp.func_native("return values.data[i];")
def load_int(values: wp.array[wp.int32], i: wp.int32) -> wp.int32: ...


@wp.func_native("values.data[i] = v;")
def store_int(values: wp.array[wp.int32], i: wp.int32, v: wp.int32): ...


# Four numbers at once, at multiples of 16 bytes.
@wp.func_native(
    "const float4 r = *(const float4*)(values.data + i);"
    " return wp::vec_t<4, float>(r.x, r.y, r.z, r.w);"
)
def load4(values: wp.array2d[wp.float32], i: wp.int64) -> wp.vec4: ...


@wp.func_native("*(float4*)(values.data + i) = make_float4(v[0], v[1], v[2], v[3]);")
def store4(values: wp.array2d[wp.float32], i: wp.int64, v: wp.vec4): ...


@wp.func_native("return values.data[i + step];")
def load(values: wp.array2d[wp.float32], i: wp.int64, step: wp.int32) -> wp.float32: ...


@wp.func_native("values.data[i + step] = v;")
def store(values: wp.array2d[wp.float32], i: wp.int64, step: wp.int32, v: wp.float32): ...


@wp.func_native("return values.data[i + step];")
def load_word(values: wp.array2d[wp.int32], i: wp.int64, step: wp.int32) -> wp.int32: ...


@wp.func_native("values.data[i + step] = v;")
def store_word(values: wp.array2d[wp.int32], i: wp.int64, step: wp.int32, v: wp.int32): ...


# fmaf is named, since forward and backward must see the same alpha: the compiler has no choice.
@wp.func_native("return fmaf(k, dy, dx);")
def sheared(k: wp.float32, dx: wp.float32, dy: wp.float32) -> wp.float32:
    """The u of README §5."""
    ...


@wp.func_native("return fmaf(a * u, u, fmaf(e * dy, dy, level));")
def exponent(
    a: wp.float32, e: wp.float32, level: wp.float32, u: wp.float32, dy: wp.float32
) -> wp.float32:
    """log2 of alpha; ``a, e`` are the conic's times -log2(e)/2, ``level`` is log2 of opacity."""
    ...


@wp.func_native('int y; asm("bfind.u32 %0, %1;" : "=r"(y) : "r"(x)); return y;')
def highest_bit(x: wp.int32) -> wp.int32:
    """The number of the highest bit that is set; one instruction, where the lowest takes two."""
    ...


@wp.func_native("return __popc(x);")
def count_bits(x: wp.int32) -> wp.int32:
    """The number of bits that are set."""
    ...
