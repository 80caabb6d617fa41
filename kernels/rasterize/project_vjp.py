"""The vector-Jacobian product of the projection.

One thread per Gaussian, which loops over its views: sums over views are then in a fixed order.
README.md §4 holds the maths.
"""

from collections.abc import Callable
from typing import NamedTuple, no_type_check

import torch
import warp as wp
from torch import Tensor

from ..runtime.launch import launch
from ..runtime.views import vectors
from .project import (
    COMPENSATION_FLOOR,
    VISIBLE,
    Lens,
    empty_on,
    jacobian,
    mat23,
    quat_size,
    rotation,
    rotation_of,
    row_of,
    slope,
    translation_of,
    unit,
)

wp.set_module_options({"enable_backward": False})

_VISIBLE = wp.constant(VISIBLE)
_SHORTEST = wp.constant(1e-30)


class Cotangents(NamedTuple):
    """Upstream gradients of a projection, shaped as in ``Projected``; float32, contiguous."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    view_opacities: Tensor


class Wanted(NamedTuple):
    """Of which inputs the gradient is asked for."""

    means: bool
    quats: bool
    scales: bool
    opacities: bool
    viewmats: bool


class Gradients(NamedTuple):
    """Gradients of a projection's inputs, shaped as these; None where not asked for."""

    means: Tensor | None
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor | None
    viewmats: Tensor | None


@wp.func
@no_type_check
def _slope_vjp(
    p: wp.float32,
    z: wp.float32,
    center: wp.float32,
    size: wp.float32,
    focal: wp.float32,
    v: wp.float32,
) -> wp.vec2:
    # gradient of j = -focal·slope(x/z)/z to (x, z), p = x/z; a clamped slope is a constant
    s = slope(p, center, size, focal)
    f = v * focal / (z * z)
    if p == s:
        return wp.vec2(-f, 2.0 * f * s)
    return wp.vec2(0.0, f * s)


@wp.func
@no_type_check
def _rotation_vjp(q: wp.vec4, v: wp.mat33) -> wp.vec4:
    # through the matrix of a unit quaternion, then through the normalisation, less its 1/|q|
    w, x, y, z = q[0], q[1], q[2], q[3]
    vq = 2.0 * wp.vec4(
        x * (v[2, 1] - v[1, 2]) + y * (v[0, 2] - v[2, 0]) + z * (v[1, 0] - v[0, 1]),
        -2.0 * x * (v[1, 1] + v[2, 2])
        + y * (v[0, 1] + v[1, 0])
        + z * (v[0, 2] + v[2, 0])
        + w * (v[2, 1] - v[1, 2]),
        x * (v[0, 1] + v[1, 0])
        - 2.0 * y * (v[0, 0] + v[2, 2])
        + z * (v[1, 2] + v[2, 1])
        + w * (v[0, 2] - v[2, 0]),
        x * (v[0, 2] + v[2, 0])
        + y * (v[1, 2] + v[2, 1])
        - 2.0 * z * (v[0, 0] + v[1, 1])
        + w * (v[1, 0] - v[0, 1]),
    )
    return vq - q * wp.dot(q, vq)


@wp.func
def _all_zero(v_mean2d: wp.vec2, v_conic: wp.vec3, v_depth: float, v_opacity: float) -> bool:
    # exactly: NaN is not
    return (
        v_mean2d == wp.vec2(0.0, 0.0)
        and v_conic == wp.vec3(0.0, 0.0, 0.0)
        and v_depth == 0.0
        and v_opacity == 0.0
    )


