"""3D Gaussians to 2D: culling, the EWA projection and its vector-Jacobian product.

One thread per (view, Gaussian) forward; one per Gaussian, looping over its views, backward: sums
over views are then in a fixed order. README.md §1 and §4 hold the maths.
"""

import torch
import warp as wp
from torch import Tensor

from ..constants import COMPENSATION_MIN, FRUSTUM_MARGIN
from .launch import launch, vectors

wp.set_module_options({"enable_backward": False})

mat23 = wp.types.matrix((2, 3), wp.float32)

# status of a (view, Gaussian)
VISIBLE, NEAR, FAR, NOT_FINITE, TRANSPARENT, OUTSIDE, SMALL = range(7)
STATUS_NAMES = ("visible", "near", "far", "not_finite", "transparent", "outside", "small")

_MARGIN = wp.constant(FRUSTUM_MARGIN)
_COMPENSATION_MIN = wp.constant(COMPENSATION_MIN)
_VISIBLE = wp.constant(VISIBLE)
_NEAR = wp.constant(NEAR)
_FAR = wp.constant(FAR)
_NOT_FINITE = wp.constant(NOT_FINITE)
_TRANSPARENT = wp.constant(TRANSPARENT)
_OUTSIDE = wp.constant(OUTSIDE)
_SMALL = wp.constant(SMALL)


@wp.struct
class Lens:
    """Per launch: picture size and thresholds."""

    width: wp.float32
    height: wp.float32
    near_plane: wp.float32
    far_plane: wp.float32
    radius_clip: wp.float32
    eps2d: wp.float32
    alpha_min: wp.float32
    antialiased: wp.int32


@wp.func
def _rotation_of(viewmat: wp.mat44) -> wp.mat33:
    return wp.mat33(
        viewmat[0, 0],
        viewmat[0, 1],
        viewmat[0, 2],
        viewmat[1, 0],
        viewmat[1, 1],
        viewmat[1, 2],
        viewmat[2, 0],
        viewmat[2, 1],
        viewmat[2, 2],
    )


@wp.func
def _translation_of(viewmat: wp.mat44) -> wp.vec3:
    return wp.vec3(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])


@wp.func
def _quat_size(q: wp.vec4) -> wp.float32:
    # scaled by the largest entry, so that neither tiny nor huge quaternions leave float32's range
    m = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
    size = wp.float32(0.0)
    if m > 0.0:
        size = m * wp.length(q / m)
    return size


@wp.func
def _rotation(q: wp.vec4) -> wp.mat33:
    # q is a unit quaternion (w, x, y, z)
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
def _unit(q: wp.vec4) -> wp.vec4:
    size = _quat_size(q)
    if size > 0.0:
        return q / size
    return wp.vec4(1.0, 0.0, 0.0, 0.0)


@wp.func
def _slope(p: wp.float32, center: wp.float32, size: wp.float32, focal: wp.float32) -> wp.float32:
    # README eq. 2: x/z kept within the picture and a margin around it
    margin = _MARGIN * 0.5 * size / focal
    return wp.clamp(p, -(center / focal + margin), (size - center) / focal + margin)


@wp.func
def _jacobian(t: wp.vec3, K: wp.mat33, lens: Lens) -> mat23:
    sx = _slope(t[0] / t[2], K[0, 2], lens.width, K[0, 0])
    sy = _slope(t[1] / t[2], K[1, 2], lens.height, K[1, 1])
    fx = K[0, 0] / t[2]
    fy = K[1, 1] / t[2]
    return mat23(fx, 0.0, -fx * sx, 0.0, fy, -fy * sy)


@wp.func
def _row(M: mat23, i: int) -> wp.vec3:
    return wp.vec3(M[i, 0], M[i, 1], M[i, 2])


@wp.func
def _finite3(v: wp.vec3) -> bool:
    # a sum is finite only if every term is (or the terms overflow, which is as bad)
    return wp.isfinite(wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2]))


