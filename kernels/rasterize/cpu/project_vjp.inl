// The gradient of a run of an object's Gaussians, over its views in their order, to the bits of the
// kernel of ../project.py. Gradients of antialiasing and of viewmats are that kernel's alone.
#include "pinhole.h"

// gradient of j = -focal slope(x/z)/z to (x, z), p = x/z; a clamped slope is a constant
auto slope_ = [&](F p, F z, float low, float high, float focal, F v, F& vx, F& vz) {
    const F s = less_(greater_(splat(low), p), splat(high));
    const F f = mul_(v, splat(focal)) / mul_(z, z);
    const I free = p == s;
    vx = free ? -f : F{};
    vz = free ? mul_(mul_(splat(2.0f), f), s) : mul_(f, s);
};
const int object = task / runs;
for (int i0 = begin; i0 < end; i0 += 16) {
    const int n = end - i0 < 16 ? end - i0 : 16;
    const size_t g = (size_t)object * num + i0;
    F v_mean[3] = {}, v_scale[3] = {}, v_opacity = F{}, v_R[3][3] = {};
    F mean[3], scale[3], q[4], R[3][3] = {}, size = F{};
    I ever = I{};
    for (int view = 0; view < views; ++view) {
        const size_t image = (size_t)object * views + view, i = image * num + i0;
        F v_u[2], v_conic[3], v_z, v_o;
        read_(v_splats.means2d.data + i, 2, n, v_u);
        read_(v_splats.conics.data + i, 3, n, v_conic);
        read_(v_splats.depths.data + i, 1, n, &v_z);
        read_(v_splats.opacities.data + i, 1, n, &v_o);
        I seen = I{};
        for (int l = 0; l < n; ++l) seen[l] = splats.status.data[i + l] == VISIBLE ? -1 : 0;
        if (lens.skip_unused)
            seen &= (I)(v_u[0] != 0.0f) | (I)(v_u[1] != 0.0f) | (I)(v_conic[0] != 0.0f)
                | (I)(v_conic[1] != 0.0f) | (I)(v_conic[2] != 0.0f) | (I)(v_z != 0.0f)
                | (I)(v_o != 0.0f);
        if (!any_(seen)) continue;
        if (!any_(ever)) {
            read_(scene.means.data + g, 3, n, mean);
            read_(scene.scales.data + g, 3, n, scale);
            if (scene.quats.data) {
                read_(scene.quats.data + g, 4, n, q);
                size = length_(q);
                rotate_(q, size, R);
            }
        }
        ever |= seen;
        const Camera camera = camera_of(image);
        const float *V = camera.V, *K = camera.K;
        F t[3], slopes[2], P[2][3], N[2][3], m0[3], m1[3], conic[3];
        to_camera_(camera, mean, t);
        jacobian_(camera, t, slopes, P);
        for (int r = 0; r < 2; ++r)
            if (scene.quats.data) turned_(P[r], R, N[r]);
            else
                for (int k = 0; k < 3; ++k) N[r][k] = P[r][k];
        for (int k = 0; k < 3; ++k) {
            m0[k] = mul_(N[0][k], scale[k]);
            m1[k] = mul_(N[1][k], scale[k]);
        }

        // README eq. 8: the conic's gradient to the covariance's
        read_(splats.conics.data + i, 3, n, conic);
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
            const F across = mul_(e, add_(mul_(splat(lens.eps2d), m0[j]), d[j]));
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
                v_P[r][j] = scene.quats.data
                    ? fma_(v_N[r][2], R[j][2], fma_(v_N[r][1], R[j][1], mul_(v_N[r][0], R[j][0])))
                    : v_N[r][j];
        auto v_J = [&](int r, int j) -> F {  // times the transpose of W
            return fma_(v_P[r][2], splat(V[4 * j + 2]),
                fma_(v_P[r][1], splat(V[4 * j + 1]), mul_(v_P[r][0], splat(V[4 * j]))));
        };
        const F z = t[2];
        F xx, xz, yy, yz;
        slope_(slopes[0], z, camera.left, camera.right, K[0], v_J(0, 2), xx, xz);
        slope_(slopes[1], z, camera.top, camera.bottom, K[4], v_J(1, 2), yy, yz);
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
    if (v_scene.means.data) write_(v_scene.means.data + g, 3, n, v_mean);
    if (v_scene.scales.data) write_(v_scene.scales.data + g, 3, n, v_scale);
    if (v_scene.opacities.data) write_(v_scene.opacities.data + g, 1, n, &v_opacity);
    if (!v_scene.quats.data) continue;
    F v_q[4] = {};
    if (any_(ever)) {
        const F w = q[0], x = q[1], y = q[2], u = q[3], two = splat(2.0f);
        const auto& v = v_R;
        auto plus = [&](int r, int c) { return add_(v[r][c], v[c][r]); };
        auto less = [&](int r, int c) { return minus_(v[r][c], v[c][r]); };
        auto both = [&](int r, int c) { return add_(v[r][r], v[c][c]); };
        F s[4];
        s[0] = add_(add_(mul_(x, less(2, 1)), mul_(y, less(0, 2))), mul_(u, less(1, 0)));
        s[1] = add_(
            add_(add_(mul_(mul_(-two, x), both(1, 2)), mul_(y, plus(0, 1))), mul_(u, plus(0, 2))),
            mul_(w, less(2, 1)));
        s[2] = add_(
            add_(minus_(mul_(x, plus(0, 1)), mul_(mul_(two, y), both(0, 2))), mul_(u, plus(1, 2))),
            mul_(w, less(0, 2)));
        s[3] = add_(
            minus_(add_(mul_(x, plus(0, 2)), mul_(y, plus(1, 2))), mul_(mul_(two, u), both(0, 1))),
            mul_(w, less(1, 0)));
        F dot = F{};
        for (int j = 0; j < 4; ++j) {
            s[j] = mul_(two, s[j]);
            dot += q[j] * s[j];
        }
        // the gradient of a shorter one leaves float32's range
        const I some = ever & (I)(size > 1e-30f);
        for (int j = 0; j < 4; ++j) v_q[j] = some ? minus_(s[j], mul_(q[j], dot)) / size : F{};
    }
    write_(v_scene.quats.data + g, 4, n, v_q);
}