@wp.kernel
@no_type_check
def _project_vjp(
    offset: wp.int32,
    views: wp.int32,
    num: wp.int32,
    lens: Lens,
    means_in: wp.array[wp.vec3],
    quats_in: wp.array[wp.vec4],
    scales_in: wp.array[wp.vec3],
    opacities_in: wp.array[wp.float32],
    viewmats_in: wp.array[wp.mat44],
    Ks_in: wp.array[wp.mat33],
    conics_in: wp.array[wp.vec3],
    status_in: wp.array[wp.int32],
    v_means2d_in: wp.array[wp.vec2],
    v_conics_in: wp.array[wp.vec3],
    v_depths_in: wp.array[wp.float32],
    v_view_opacities_in: wp.array[wp.float32],
    v_means_out: wp.array[wp.vec3],
    v_quats_out: wp.array[wp.vec4],
    v_scales_out: wp.array[wp.vec3],
    v_opacities_out: wp.array[wp.float32],
    v_viewmats_out: wp.array3d[wp.float32],
):
    g = offset + wp.tid()
    b = g // num
    scale = scales_in[g]
    q = wp.vec4(1.0, 0.0, 0.0, 0.0)
    R = wp.identity(n=3, dtype=wp.float32)
    if quats_in:
        q = unit(quats_in[g])
        R = rotation(q)
    v_mean = wp.vec3(0.0, 0.0, 0.0)
    v_R = wp.mat33()
    v_scale = wp.vec3(0.0, 0.0, 0.0)
    v_opacity = wp.float32(0.0)
    for view_index in range(views):
        image = b * views + view_index
        i = image * num + g % num
        unused = lens.skip_unused != 0 and _all_zero(
            v_means2d_in[i], v_conics_in[i], v_depths_in[i], v_view_opacities_in[i]
        )
        if status_in[i] == _VISIBLE and not unused:
            viewmat = viewmats_in[image]
            W = rotation_of(viewmat)
            t = W * means_in[g] + translation_of(viewmat)
            K = Ks_in[image]
            J = jacobian(t, K, lens)
            P = J * W
            N = P * R
            M = N * wp.diag(scale)
            m0 = row_of(M, 0)
            m1 = row_of(M, 1)

            # README eq. 8: the conic's gradient to the covariance's
            conic = conics_in[i]
            a, k, e = conic[0], conic[1], conic[2]
            v = v_conics_in[i]
            n = wp.cross(m0, m1)
            across = e * (lens.eps2d * m0 + wp.cross(m1, n))
            v_across = -2.0 * a * a * v[0]
            v_m0 = v_across * across - e * v[1] * m1
            v_m1 = (v_across * k - e * v[1]) * across - e * (v[1] * k + 2.0 * e * v[2]) * m1

            v_o = v_view_opacities_in[i]
            if lens.antialiased != 0:
                # README eq. 9: the factor sqrt(det0 / det), det0 = |m0 × m1|²
                det0 = wp.dot(n, n)
                trace = wp.dot(m0, m0) + wp.dot(m1, m1)
                det = det0 + lens.eps2d * trace + lens.eps2d * lens.eps2d
                factor = wp.sqrt(det0 / det)
                if factor > COMPENSATION_FLOOR:
                    v_factor = v_o * opacities_in[g]
                    v_det0 = 0.5 * v_factor / (factor * det)
                    v_det = -0.5 * v_factor * factor / det
                    v_n = 2.0 * (v_det0 + v_det) * n
                    v_m0 += wp.cross(m1, v_n) + 2.0 * v_det * lens.eps2d * m0
                    v_m1 += wp.cross(v_n, m0) + 2.0 * v_det * lens.eps2d * m1
                v_o *= wp.max(COMPENSATION_FLOOR, factor)
            v_opacity += v_o

            v_M = mat23(v_m0[0], v_m0[1], v_m0[2], v_m1[0], v_m1[1], v_m1[2])
            v_scale += wp.cw_mul(row_of(N, 0), v_m0) + wp.cw_mul(row_of(N, 1), v_m1)
            v_N = v_M * wp.diag(scale)
            v_R += wp.transpose(P) * v_N
            v_P = v_N * wp.transpose(R)
            v_J = v_P * wp.transpose(W)
            z = t[2]
            v_u = v_means2d_in[i]
            v_x = _slope_vjp(t[0] / z, z, K[0, 2], lens.width, K[0, 0], v_J[0, 2])
            v_y = _slope_vjp(t[1] / z, z, K[1, 2], lens.height, K[1, 1], v_J[1, 2])
            v_t = wp.vec3(
                v_x[0] + v_u[0] * K[0, 0] / z,
                v_y[0] + v_u[1] * K[1, 1] / z,
                v_x[1]
                + v_y[1]
                + v_depths_in[i]
                - (v_J[0, 0] * K[0, 0] + v_J[1, 1] * K[1, 1]) / (z * z)
                - (v_u[0] * K[0, 0] * t[0] + v_u[1] * K[1, 1] * t[1]) / (z * z),
            )
            v_mean += wp.transpose(W) * v_t
            if v_viewmats_out:
                v_W = wp.transpose(J) * v_P + wp.outer(v_t, means_in[g])
                for r in range(3):
                    for c in range(3):
                        v_viewmats_out[image, g % num, 4 * r + c] = v_W[r, c]
                    v_viewmats_out[image, g % num, 4 * r + 3] = v_t[r]
    if v_means_out:
        v_means_out[g] = v_mean
    if v_scales_out:
        v_scales_out[g] = v_scale
    if v_opacities_out:
        v_opacities_out[g] = v_opacity
    if v_quats_out:
        size = quat_size(quats_in[g])
        v_quats_out[g] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        # the gradient of a shorter one leaves float32's range
        if size > _SHORTEST:
            v_quats_out[g] = _rotation_vjp(q, v_R) / size


