"""The harmonics on CUDA: one thread a Gaussian, which loops over its views.

So the gradients by coefficients and by the mean are summed by one thread, without atomics. A thread
holds the coefficients of all channels where they are few, else of one channel at a time.
README.md §6 of the rasterizer holds the maths.
"""

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ...runtime.native import native
from .shared import SHORTEST, Arrays, Size

CHUNK = 1  # Gaussians of a task
HELD = 48  # coefficients of a row that a thread holds at most: three channels of degree 3
_HERE = Path(__file__).parent
# Loops over a column of coefficients are written out, so that it stays in registers.
_HEADER = native(_HERE / "basis.h") + native(_HERE / "part.h")
_BUILD = wp.ModuleBuildOptions(extra_cpu_preamble=_HEADER, extra_cuda_preamble=_HEADER)
_OPTIONS = {"max_unroll": 25, "extra_build_options": _BUILD}


@wp.func
@no_type_check
def _direction(mean: wp.vec3, center: wp.vec3) -> wp.vec4:
    # the direction from the centre, and the unclamped length
    t = mean - center
    size = wp.length(t)
    t = t / wp.max(size, SHORTEST)
    return wp.vec4(t[0], t[1], t[2], size)


# Results above these pass their gradient on: colours that are not clamped, and sums that are
# neither NaN nor -inf. (A function in place of the comparison takes 20 registers more.)
_ABOVE = {True: 0.0, False: -3.4e38}


@functools.cache
def _leaves(degree: int, channels: int) -> SimpleNamespace:
    """The functions of a degree, and ``group``, the number of channels worked on at a time.

    ``basis`` gives the Y_k of a direction, a ``column``, ``slopes`` the gradient of ``Σ_k s_k Y_k``
    by it; ``load`` and ``store`` copy a ``part`` of a row, ``[k, channel of the group]``.
    """
    count = (degree + 1) ** 2
    group = channels if count * channels <= HELD else 1
    column = wp.types.vector(count, wp.float32)
    part = wp.types.vector(count * group, wp.float32)
    sizes = f"{count}, {group}, {str(group == channels).lower()}"

    @wp.func_native(
        f"wp::vec_t<{count}, float> Y; gamba::harmonics::basis<{degree}>(x, y, z, Y.c); return Y;"
    )
    def basis(x: wp.float32, y: wp.float32, z: wp.float32) -> column: ...

    @wp.func_native(
        "wp::vec3 v(0.0f);"
        f"gamba::harmonics::slopes<{degree}>(x, y, z, s.c, v.c[0], v.c[1], v.c[2]); return v;"
    )
    def slopes(x: wp.float32, y: wp.float32, z: wp.float32, s: column) -> wp.vec3: ...

    @wp.func_native(
        f"wp::vec_t<{count * group}, float> part;"
        f"gamba::harmonics::load<{sizes}>(coefficients, row, first, part.c); return part;"
    )
    def load(coefficients: wp.array3d[wp.float32], row: wp.int32, first: wp.int32) -> part: ...

    @wp.func_native(f"gamba::harmonics::store<{sizes}>(coefficients, row, first, part.c);")
    def store(coefficients: wp.array3d[wp.float32], row: wp.int32, first: wp.int32, part: part): ...

    @wp.func
    @no_type_check
    def used_are_finite(coefficients: wp.array3d[wp.float32], row: wp.int32) -> bool:
        for k in range(count):
            for d in range(coefficients.shape[2]):
                if not wp.isfinite(coefficients[row, k, d]):
                    return False
        return True

    functions = dict(column=column, part=part, basis=basis, slopes=slopes, load=load, store=store)
    return SimpleNamespace(group=group, used_are_finite=used_are_finite, **functions)


