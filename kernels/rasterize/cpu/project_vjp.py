"""The gradient of the projection on the CPU: sixteen Gaussians as lanes, and the same bits as the
kernel of ``../project.py``, whose operations are done here in the same order. README.md §4 has
the maths. Gradients of antialiasing and of viewmats are that kernel's alone.
"""

from typing import no_type_check

import torch
import warp as wp

from ...runtime.launch import parallel_launch
from ..constants import FRUSTUM_MARGIN
from ..project import VISIBLE, Lens
from .project import LEAD

wp.set_module_options({"enable_backward": False})

_RUN = wp.constant(512)  # Gaussians of a task, a multiple of 16
_PIECES_PER_THREAD = 8  # those that are not seen cost less

_VJP = (
    LEAD
    + """
auto minus_ = [](F a, F b) -> F { return a - b; };
// gradient of j = -focal slope(x/z)/z to (x, z), p = x/z; a clamped slope is a constant
auto slope_ = [&](F p, F z, float low, float high, float focal, F v, F& vx, F& vz) {
    const F s = less_(greater_(splat(low), p), splat(high));
    const F f = mul_(v, splat(focal)) / mul_(z, z);
    const I free = p == s;
    vx = free ? -f : F{};
    vz = free ? mul_(mul_(splat(2.0f), f), s) : mul_(f, s);
};
auto bound_ = [&](float center, float size, float focal, float* low, float* high) {
    const float half = MARGIN * 0.5f, margin = half * size / focal;
    *low = -(center / focal + margin);
    *high = (size - center) / focal + margin;
};
const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
for (int i0 = begin; i0 < end; i0 += 16) {
    const int n = end - i0 < 16 ? end - i0 : 16;
    const size_t g = (size_t)object * num + i0;
    F v_mean[3] = {}, v_scale[3] = {}, v_opacity = F{}, v_R[3][3] = {};
    F mean[3], scale[3], q[4], R[3][3] = {}, size = F{};
    I ever = I{};
    for (int view = 0; view < views; ++view) {
        const size_t image = (size_t)object * views + view, i = image * num + i0;
        F v_u[2], v_conic[3], v_z, v_o;
        read_((const float*)v_means2d.data + 2 * i, 2, n, v_u);
        read_((const float*)v_conics.data + 3 * i, 3, n, v_conic);
        read_(v_depths.data + i, 1, n, &v_z);
        read_(v_opacities.data + i, 1, n, &v_o);
        I seen = I{};
        for (int l = 0; l < n; ++l) seen[l] = status.data[i + l] == VISIBLE ? -1 : 0;
        if (skip_unused)
            seen &= (I)(v_u[0] != 0.0f) | (I)(v_u[1] != 0.0f) | (I)(v_conic[0] != 0.0f)
                | (I)(v_conic[1] != 0.0f) | (I)(v_conic[2] != 0.0f) | (I)(v_z != 0.0f)
                | (I)(v_o != 0.0f);
        if (!any_(seen)) continue;
        if (!any_(ever)) {
            read_((const float*)means.data + 3 * g, 3, n, mean);
            read_((const float*)scales.data + 3 * g, 3, n, scale);
            if (quats.data) {
                read_((const float*)quats.data + 4 * g, 4, n, q);
                size = length_(q);
                rotate_(q, size, R);
            }
        }
        ever |= seen;
        const float* const V = (const float*)viewmats.data + image * 16;
        const float* const K = (const float*)Ks.data + image * 9;
        float left, right, top, bottom;
        bound_(K[2], width, K[0], &left, &right);
        bound_(K[5], height, K[4], &top, &bottom);
        F t[3], P[2][3], N[2][3], m0[3], m1[3], conic[3];
        to_camera_(V, mean, t);
        const F z = t[2], fx = K[0] / z, fy = K[4] / z, px = t[0] / z, py = t[1] / z;
        const F sx = less_(greater_(splat(left), px), splat(right));
        const F sy = less_(greater_(splat(top), py), splat(bottom));
        camera_(V, fx, -fx * sx, fy, -fy * sy, P[0], P[1]);
        for (int r = 0; r < 2; ++r)
            if (quats.data) turned_(P[r], R, N[r]);
            else for (int k = 0; k < 3; ++k) N[r][k] = P[r][k];
        for (int k = 0; k < 3; ++k) {
            m0[k] = mul_(N[0][k], scale[k]);
            m1[k] = mul_(N[1][k], scale[k]);
        }

        // README eq. 8: the conic's gradient to the covariance's
        read_((const float*)conics.data + 3 * i, 3, n, conic);
        const F a = conic[0], k = conic[1], e = conic[2], two = splat(2.0f);
        const F c[3] = {cross_(m0[1], m0[2], m1[1], m1[2]), cross_(m0[2], m0[0], m1[2], m1[0]),
            cross_(m0[0], m0[1], m1[0], m1[1])};
        const F d[3] = {cross_(m1[1], m1[2], c[1], c[2]), cross_(m1[2], m1[0], c[2], c[0]),
            cross_(m1[0], m1[1], c[0], c[1])};
        const F v_across = mul_(mul_(mul_(-two, a), a), v_conic[0]);
        const F shear = mul_(e, v_conic[1]);
        const F along = minus_(mul_(v_across, k), shear);
        const F whole = mul_(e, add_(mul_(v_conic[1], k), mul_(mul_(two, e), v_conic[2])));
        F v_m[2][3], v_N[2][3], v_P[2][3];
        for (int j = 0; j < 3; ++j) {
            const F across = mul_(e, add_(mul_(splat(eps2d), m0[j]), d[j]));
            v_m[0][j] = minus_(mul_(v_across, across), mul_(shear, m1[j]));
            v_m[1][j] = minus_(mul_(along, across), mul_(whole, m1[j]));
        }
        auto gather_ = [&](F& to, F value) { to = seen ? add_(to, value) : to; };
        gather_(v_opacity, v_o);
        for (int j = 0; j < 3; ++j)
            gather_(v_scale[j], add_(mul_(N[0][j], v_m[0][j]), mul_(N[1][j], v_m[1][j])));
        for (int r = 0; r < 2; ++r)
            for (int j = 0; j < 3; ++j) v_N[r][j] = mul_(v_m[r][j], scale[j]);
        for (int r = 0; r < 3; ++r)
            for (int j = 0; j < 3; ++j)
                gather_(v_R[r][j], fma_(P[1][r], v_N[1][j], mul_(P[0][r], v_N[0][j])));
        for (int r = 0; r < 2; ++r)
            for (int j = 0; j < 3; ++j)
                v_P[r][j] = quats.data ? fma_(v_N[r][2], R[j][2],
                    fma_(v_N[r][1], R[j][1], mul_(v_N[r][0], R[j][0]))) : v_N[r][j];
        auto v_J = [&](int r, int j) -> F {  // times the transpose of W
            return fma_(v_P[r][2], splat(V[4 * j + 2]),
                fma_(v_P[r][1], splat(V[4 * j + 1]), mul_(v_P[r][0], splat(V[4 * j]))));
        };
        F xx, xz, yy, yz;
        slope_(px, z, left, right, K[0], v_J(0, 2), xx, xz);
        slope_(py, z, top, bottom, K[4], v_J(1, 2), yy, yz);
        const F zz = mul_(z, z), ux = mul_(v_u[0], splat(K[0])), uy = mul_(v_u[1], splat(K[4]));
        const F focal = add_(mul_(v_J(0, 0), splat(K[0])), mul_(v_J(1, 1), splat(K[4])));
        const F center = add_(mul_(ux, t[0]), mul_(uy, t[1]));
        const F v_t[3] = {add_(xx, ux / z), add_(yy, uy / z),
            minus_(minus_(add_(add_(xz, yz), v_z), focal / zz), center / zz)};
        for (int j = 0; j < 3; ++j) {
            F sum = mul_(splat(V[j]), v_t[0]);
            sum = add_(sum, mul_(splat(V[4 + j]), v_t[1]));
            gather_(v_mean[j], add_(sum, mul_(splat(V[8 + j]), v_t[2])));
        }
    }
    if (v_means_out.data) write_((float*)v_means_out.data + 3 * g, 3, n, v_mean);
    if (v_scales_out.data) write_((float*)v_scales_out.data + 3 * g, 3, n, v_scale);
    if (v_opacities_out.data) write_(v_opacities_out.data + g, 1, n, &v_opacity);
    if (!v_quats_out.data) continue;
    F v_q[4] = {};
    if (any_(ever)) {
        const F w = q[0], x = q[1], y = q[2], u = q[3], two = splat(2.0f);
        const auto& v = v_R;
        auto plus = [&](int r, int c) { return add_(v[r][c], v[c][r]); };
        auto less = [&](int r, int c) { return minus_(v[r][c], v[c][r]); };
        auto both = [&](int r, int c) { return add_(v[r][r], v[c][c]); };
        F s[4];
        s[0] = add_(add_(mul_(x, less(2, 1)), mul_(y, less(0, 2))), mul_(u, less(1, 0)));
        s[1] = add_(add_(add_(mul_(mul_(-two, x), both(1, 2)), mul_(y, plus(0, 1))),
            mul_(u, plus(0, 2))), mul_(w, less(2, 1)));
        s[2] = add_(add_(minus_(mul_(x, plus(0, 1)), mul_(mul_(two, y), both(0, 2))),
            mul_(u, plus(1, 2))), mul_(w, less(0, 2)));
        s[3] = add_(minus_(add_(mul_(x, plus(0, 2)), mul_(y, plus(1, 2))),
            mul_(mul_(two, u), both(0, 1))), mul_(w, less(1, 0)));
        F dot = F{};
        for (int j = 0; j < 4; ++j) {
            s[j] = mul_(two, s[j]);
            dot += q[j] * s[j];
        }
        // the gradient of a shorter one leaves float32's range
        const I some = ever & (I)(size > 1e-30f);
        for (int j = 0; j < 4; ++j) v_q[j] = some ? minus_(s[j], mul_(q[j], dot)) / size : F{};
    }
    float part[4][16];
    for (int j = 0; j < 4; ++j) *(F*)part[j] = v_q[j];
    float* const out = (float*)v_quats_out.data + 4 * g;
    for (int l = 0; l < n; ++l)
        for (int j = 0; j < 4; ++j) out[4 * l + j] = part[j][l];
}
"""
)