def _empty_like(x: Tensor) -> Tensor:
    return empty_on(x.device, x.shape, x.dtype)


def project_backward(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    lens: Lens,
    conics: Tensor,
    status: Tensor,
    cotangents: Cotangents,
    wanted: Wanted,
    on_lanes: Callable[..., None] | None,
) -> Gradients:
    """Gradients of ``project_forward``.

    Args:
        means: as given forward, like the next five.
        quats: as given forward.
        scales: as given forward.
        opacities: as given forward.
        viewmats: as given forward.
        Ks: as given forward.
        lens: as given forward.
        conics: as returned forward.
        status: as returned forward.
        cotangents: of what forward returned.
        wanted: what is asked for.
        on_lanes: the device's launcher where neither viewmats nor antialiasing are asked for, that
            of ``cpu/project_vjp.py``, or None.
    """
    batch, views, num = status.shape
    inputs = means, quats, scales, opacities
    # the kernel writes all of a gradient, where there is a view
    make = _empty_like if status.numel() else torch.zeros_like
    v_means, v_quats, v_scales, v_opacities = (
        make(x) if want and x is not None else None for x, want in zip(inputs, wanted)
    )
    v_viewmats = means.new_zeros(batch * views, num, 12) if wanted.viewmats else None
    gaussians = [vectors(means, wp.vec3), vectors(quats, wp.vec4), vectors(scales, wp.vec3)]
    given = [
        vectors(viewmats, wp.mat44),
        vectors(Ks, wp.mat33),
        vectors(conics, wp.vec3),
        status.view(-1),
        vectors(cotangents.means2d, wp.vec2),
        vectors(cotangents.conics, wp.vec3),
        cotangents.depths.view(-1),
        cotangents.view_opacities.view(-1),
    ]
    outputs = [
        vectors(v_means, wp.vec3),
        vectors(v_quats, wp.vec4),
        vectors(v_scales, wp.vec3),
        None if v_opacities is None else v_opacities.view(-1),
    ]
    plain = v_viewmats is None and not lens.antialiased
    if status.numel() and on_lanes and plain:
        on_lanes(batch, views, num, lens, [*gaussians, *given], outputs)
    elif status.numel():
        inputs = [views, num, lens, *gaussians, opacities.view(-1), *given]
        launch(_project_vjp, batch * num, inputs, [*outputs, v_viewmats], means.device)
    if v_viewmats is not None:
        v_viewmats = v_viewmats.sum(1).view(batch, views, 3, 4)
        v_viewmats = torch.nn.functional.pad(v_viewmats, (0, 0, 0, 1))
    return Gradients(v_means, v_quats, v_scales, v_opacities, v_viewmats)