@functools.cache
def forward_kernel(degree: int, channels: int, clamped: bool):
    """Fills the colours or sums, like the kernel of the CPU."""
    count, leaves = (degree + 1) ** 2, _leaves(degree, channels)
    group, load, basis = leaves.group, leaves.load, leaves.basis
    used_are_finite = leaves.used_are_finite

    @wp.kernel(enable_backward=False, module="unique", module_options=_OPTIONS, grid_stride=False)
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
            for step in range(wp.static(channels // group)):
                c = load(arrays_out.coefficients, row, step * wp.static(group))
                for d in range(wp.static(group)):
                    value = wp.float32(0.0)
                    for k in range(count):
                        value += Y[k] * c[k * wp.static(group) + d]
                    # a coefficient that is not finite leaves such a sum; the reverse need not hold
                    bad = bad or not wp.isfinite(value)
                    if wp.static(clamped):
                        value += 0.5
                        value = wp.where(value < 0.0, 0.0, value)
                    arrays_out.colors[at, step * wp.static(group) + d] = value
            if bad:
                finite = wp.isfinite(mean[0]) and wp.isfinite(mean[1]) and wp.isfinite(mean[2])
                if not (finite and used_are_finite(arrays_out.coefficients, row)):
                    for d in range(arrays_out.colors.shape[1]):
                        arrays_out.colors[at, d] = wp.nan

    return harmonics


@functools.cache
def backward_kernel(degree: int, channels: int, clamped: bool):
    """Computes the gradient of the forward kernel, like the kernel of the CPU."""
    count, leaves = (degree + 1) ** 2, _leaves(degree, channels)
    above = _ABOVE[clamped]
    group, part, load, store = leaves.group, leaves.part, leaves.load, leaves.store
    column, basis, slopes = leaves.column, leaves.basis, leaves.slopes

    @wp.kernel(enable_backward=False, module="unique", module_options=_OPTIONS, grid_stride=False)
    @no_type_check
    def harmonics_vjp(offset: wp.int32, size: Size, arrays_in: Arrays, v_arrays_out: Arrays):
        i = offset + wp.tid()
        num, views = size.num, size.views
        mean = arrays_in.means[i]
        b = i // num
        if v_arrays_out.coefficients:
            for step in range(wp.static(channels // group)):
                first = step * wp.static(group)
                v_part = part()
                for view in range(views):
                    image = b * views + view
                    at = image * num + i % num
                    t = _direction(mean, arrays_in.centers[image])
                    Y = basis(t[0], t[1], t[2])
                    for d in range(wp.static(group)):
                        # channels that pass no gradient on may hold NaN, which must not meet a zero
                        if arrays_in.colors[at, first + d] > wp.static(above):
                            v = v_arrays_out.colors[at, first + d]
                            for k in range(count):
                                v_part[k * wp.static(group) + d] += v * Y[k]
                    last = size.per_view != 0 or view == views - 1
                    if last:
                        row = wp.where(size.per_view != 0, at, i)
                        store(v_arrays_out.coefficients, row, first, v_part)
                        for k in range(count, v_arrays_out.coefficients.shape[1]):
                            for d in range(wp.static(group)):
                                v_arrays_out.coefficients[row, k, first + d] = 0.0
                        v_part = part()
        if wp.static(degree > 0) and (v_arrays_out.means or v_arrays_out.centers):
            v_mean = wp.vec3(0.0, 0.0, 0.0)
            for view in range(views):
                image = b * views + view
                at = image * num + i % num
                row = wp.where(size.per_view != 0, at, i)
                s = column()
                alive = wp.bool(False)
                for step in range(wp.static(channels // group)):
                    first = step * wp.static(group)
                    some = wp.bool(False)
                    for d in range(wp.static(group)):
                        some = some or arrays_in.colors[at, first + d] > wp.static(above)
                    if some:
                        # all used coefficients are finite, for else no channel would pass
                        alive = True
                        c = load(arrays_in.coefficients, row, first)
                        for d in range(wp.static(group)):
                            if arrays_in.colors[at, first + d] > wp.static(above):
                                v = v_arrays_out.colors[at, first + d]
                                for k in range(count):
                                    s[k] = s[k] + v * c[k * wp.static(group) + d]
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
