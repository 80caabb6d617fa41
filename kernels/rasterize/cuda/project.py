"""Kernels of the projection and of its gradient, a thread each (README.md §1 and §4).

Forward has a thread for each (view, Gaussian). The gradient has one for each Gaussian, which loops
over its views: sums over views are then in a fixed order. A CPU runs the gradient here as well
where the gradient of viewmats or of antialiasing is needed; else both run in ``../cpu/project.py``.
"""

import functools
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.views import struct, struct_of
from ..constants import COMPENSATION_MIN, CONIC_MAX, FRUSTUM_MARGIN, RADIUS_MAX, TILE
from ..projection import (
    FAR,
    NEAR,
    NOT_FINITE,
    OUTSIDE,
    SMALL,
    TRANSPARENT,
    VISIBLE,
    Projected,
    ProjectionParams,
    Scene,
    vec6,
)

wp.set_module_options({"enable_backward": False})

mat23 = wp.types.matrix((2, 3), wp.float32)
_SHORTEST = 1e-30  # the gradient of a shorter quaternion leaves float32's range


@wp.func
def rotation_of(m: wp.mat44) -> wp.mat33:
    return wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@wp.func
def translation_of(viewmat: wp.mat44) -> wp.vec3:
    return wp.vec3(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])


@wp.func
@no_type_check
def quat_size(q: wp.vec4) -> wp.float32:
    # scaled by the largest entry, so that neither tiny nor huge quaternions leave float32's range
    m = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
    size = wp.float32(0.0)
    if m > 0.0:
        size = m * wp.length(q / m)
    return size


@wp.func
@no_type_check
def rotation(q: wp.vec4) -> wp.mat33:
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
@no_type_check
def unit(q: wp.vec4, options: ProjectionParams) -> wp.vec4:
    if options.original != 0:
        return q
    size = quat_size(q)
    if size > 0.0:
        return q / size
    return wp.vec4(1.0, 0.0, 0.0, 0.0)


@wp.func
@no_type_check
def ratio(part: wp.float32, whole: wp.float32) -> wp.float32:
    return wp.where(whole > 0.0, part / whole, 0.0)


@wp.func
@no_type_check
def root_of(c: vec6) -> wp.mat33:
    # README eq. 15: the triangle whose square is the covariance; kept within what rounding leaves
    a = wp.sqrt(wp.max(c[0], 0.0))
    long = wp.sqrt(wp.max(c[3], 0.0))
    b = wp.clamp(ratio(c[1], a), -long, long)
    long = wp.sqrt(wp.max(c[5], 0.0))
    d = wp.clamp(ratio(c[2], a), -long, long)
    e = wp.sqrt(wp.max(c[3] - b * b, 0.0))
    rest = wp.max(c[5] - d * d, 0.0)
    long = wp.sqrt(rest)
    f = wp.clamp(ratio(c[4] - b * d, e), -long, long)
    g = wp.sqrt(wp.max(rest - f * f, 0.0))
    return wp.mat33(a, 0.0, 0.0, b, e, 0.0, d, f, g)


@wp.func
@no_type_check
def slope(
    p: wp.float32,
    center: wp.float32,
    size: wp.float32,
    focal: wp.float32,
    options: ProjectionParams,
) -> wp.float32:
    # x/z kept within README eq. 2's bounds: the image and a margin around it
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    if options.original != 0:
        center = 0.5 * size
    return wp.clamp(p, -(center / focal + margin), (size - center) / focal + margin)


@wp.func
@no_type_check
def jacobian(t: wp.vec3, K: wp.mat33, options: ProjectionParams) -> mat23:
    sx = slope(t[0] / t[2], K[0, 2], options.width, K[0, 0], options)
    sy = slope(t[1] / t[2], K[1, 2], options.height, K[1, 1], options)
    fx = K[0, 0] / t[2]
    fy = K[1, 1] / t[2]
    return mat23(fx, 0.0, -fx * sx, 0.0, fy, -fy * sy)


@wp.func
def row_of(M: mat23, i: int) -> wp.vec3:
    return wp.vec3(M[i, 0], M[i, 1], M[i, 2])


@wp.func
@no_type_check
def _finite3(v: wp.vec3) -> bool:
    # a sum is finite only if every term is (or the terms overflow, which is as bad)
    return wp.isfinite(wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2]))


