"""The harmonics on CUDA: one thread a Gaussian, which loops over its views.

So the gradients by coefficients and by the mean are summed by one thread, without atomics. Sums of
views go channel by channel: a thread holds one column of coefficients at a time, whatever
the number of channels. README.md §6 of the rasterizer holds the maths.
"""

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ...runtime.native import native
from .shared import SHORTEST, Arrays, Size

CHUNK = 1  # Gaussians of a task
_HERE = Path(__file__).parent
# Loops over a column of coefficients are written out, so that it stays in registers.
_OPTIONS = {"max_unroll": 25}


@wp.func
@no_type_check
def _direction(mean: wp.vec3, center: wp.vec3) -> wp.vec4:
    # the direction from the centre, and the length as it is
    t = mean - center
    size = wp.length(t)
    t = t / wp.max(size, SHORTEST)
    return wp.vec4(t[0], t[1], t[2], size)


# Results above these pass their gradient on: colours that are not clamped, and sums that are
# neither NaN nor -inf. (A function in place of the comparison takes 20 registers more.)
_ABOVE = {True: 0.0, False: -3.4e38}


@functools.cache
def _leaves(degree: int) -> SimpleNamespace:
    """The type ``column``, of all coefficients of a channel, and the functions of a degree.

    ``basis`` gives the Y_k of a direction, ``slopes`` the gradient of ``Σ_k s_k Y_k`` by it.
    """
    count = (degree + 1) ** 2
    column = wp.types.vector(count, wp.float32)
    packed = f"typedef float F; wp::vec_t<{count}, float> Y;"

    @wp.func_native(packed + native(_HERE / "basis.h", DEGREE=degree) + "return Y;")
    def basis(x: wp.float32, y: wp.float32, z: wp.float32) -> column: ...

    @wp.func_native(
        "typedef float F; F v_x = 0.0f, v_y = 0.0f, v_z = 0.0f;"
        + native(_HERE / "slopes.h", DEGREE=degree)
        + "return wp::vec_t<3, float>(v_x, v_y, v_z);"
    )
    def slopes(x: wp.float32, y: wp.float32, z: wp.float32, s: column) -> wp.vec3: ...

    @wp.func
    @no_type_check
    def used_are_finite(coefficients: wp.array3d[wp.float32], row: wp.int32) -> bool:
        for k in range(count):
            for d in range(coefficients.shape[2]):
                if not wp.isfinite(coefficients[row, k, d]):
                    return False
        return True

    return SimpleNamespace(
        column=column, basis=basis, slopes=slopes, used_are_finite=used_are_finite
    )


@functools.cache
def forward_kernel(degree: int, channels: int, clamped: bool):
    """As the CPU's, for any number of channels."""
    count, leaves = (degree + 1) ** 2, _leaves(degree)
    basis, used_are_finite = leaves.basis, leaves.used_are_finite

    @wp.kernel(enable_backward=False, module="unique", module_options=_OPTIONS)
    @no_type_check
    def harmonics(offset: wp.int32, size: Size, arrays_out: Arrays):
        i = offset + wp.tid()
        num, views = size.num, size.views
        mean = arrays_out.means[i]
        for view in range(views):
            image = i // num * views + view
            at = image * num + i % num
            row = wp.where(size.per_view != 0, at, i)
            t = _direction(mean, arrays_out.centers[image])
            Y = basis(t[0], t[1], t[2])
            bad = not (wp.isfinite(mean[0]) and wp.isfinite(mean[1]) and wp.isfinite(mean[2]))
            for d in range(arrays_out.colors.shape[1]):
                value = wp.float32(0.0)
                for k in range(count):
                    value += Y[k] * arrays_out.coefficients[row, k, d]
                # a coefficient that is not finite leaves such a sum; the reverse need not hold
                bad = bad or not wp.isfinite(value)
                if wp.static(clamped):
                    value += 0.5
                    value = wp.where(value < 0.0, 0.0, value)
                arrays_out.colors[at, d] = value
            if bad:
                finite = wp.isfinite(mean[0]) and wp.isfinite(mean[1]) and wp.isfinite(mean[2])
                if not (finite and used_are_finite(arrays_out.coefficients, row)):
                    for d in range(arrays_out.colors.shape[1]):
                        arrays_out.colors[at, d] = wp.nan

    return harmonics


@functools.cache
def backward_kernel(degree: int, channels: int, clamped: bool):
    """As the CPU's, for any number of channels."""
    count, leaves = (degree + 1) ** 2, _leaves(degree)
    above = _ABOVE[clamped]
    column, basis, slopes = leaves.column, leaves.basis, leaves.slopes

    @wp.kernel(enable_backward=False, module="unique", module_options=_OPTIONS)
    @no_type_check
    def harmonics_vjp(offset: wp.int32, size: Size, arrays_in: Arrays, v_arrays_out: Arrays):
        i = offset + wp.tid()
        num, views = size.num, size.views
        mean = arrays_in.means[i]
        b = i // num
        channels = v_arrays_out.colors.shape[1]
        if v_arrays_out.coefficients:
            for d in range(channels):
                v_column = column()
                for view in range(views):
                    image = b * views + view
                    at = image * num + i % num
                    # channels that pass no gradient on may hold NaN, which must not meet a zero
                    if arrays_in.colors[at, d] > wp.static(above):
                        t = _direction(mean, arrays_in.centers[image])
                        v_column += v_arrays_out.colors[at, d] * basis(t[0], t[1], t[2])
                    last = size.per_view != 0 or view == views - 1
                    if last:
                        row = wp.where(size.per_view != 0, at, i)
                        for k in range(count):
                            v_arrays_out.coefficients[row, k, d] = v_column[k]
                        for k in range(count, v_arrays_out.coefficients.shape[1]):
                            v_arrays_out.coefficients[row, k, d] = 0.0
                        v_column = column()
        if wp.static(degree > 0) and (v_arrays_out.means or v_arrays_out.centers):
            v_mean = wp.vec3(0.0, 0.0, 0.0)
            for view in range(views):
                image = b * views + view
                at = image * num + i % num
                row = wp.where(size.per_view != 0, at, i)
                s = column()
                alive = wp.bool(False)
                for d in range(channels):
                    if arrays_in.colors[at, d] > wp.static(above):
                        alive = True
                        v = v_arrays_out.colors[at, d]
                        for k in range(count):
                            s[k] = s[k] + v * arrays_in.coefficients[row, k, d]
                if alive:
                    t = _direction(mean, arrays_in.centers[image])
                    u = wp.vec3(t[0], t[1], t[2])
                    v_t = slopes(u[0], u[1], u[2], s)
                    # through the division by the length, a constant where it is too short
                    if t[3] >= SHORTEST:
                        v_t = v_t - wp.dot(u, v_t) * u
                    v_t = v_t / wp.max(t[3], SHORTEST)
                    v_mean += v_t
                    if v_arrays_out.centers:
                        v_arrays_out.centers[at] = -v_t
            if v_arrays_out.means:
                v_arrays_out.means[i] = v_mean

    return harmonics_vjp
