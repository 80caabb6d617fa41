"""The harmonics on CUDA: one thread a Gaussian, which loops over its views.

So the gradients by coefficients and by the mean are summed by one thread, without atomics. Sums of
views go channel by channel: what a thread holds at a time is one column of coefficients, whatever
the number of channels. README.md §6 of the rasterizer holds the maths.
"""

import functools
from types import SimpleNamespace
from typing import no_type_check

import warp as wp
from torch import Tensor

from ...runtime.launch import cuda_launch
from ...runtime.views import vectors, view
from .polynomials import SHORTEST, basis_text, slopes_text

# Loops over a column of coefficients are written out, so that it stays in registers.
_OPTIONS = {"enable_backward": False, "max_unroll": 25}
_SHORTEST = wp.constant(SHORTEST)


@wp.func
@no_type_check
def _direction(mean: wp.vec3, center: wp.vec3) -> wp.vec4:
    # the direction from the centre, and the length as it is
    t = mean - center
    size = wp.length(t)
    t = t / wp.max(size, _SHORTEST)
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
    packed = f"wp::vec_t<{count}, float>"

    @wp.func_native(f"typedef float F; {packed} Y; {basis_text(degree)} return Y;")
    def basis(x: wp.float32, y: wp.float32, z: wp.float32) -> column: ...

    @wp.func_native(
        f"typedef float F; F v_x = 0.0f, v_y = 0.0f, v_z = 0.0f; {slopes_text(degree)}"
        "return wp::vec_t<3, float>(v_x, v_y, v_z);"
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
def _forward_kernel(degree: int, clamped: bool):
    count, leaves = (degree + 1) ** 2, _leaves(degree)
    basis, used_are_finite = leaves.basis, leaves.used_are_finite

    @wp.kernel(module="unique", module_options=_OPTIONS)
    @no_type_check
    def harmonics(
        num: wp.int32,
        views: wp.int32,
        per_view: wp.int32,
        coefficients_in: wp.array3d[wp.float32],
        means_in: wp.array[wp.vec3],
        centers_in: wp.array[wp.vec3],
        colors_out: wp.array2d[wp.float32],
    ):
        i = wp.tid()
        mean = means_in[i]
        for seen in range(views):
            image = i // num * views + seen
            at = image * num + i % num
            row = wp.where(per_view != 0, at, i)
            t = _direction(mean, centers_in[image])
            Y = basis(t[0], t[1], t[2])
            bad = not (wp.isfinite(mean[0]) and wp.isfinite(mean[1]) and wp.isfinite(mean[2]))
            for d in range(colors_out.shape[1]):
                value = wp.float32(0.0)
                for k in range(count):
                    value += Y[k] * coefficients_in[row, k, d]
                # a coefficient that is not finite leaves such a sum; the reverse need not hold
                bad = bad or not wp.isfinite(value)
                if wp.static(clamped):
                    value += 0.5
                    value = wp.where(value < 0.0, 0.0, value)
                colors_out[at, d] = value
            if bad:
                finite = wp.isfinite(mean[0]) and wp.isfinite(mean[1]) and wp.isfinite(mean[2])
                if not (finite and used_are_finite(coefficients_in, row)):
                    for d in range(colors_out.shape[1]):
                        colors_out[at, d] = wp.nan

    return harmonics


@functools.cache
def _backward_kernel(degree: int, clamped: bool):
    count, leaves = (degree + 1) ** 2, _leaves(degree)
    above = _ABOVE[clamped]
    column, basis, slopes = leaves.column, leaves.basis, leaves.slopes

    @wp.kernel(module="unique", module_options=_OPTIONS)
    @no_type_check
    def harmonics_vjp(
        num: wp.int32,
        views: wp.int32,
        per_view: wp.int32,
        coefficients_in: wp.array3d[wp.float32],
        means_in: wp.array[wp.vec3],
        centers_in: wp.array[wp.vec3],
        colors_in: wp.array2d[wp.float32],
        v_colors_in: wp.array2d[wp.float32],
        v_coefficients_out: wp.array3d[wp.float32],
        v_means_out: wp.array[wp.vec3],
        v_centers_out: wp.array2d[wp.vec3],
    ):
        i = wp.tid()
        mean = means_in[i]
        b = i // num
        channels = v_colors_in.shape[1]
        if v_coefficients_out:
            for d in range(channels):
                v_column = column()
                for seen in range(views):
                    image = b * views + seen
                    at = image * num + i % num
                    # what passes no gradient on may hold NaN, which must not meet a zero
                    if colors_in[at, d] > wp.static(above):
                        t = _direction(mean, centers_in[image])
                        v_column += v_colors_in[at, d] * basis(t[0], t[1], t[2])
                    last = per_view != 0 or seen == views - 1
                    if last:
                        row = wp.where(per_view != 0, at, i)
                        for k in range(count):
                            v_coefficients_out[row, k, d] = v_column[k]
                        for k in range(count, v_coefficients_out.shape[1]):
                            v_coefficients_out[row, k, d] = 0.0
                        v_column = column()
        if wp.static(degree > 0) and (v_means_out or v_centers_out):
            v_mean = wp.vec3(0.0, 0.0, 0.0)
            for seen in range(views):
                image = b * views + seen
                at = image * num + i % num
                row = wp.where(per_view != 0, at, i)
                s = column()
                alive = wp.bool(False)
                for d in range(channels):
                    if colors_in[at, d] > wp.static(above):
                        alive = True
                        v = v_colors_in[at, d]
                        for k in range(count):
                            s[k] = s[k] + v * coefficients_in[row, k, d]
                if alive:
                    t = _direction(mean, centers_in[image])
                    u = wp.vec3(t[0], t[1], t[2])
                    v_t = slopes(u[0], u[1], u[2], s)
                    # through the division by the length, a constant where it is too short
                    if t[3] >= _SHORTEST:
                        v_t = v_t - wp.dot(u, v_t) * u
                    v_t = v_t / wp.max(t[3], _SHORTEST)
                    v_mean += v_t
                    if v_centers_out:
                        v_centers_out[image, i % num] = -v_t
            if v_means_out:
                v_means_out[i] = v_mean

    return harmonics_vjp


def _launch(kernel, tensors: list[Tensor], outputs: list) -> None:
    coefficients, means, centers, *rest = tensors
    batch, num, _ = means.shape
    rows = coefficients.flatten(0, -3)
    points = vectors(means, wp.vec3), vectors(centers, wp.vec3)
    inputs = [num, centers.shape[1], int(coefficients.dim() == 5), rows, *points]
    inputs += [x.flatten(0, -2) for x in rest]
    cuda_launch(kernel, batch * num, inputs, outputs, device=means.device)


def harmonics_forward(
    degree: int,
    clamped: bool,
    coefficients: Tensor,
    means: Tensor,
    centers: Tensor,
    colors: Tensor,
) -> None:
    """As the CPU's: fills the colours."""
    outputs = [colors.flatten(0, -2)]
    _launch(_forward_kernel(degree, clamped), [coefficients, means, centers], outputs)


def harmonics_backward(
    degree: int,
    clamped: bool,
    coefficients: Tensor,
    means: Tensor,
    centers: Tensor,
    colors: Tensor,
    v_colors: Tensor,
    wanted: list[bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """As the CPU's: gradients by coefficients, means and centers; None if not wanted."""
    (batch, views, _), num = centers.shape, means.shape[1]
    v_coefficients = coefficients.new_empty(coefficients.shape) if wanted[0] else None
    v_means = means.new_zeros(means.shape) if wanted[1] else None
    v_centers = means.new_zeros(batch * views, num, 3) if wanted[2] else None
    outputs = [
        None if v_coefficients is None else v_coefficients.flatten(0, -3),
        vectors(v_means, wp.vec3),
        None if v_centers is None else view(v_centers, wp.vec3),
    ]
    tensors = [coefficients, means, centers, colors, v_colors]
    _launch(_backward_kernel(degree, clamped), tensors, outputs)
    return (
        v_coefficients,
        v_means,
        None if v_centers is None else v_centers.sum(1).view(batch, views, 3),
    )