@struct
class _Splat:
    """A Gaussian in a view; the fields of ``Projected``."""

    mean: wp.vec2
    conic: wp.vec3
    depth: wp.float32
    opacity: wp.float32
    extent: wp.vec2
    status: wp.int32


@wp.func
@no_type_check
def _splat(
    g: wp.int32,
    image: wp.int32,
    color_row: wp.int32,
    options: ProjectionParams,
    scene_in: Scene,
    colors_in: wp.array2d[wp.float32],
) -> _Splat:
    splat = _Splat()
    splat.conic = wp.vec3(1.0, 0.0, 1.0)
    mean = scene_in.means[g]
    opacity = scene_in.opacities[g]
    viewmat = scene_in.viewmats[image]
    t = rotation_of(viewmat) * mean + translation_of(viewmat)
    finite = _finite3(mean) and wp.isfinite(opacity) and _finite3(t)
    if scene_in.covars:
        c = scene_in.covars[g]
        finite = finite and _finite3(wp.vec3(c[0], c[1], c[2]))
        finite = finite and _finite3(wp.vec3(c[3], c[4], c[5]))
    else:
        finite = finite and _finite3(scene_in.scales[g])
    if scene_in.quats:
        q = scene_in.quats[g]
        finite = finite and wp.isfinite(wp.dot(wp.abs(q), wp.vec4(0.25, 0.25, 0.25, 0.25)))
    for c in range(colors_in.shape[1]):
        finite = finite and wp.isfinite(colors_in[color_row, c])
    # Every cull is written so that NaN fails it, and comes before the first division by z.
    if not finite:
        splat.status = NOT_FINITE
        return splat
    if not (t[2] >= options.near_plane):
        splat.status = NEAR
        return splat
    if not (t[2] <= options.far_plane):
        splat.status = FAR
        return splat
    if not (opacity >= options.alpha_min) and options.original == 0:
        splat.status = TRANSPARENT
        return splat

    K = scene_in.Ks[image]
    M = jacobian(t, K, options) * rotation_of(viewmat)
    if scene_in.covars:
        M = M * root_of(scene_in.covars[g])
    else:
        if scene_in.quats:
            M = M * rotation(unit(scene_in.quats[g], options))
        M = M * wp.diag(scene_in.scales[g])
    m0 = row_of(M, 0)
    m1 = row_of(M, 1)
    n = wp.cross(m0, m1)
    det0 = wp.dot(n, n)
    det = det0 + options.eps2d * (wp.dot(m0, m0) + wp.dot(m1, m1)) + options.eps2d * options.eps2d
    sxx = wp.dot(m0, m0) + options.eps2d
    sxy = wp.dot(m0, m1)
    syy = wp.dot(m1, m1) + options.eps2d
    if not (wp.isfinite(det) and det > 0.0 and syy > 0.0):
        splat.status = NOT_FINITE
        return splat
    a = syy / det
    e = 1.0 / syy
    center = wp.vec2(K[0, 0] * t[0] / t[2] + K[0, 2], K[1, 1] * t[1] / t[2] + K[1, 2])
    sound = a > 0.0 and a <= CONIC_MAX and e <= CONIC_MAX
    if not (sound and wp.isfinite(center[0]) and wp.isfinite(center[1])):
        splat.status = NOT_FINITE
        return splat
    if options.antialiased != 0:
        opacity *= wp.max(COMPENSATION_MIN, wp.sqrt(det0 / det))
        if not (opacity >= options.alpha_min) and options.original == 0:
            splat.status = TRANSPARENT
            return splat
    if options.original != 0:
        # README eq. 16: the radius, and whether its square of tiles is empty
        half = 0.5 * (sxx - syy)
        spread = wp.sqrt(wp.max(half * half + sxy * sxy, 0.1))
        radius = wp.min(wp.ceil(3.0 * wp.sqrt(0.5 * (sxx + syy) + spread)), RADIUS_MAX)
        right = wp.ceil(options.width / float(TILE)) * float(TILE)
        bottom = wp.ceil(options.height / float(TILE)) * float(TILE)
        inside_x = center[0] + radius >= 1.5 and center[0] - radius < right + 0.5
        inside_y = center[1] + radius >= 1.5 and center[1] - radius < bottom + 0.5
        if not (inside_x and inside_y):
            splat.status = OUTSIDE
            return splat
        splat.extent = wp.vec2(radius, radius)
        if not (opacity >= options.alpha_min):
            splat.status = TRANSPARENT
            return splat
    cut = wp.sqrt(2.0 * wp.log(opacity / options.alpha_min))
    extent = wp.vec2(cut * wp.sqrt(sxx), cut * wp.sqrt(syy))
    reach = extent
    if options.rounded != 0:
        reach = wp.vec2(wp.ceil(extent[0]), wp.ceil(extent[1]))
    if reach[0] <= options.radius_clip and reach[1] <= options.radius_clip:
        splat.status = SMALL
        return splat
    inside_x = center[0] + reach[0] >= 0.0 and center[0] - reach[0] <= options.width
    inside_y = center[1] + reach[1] >= 0.0 and center[1] - reach[1] <= options.height
    if not (inside_x and inside_y) and options.original == 0:
        splat.status = OUTSIDE
        return splat
    splat.status = VISIBLE
    splat.mean = center
    splat.conic = wp.vec3(a, -sxy / syy, e)
    splat.depth = t[2]
    splat.opacity = opacity
    if options.original == 0:
        splat.extent = extent
    return splat