_TEXT = _VJP.replace("MARGIN", f"{FRUSTUM_MARGIN}f").replace("VISIBLE", str(VISIBLE))


@wp.func_native(_TEXT)
def _vjp_run(
    object: int,
    views: int,
    num: int,
    begin: int,
    end: int,
    width: float,
    height: float,
    eps2d: float,
    skip_unused: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    viewmats: wp.array[wp.mat44],
    Ks: wp.array[wp.mat33],
    conics: wp.array[wp.vec3],
    status: wp.array[wp.int32],
    v_means2d: wp.array[wp.vec2],
    v_conics: wp.array[wp.vec3],
    v_depths: wp.array[wp.float32],
    v_opacities: wp.array[wp.float32],
    v_means_out: wp.array[wp.vec3],
    v_quats_out: wp.array[wp.vec4],
    v_scales_out: wp.array[wp.vec3],
    v_opacities_out: wp.array[wp.float32],
):
    """Gradients of the Gaussians [begin, end) of an object, over its views in their order."""
    ...


@wp.kernel
@no_type_check
def _project_vjp_lanes(
    offset: wp.int32,
    views: wp.int32,
    num: wp.int32,
    runs: wp.int32,
    lens: Lens,
    means_in: wp.array[wp.vec3],
    quats_in: wp.array[wp.vec4],
    scales_in: wp.array[wp.vec3],
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
):
    task = offset + wp.tid()
    begin = task % runs * _RUN
    _vjp_run(
        task // runs,
        views,
        num,
        begin,
        wp.min(begin + _RUN, num),
        lens.width,
        lens.height,
        lens.eps2d,
        lens.skip_unused,
        means_in,
        quats_in,
        scales_in,
        viewmats_in,
        Ks_in,
        conics_in,
        status_in,
        v_means2d_in,
        v_conics_in,
        v_depths_in,
        v_view_opacities_in,
        v_means_out,
        v_quats_out,
        v_scales_out,
        v_opacities_out,
    )


def vjp_on_lanes(batch: int, views: int, num: int, lens: Lens, inputs: list, outputs: list) -> None:
    """Runs the gradient for B objects.

    Args:
        batch: objects, B.
        views: of an object, at least 1.
        num: Gaussians of an object, at least 1.
        lens: from ``make_lens``; not of antialiasing.
        inputs: as the scalar kernel has them, from the means on, without the opacities.
        outputs: as the scalar kernel has them, without that of the viewmats.
    """
    runs = -(-num // _RUN)
    pieces = min(batch * runs, _PIECES_PER_THREAD * torch.get_num_threads())
    arguments = [views, num, runs, lens, *inputs]
    parallel_launch(_project_vjp_lanes, batch * runs, arguments, outputs, pieces=pieces)