@wp.kernel
def _project(
    offset: wp.int32,
    views: wp.int32,
    num: wp.int32,
    colors_per_view: wp.int32,
    lens: Lens,
    means_in: wp.array[wp.vec3],
    quats_in: wp.array[wp.vec4],
    scales_in: wp.array[wp.vec3],
    opacities_in: wp.array[wp.float32],
    colors_in: wp.array2d[wp.float32],
    viewmats_in: wp.array[wp.mat44],
    Ks_in: wp.array[wp.mat33],
    means2d_out: wp.array[wp.vec2],
    conics_out: wp.array[wp.vec3],
    depths_out: wp.array[wp.float32],
    view_opacities_out: wp.array[wp.float32],
    extents_out: wp.array[wp.vec2],
    status_out: wp.array[wp.int32],
):
    i = offset + wp.tid()
    image = i // num
    g = (image // views) * num + i % num
    means2d_out[i] = wp.vec2(0.0, 0.0)
    conics_out[i] = wp.vec3(1.0, 0.0, 1.0)
    depths_out[i] = 0.0
    view_opacities_out[i] = 0.0
    extents_out[i] = wp.vec2(0.0, 0.0)

    mean = means_in[g]
    scale = scales_in[g]
    opacity = opacities_in[g]
    viewmat = viewmats_in[image]
    t = _rotation_of(viewmat) * mean + _translation_of(viewmat)
    finite = _finite3(mean) and _finite3(scale) and wp.isfinite(opacity) and _finite3(t)
    if quats_in:
        q = quats_in[g]
        finite = finite and wp.isfinite(wp.dot(wp.abs(q), wp.vec4(0.25, 0.25, 0.25, 0.25)))
    row = g
    if colors_per_view != 0:
        row = i
    for c in range(colors_in.shape[1]):
        finite = finite and wp.isfinite(colors_in[row, c])
    # Every cull is written so that NaN fails it, and comes before the first division by z.
    if not finite:
        status_out[i] = _NOT_FINITE
        return
    if not (t[2] >= lens.near_plane):
        status_out[i] = _NEAR
        return
    if not (t[2] <= lens.far_plane):
        status_out[i] = _FAR
        return
    if not (opacity >= lens.alpha_min):
        status_out[i] = _TRANSPARENT
        return

    K = Ks_in[image]
    M = _jacobian(t, K, lens) * _rotation_of(viewmat)
    if quats_in:
        M = M * _rotation(_unit(quats_in[g]))
    M = M * wp.diag(scale)
    m0 = _row(M, 0)
    m1 = _row(M, 1)
    n = wp.cross(m0, m1)
    det0 = wp.dot(n, n)
    det = det0 + lens.eps2d * (wp.dot(m0, m0) + wp.dot(m1, m1)) + lens.eps2d * lens.eps2d
    sxx = wp.dot(m0, m0) + lens.eps2d
    sxy = wp.dot(m0, m1)
    syy = wp.dot(m1, m1) + lens.eps2d
    a = syy / det
    center = wp.vec2(K[0, 0] * t[0] / t[2] + K[0, 2], K[1, 1] * t[1] / t[2] + K[1, 2])
    if not (wp.isfinite(det) and a > 0.0 and wp.isfinite(center[0]) and wp.isfinite(center[1])):
        status_out[i] = _NOT_FINITE
        return
    if lens.antialiased != 0:
        opacity *= wp.max(_COMPENSATION_MIN, wp.sqrt(det0 / det))
        if not (opacity >= lens.alpha_min):
            status_out[i] = _TRANSPARENT
            return
    cut = wp.sqrt(2.0 * wp.log(opacity / lens.alpha_min))
    extent = wp.vec2(cut * wp.sqrt(sxx), cut * wp.sqrt(syy))
    if extent[0] <= lens.radius_clip and extent[1] <= lens.radius_clip:
        status_out[i] = _SMALL
        return
    inside_x = center[0] + extent[0] >= 0.0 and center[0] - extent[0] <= lens.width
    inside_y = center[1] + extent[1] >= 0.0 and center[1] - extent[1] <= lens.height
    if not (inside_x and inside_y):
        status_out[i] = _OUTSIDE
        return
    status_out[i] = _VISIBLE
    means2d_out[i] = center
    conics_out[i] = wp.vec3(a, -sxy / syy, 1.0 / syy)
    depths_out[i] = t[2]
    view_opacities_out[i] = opacity
    extents_out[i] = extent


@wp.func
def _slope_vjp(
    p: wp.float32,
    z: wp.float32,
    center: wp.float32,
    size: wp.float32,
    focal: wp.float32,
    v: wp.float32,
) -> wp.vec2:
    # of j = -focal·slope(x/z)/z with respect to (x, z), p = x/z; a clamped slope is a constant
    s = _slope(p, center, size, focal)
    f = v * focal / (z * z)
    if p == s:
        return wp.vec2(-f, 2.0 * f * s)
    return wp.vec2(0.0, f * s)


@wp.func
def _rotation_vjp(q: wp.vec4, v: wp.mat33) -> wp.vec4:
    # of the matrix of a unit quaternion, then of the normalisation but for 1/|q|
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


@wp.kernel
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
        q = _unit(quats_in[g])
        R = _rotation(q)
    v_mean = wp.vec3(0.0, 0.0, 0.0)
    v_R = wp.mat33()
    v_scale = wp.vec3(0.0, 0.0, 0.0)
    v_opacity = wp.float32(0.0)
    for view_index in range(views):
        image = b * views + view_index
        i = image * num + g % num
        if status_in[i] == _VISIBLE:
            viewmat = viewmats_in[image]
            W = _rotation_of(viewmat)
            t = W * means_in[g] + _translation_of(viewmat)
            K = Ks_in[image]
            J = _jacobian(t, K, lens)
            P = J * W
            N = P * R
            M = N * wp.diag(scale)
            m0 = _row(M, 0)
            m1 = _row(M, 1)

            # README eq. 8: the conic's gradient to the covariance's
            conic = conics_in[i]
            a, k, e = conic[0], conic[1], conic[2]
            v = v_conics_in[i]
            v_sxx = -a * a * v[0]
            v_sxy = -2.0 * a * a * k * v[0] - e * v[1]
            v_syy = -a * a * k * k * v[0] - k * e * v[1] - e * e * v[2]
            v_m0 = 2.0 * v_sxx * m0 + v_sxy * m1
            v_m1 = v_sxy * m0 + 2.0 * v_syy * m1

            v_o = v_view_opacities_in[i]
            if lens.antialiased != 0:
                # README eq. 9: the factor sqrt(det0 / det), det0 = |m0 × m1|²
                n = wp.cross(m0, m1)
                det0 = wp.dot(n, n)
                trace = wp.dot(m0, m0) + wp.dot(m1, m1)
                det = det0 + lens.eps2d * trace + lens.eps2d * lens.eps2d
                factor = wp.sqrt(det0 / det)
                if factor > _COMPENSATION_MIN:
                    v_factor = v_o * opacities_in[g]
                    v_det0 = 0.5 * v_factor / (factor * det)
                    v_det = -0.5 * v_factor * factor / det
                    v_n = 2.0 * (v_det0 + v_det) * n
                    v_m0 += wp.cross(m1, v_n) + 2.0 * v_det * lens.eps2d * m0
                    v_m1 += wp.cross(v_n, m0) + 2.0 * v_det * lens.eps2d * m1
                v_o *= wp.max(_COMPENSATION_MIN, factor)
            v_opacity += v_o

            v_M = mat23(v_m0[0], v_m0[1], v_m0[2], v_m1[0], v_m1[1], v_m1[2])
            v_scale += wp.cw_mul(_row(N, 0), v_m0) + wp.cw_mul(_row(N, 1), v_m1)
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
        size = _quat_size(quats_in[g])
        v_quats_out[g] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if size > 0.0:
            v_quats_out[g] = _rotation_vjp(q, v_R) / size


def make_lens(
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    alpha_min: float,
    antialiased: bool,
) -> Lens:
    """The scalars of a projection as one kernel argument."""
    lens = Lens()
    lens.width, lens.height = float(width), float(height)
    lens.near_plane, lens.far_plane = near_plane, far_plane
    lens.radius_clip, lens.eps2d = radius_clip, eps2d
    lens.alpha_min, lens.antialiased = alpha_min, int(antialiased)
    return lens


def project_forward(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    lens: Lens,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Projects B objects of N Gaussians into V views each; float32, contiguous tensors.

    Args:
        means: ``[B, N, 3]``.
        quats: ``[B, N, 4]`` or None.
        scales: ``[B, N, 3]``.
        opacities: ``[B, N]``.
        colors: ``[B, N, C]`` or ``[B, V, N, C]``, only to cull what is not finite.
        viewmats: ``[B, V, 4, 4]``.
        Ks: ``[B, V, 3, 3]``.
        lens: from ``make_lens``.

    Returns:
        ``means2d [B, V, N, 2]`` in pixels; ``conics [B, V, N, 3]``: a, k, e of README eq. 4;
        ``depths [B, V, N]``; ``view_opacities [B, V, N]``; ``extents [B, V, N, 2]``: half sides of
        the box around alpha >= alpha_min in pixels; ``status [B, V, N]`` int32. Culled: zeros.
    """
    (batch, views), num = viewmats.shape[:2], means.shape[1]
    shape = (batch, views, num)
    means2d, conics, extents = (means.new_empty(*shape, size) for size in (2, 3, 2))
    depths, view_opacities = means.new_empty(shape), means.new_empty(shape)
    status = torch.empty(shape, dtype=torch.int32, device=means.device)
    if status.numel():
        launch(
            _project,
            status.numel(),
            [
                views,
                num,
                int(colors.dim() == 4),
                lens,
                vectors(means, wp.vec3),
                vectors(quats, wp.vec4),
                vectors(scales, wp.vec3),
                opacities.view(-1),
                colors.view(-1, colors.shape[-1]),
                vectors(viewmats, wp.mat44),
                vectors(Ks, wp.mat33),
            ],
            [
                vectors(means2d, wp.vec2),
                vectors(conics, wp.vec3),
                depths.view(-1),
                view_opacities.view(-1),
                vectors(extents, wp.vec2),
                status.view(-1),
            ],
            means.device,
        )
    return means2d, conics, depths, view_opacities, extents, status


def project_backward(
    inputs: tuple[Tensor | None, ...],
    lens: Lens,
    conics: Tensor,
    status: Tensor,
    cotangents: tuple[Tensor, Tensor, Tensor, Tensor],
    needs: tuple[bool, bool, bool, bool, bool],
) -> tuple[Tensor | None, ...]:
    """Gradients of ``project_forward``.

    Args:
        inputs: means, quats, scales, opacities, viewmats, Ks as given forward.
        lens: as given forward.
        conics: as returned forward.
        status: as returned forward.
        cotangents: of means2d, conics, depths, view_opacities; float32, contiguous.
        needs: which of means, quats, scales, opacities, viewmats are asked for.

    Returns:
        The gradients of those five, None where not asked for.
    """
    means, quats, scales, opacities, viewmats, Ks = inputs
    batch, views, num = status.shape
    v_means, v_quats, v_scales, v_opacities = (
        torch.zeros_like(x) if need and x is not None else None
        for x, need in zip((means, quats, scales, opacities), needs)
    )
    v_viewmats = means.new_zeros(batch * views, num, 12) if needs[4] else None
    if status.numel():
        v_means2d, v_conics, v_depths, v_view_opacities = cotangents
        launch(
            _project_vjp,
            batch * num,
            [
                views,
                num,
                lens,
                vectors(means, wp.vec3),
                vectors(quats, wp.vec4),
                vectors(scales, wp.vec3),
                opacities.view(-1),
                vectors(viewmats, wp.mat44),
                vectors(Ks, wp.mat33),
                vectors(conics, wp.vec3),
                status.view(-1),
                vectors(v_means2d, wp.vec2),
                vectors(v_conics, wp.vec3),
                v_depths.view(-1),
                v_view_opacities.view(-1),
            ],
            [
                vectors(v_means, wp.vec3),
                vectors(v_quats, wp.vec4),
                vectors(v_scales, wp.vec3),
                None if v_opacities is None else v_opacities.view(-1),
                v_viewmats,
            ],
            means.device,
        )
    if v_viewmats is not None:
        v_viewmats = v_viewmats.sum(1).view(batch, views, 3, 4)
        v_viewmats = torch.nn.functional.pad(v_viewmats, (0, 0, 0, 1))
    return v_means, v_quats, v_scales, v_opacities, v_viewmats