@wp.kernel(grid_stride=False)
@no_type_check
def _project(
    offset: wp.int32,
    views: wp.int32,
    num: wp.int32,
    options: ProjectionParams,
    scene_in: Scene,
    colors_per_view: wp.int32,
    colors_in: wp.array2d[wp.float32],
    splats_out: struct_of(Projected),
):
    i = offset + wp.tid()
    image = i // num
    g = (image // views) * num + i % num
    row = g
    if colors_per_view != 0:
        row = i
    splat = _splat(g, image, row, options, scene_in, colors_in)
    splats_out.means2d[i] = splat.mean
    splats_out.conics[i] = splat.conic
    splats_out.depths[i] = splat.depth
    splats_out.view_opacities[i] = splat.opacity
    splats_out.extents[i] = splat.extent
    splats_out.status[i] = splat.status


@wp.func
@no_type_check
def _slope_vjp(
    p: wp.float32,
    z: wp.float32,
    center: wp.float32,
    size: wp.float32,
    focal: wp.float32,
    v: wp.float32,
    options: ProjectionParams,
) -> wp.vec2:
    # gradient of j = -focal·slope(x/z)/z to (x, z), p = x/z; a clamped slope is a constant, and
    # in the original slope·z is one
    s = slope(p, center, size, focal, options)
    f = v * focal / (z * z)
    if p == s:
        return wp.vec2(-f, 2.0 * f * s)
    if options.original != 0:
        return wp.vec2(0.0, 2.0 * f * s)
    return wp.vec2(0.0, f * s)


@wp.func
@no_type_check
def _rotation_vjp(q: wp.vec4, v: wp.mat33, options: ProjectionParams) -> wp.vec4:
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
    if options.original != 0:
        return vq
    return vq - q * wp.dot(q, vq)


@wp.func
@no_type_check
def _both(
    p0: wp.vec3,
    p1: wp.vec3,
    v_xx: wp.float32,
    v_xy: wp.float32,
    v_yy: wp.float32,
    r: wp.int32,
    c: wp.int32,
) -> wp.float32:
    # an entry of Pᵀ V P, from the rows of P and V = [[v_xx, v_xy/2], [v_xy/2, v_yy]]
    across = 0.5 * v_xy * (p0[r] * p1[c] + p1[r] * p0[c])
    return v_xx * p0[r] * p0[c] + across + v_yy * p1[r] * p1[c]


@wp.func
@no_type_check
def _all_zero(v: struct_of(Projected), i: wp.int32) -> bool:
    # exactly: NaN is not
    return (
        v.means2d[i] == wp.vec2(0.0, 0.0)
        and v.conics[i] == wp.vec3(0.0, 0.0, 0.0)
        and v.depths[i] == 0.0
        and v.view_opacities[i] == 0.0
    )


@functools.cache
def _vjp_kernel(covars: bool, original: bool):
    """The gradient's kernel; covariances and the original have theirs, for fewer registers."""

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    @no_type_check
    def project_vjp(
        offset: wp.int32,
        views: wp.int32,
        num: wp.int32,
        options: ProjectionParams,
        scene_in: Scene,
        splats_in: struct_of(Projected),
        v_splats_in: struct_of(Projected),
        v_scene_out: Scene,
        v_viewmats_out: wp.array3d[wp.float32],
    ):
        g = offset + wp.tid()
        b = g // num
        scale = wp.vec3(1.0, 1.0, 1.0)
        q = wp.vec4(1.0, 0.0, 0.0, 0.0)
        R = wp.identity(n=3, dtype=wp.float32)
        if wp.static(covars):
            R = root_of(scene_in.covars[g])  # in the place of the rotation, with scales of 1
        else:
            scale = scene_in.scales[g]
            if scene_in.quats:
                q = unit(scene_in.quats[g], options)
                R = rotation(q)
        v_covar = vec6()  # of these
        v_mean = wp.vec3(0.0, 0.0, 0.0)
        v_R = wp.mat33()
        v_scale = wp.vec3(0.0, 0.0, 0.0)
        v_opacity = wp.float32(0.0)
        for view_index in range(views):
            image = b * views + view_index
            i = image * num + g % num
            unused = options.skip_unused != 0 and _all_zero(v_splats_in, i)
            if splats_in.status[i] == VISIBLE and not unused:
                viewmat = scene_in.viewmats[image]
                W = rotation_of(viewmat)
                t = W * scene_in.means[g] + translation_of(viewmat)
                K = scene_in.Ks[image]
                J = jacobian(t, K, options)
                P = J * W
                N = P * R
                M = N * wp.diag(scale)
                m0 = row_of(M, 0)
                m1 = row_of(M, 1)

                # README eq. 8: the conic's gradient to the covariance's
                conic = splats_in.conics[i]
                a, k, e = conic[0], conic[1], conic[2]
                v = v_splats_in.conics[i]
                n = wp.cross(m0, m1)
                across = e * (options.eps2d * m0 + wp.cross(m1, n))
                v_across = -2.0 * a * a * v[0]
                v_m0 = v_across * across - e * v[1] * m1
                v_m1 = (v_across * k - e * v[1]) * across - e * (v[1] * k + 2.0 * e * v[2]) * m1

                v_o = v_splats_in.view_opacities[i]
                v_xx = wp.float32(0.0)
                v_xy = wp.float32(0.0)
                v_yy = wp.float32(0.0)
                if options.antialiased != 0:
                    # README eq. 9: the factor sqrt(det0 / det), det0 = |m0 × m1|²
                    det0 = wp.dot(n, n)
                    trace = wp.dot(m0, m0) + wp.dot(m1, m1)
                    det = det0 + options.eps2d * trace + options.eps2d * options.eps2d
                    factor = wp.sqrt(det0 / det)
                    if factor > COMPENSATION_MIN:
                        v_factor = v_o * scene_in.opacities[g]
                        v_det0 = 0.5 * v_factor / (factor * det)
                        v_det = -0.5 * v_factor * factor / det
                        xx = wp.dot(m0, m0)
                        xy = wp.dot(m0, m1)
                        yy = wp.dot(m1, m1)
                        v_xx = v_det0 * yy + v_det * (yy + options.eps2d)
                        v_xy = -2.0 * (v_det0 + v_det) * xy
                        v_yy = v_det0 * xx + v_det * (xx + options.eps2d)
                        if wp.static(original):
                            # README eq. 17: the slope of the factor where eps2d is added once more
                            eps = options.eps2d
                            xx += eps
                            yy += eps
                            whole = det + eps * (xx + yy) + eps * eps
                            v_whole = v_det0 * det * eps / (whole * whole)
                            v_xx = v_whole * (eps * yy + yy * yy + xy * xy)
                            v_xy = -2.0 * v_whole * xy * (eps + xx + yy)
                            v_yy = v_whole * (eps * xx + xx * xx + xy * xy)
                            v_m0 += 2.0 * v_xx * m0 + v_xy * m1
                            v_m1 += 2.0 * v_yy * m1 + v_xy * m0
                        else:
                            v_n = 2.0 * (v_det0 + v_det) * n
                            v_m0 += wp.cross(m1, v_n) + 2.0 * v_det * options.eps2d * m0
                            v_m1 += wp.cross(v_n, m0) + 2.0 * v_det * options.eps2d * m1
                    v_o *= wp.max(COMPENSATION_MIN, factor)
                v_opacity += v_o
                if wp.static(covars):
                    # README eq. 15
                    a2 = a * a
                    v_xx -= a2 * v[0]
                    v_xy -= 2.0 * a2 * k * v[0] + e * v[1]
                    v_yy -= a2 * k * k * v[0] + k * e * v[1] + e * e * v[2]
                    p0 = row_of(P, 0)
                    p1 = row_of(P, 1)
                    v_covar += vec6(
                        _both(p0, p1, v_xx, v_xy, v_yy, 0, 0),
                        2.0 * _both(p0, p1, v_xx, v_xy, v_yy, 0, 1),
                        2.0 * _both(p0, p1, v_xx, v_xy, v_yy, 0, 2),
                        _both(p0, p1, v_xx, v_xy, v_yy, 1, 1),
                        2.0 * _both(p0, p1, v_xx, v_xy, v_yy, 1, 2),
                        _both(p0, p1, v_xx, v_xy, v_yy, 2, 2),
                    )

                v_M = mat23(v_m0[0], v_m0[1], v_m0[2], v_m1[0], v_m1[1], v_m1[2])
                v_scale += wp.cw_mul(row_of(N, 0), v_m0) + wp.cw_mul(row_of(N, 1), v_m1)
                v_N = v_M * wp.diag(scale)
                v_R += wp.transpose(P) * v_N
                v_P = v_N * wp.transpose(R)
                v_J = v_P * wp.transpose(W)
                z = t[2]
                v_u = v_splats_in.means2d[i]
                v_x = _slope_vjp(t[0] / z, z, K[0, 2], options.width, K[0, 0], v_J[0, 2], options)
                v_y = _slope_vjp(t[1] / z, z, K[1, 2], options.height, K[1, 1], v_J[1, 2], options)
                v_t = wp.vec3(
                    v_x[0] + v_u[0] * K[0, 0] / z,
                    v_y[0] + v_u[1] * K[1, 1] / z,
                    v_x[1]
                    + v_y[1]
                    + v_splats_in.depths[i]
                    - (v_J[0, 0] * K[0, 0] + v_J[1, 1] * K[1, 1]) / (z * z)
                    - (v_u[0] * K[0, 0] * t[0] + v_u[1] * K[1, 1] * t[1]) / (z * z),
                )
                v_mean += wp.transpose(W) * v_t
                if v_viewmats_out:
                    v_W = wp.transpose(J) * v_P + wp.outer(v_t, scene_in.means[g])
                    for r in range(3):
                        for c in range(3):
                            v_viewmats_out[image, g % num, 4 * r + c] = v_W[r, c]
                        v_viewmats_out[image, g % num, 4 * r + 3] = v_t[r]
        if v_scene_out.means:
            v_scene_out.means[g] = v_mean
        if v_scene_out.scales:
            v_scene_out.scales[g] = v_scale
        if wp.static(covars):
            if v_scene_out.covars:
                v_scene_out.covars[g] = v_covar
        if v_scene_out.opacities:
            v_scene_out.opacities[g] = v_opacity
        if v_scene_out.quats:
            size = wp.float32(1.0)
            if options.original == 0:
                size = quat_size(scene_in.quats[g])
            v_scene_out.quats[g] = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if size > _SHORTEST:
                v_scene_out.quats[g] = _rotation_vjp(q, v_R, options) / size

    return project_vjp


def project_on_threads(images: int, num: int, arguments: list, device: torch.device) -> None:
    """Run the projection of ``num`` Gaussians into so many views, a thread for each of a view."""
    launch(_project, images * num, arguments, [], device)


def vjp_on_threads(batch: int, num: int, arguments: list, v_viewmats: Tensor | None) -> None:
    """Run the gradient for B objects; see ``projection.project_backward``."""
    options, scene = arguments[2:4]
    device, covars = scene.values[0].device, scene.values[3] is not None
    launch(
        _vjp_kernel(covars, bool(options.original)),
        batch * num,
        [*arguments, v_viewmats],
        [],
        device,
    )
