// Projects a run of an object's Gaussians into an image, sixteen at a time, to the bits of the
// kernel of ../project.py, whose operations are done here in the same order.
#include "pinhole.h"

const int image = task / runs, object = image / views, channels = colors.shape[1];
const Camera camera = camera_of(image);
const float* const K = camera.K;
auto finite_ = [&](F a) -> I { return abs_(a) <= 3.402823466e38f; };
auto sum_ = [&](const F* v) -> F { return add_(add_(abs_(v[0]), abs_(v[1])), abs_(v[2])); };
auto dot_ = [](const F* a, const F* b) -> F { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
for (int i0 = begin; i0 < end; i0 += 16) {
    const int n = end - i0 < 16 ? end - i0 : 16;
    const size_t i = (size_t)image * num + i0, g = (size_t)object * num + i0;
    F mean[3], scale[3], opacity, t[3];
    read_(scene.means.data + g, 3, n, mean);
    read_(scene.scales.data + g, 3, n, scale);
    read_(scene.opacities.data + g, 1, n, &opacity);
    to_camera_(camera, mean, t);
    I finite = finite_(sum_(mean)) & finite_(sum_(scale)) & finite_(opacity) & finite_(sum_(t));
    F q[4] = {splat(1.0f), F{}, F{}, F{}};
    if (scene.quats.data) {
        read_(scene.quats.data + g, 4, n, q);
        F sum = F{};
        for (int k = 0; k < 4; ++k) sum += abs_(q[k]) * 0.25f;
        finite &= finite_(sum);
    }
    const size_t row = colors_per_view ? i : g;
    const float* const color = colors.data + row * channels;
    F largest = F{};
    int c = 0;
    for (; c + 16 <= n * channels; c += 16) largest += *(const F*)(color + c) * 0.0f;
    float rest = any_(largest != 0.0f) ? 1.0f : 0.0f;
    for (; c < n * channels; ++c) rest += color[c] * 0.0f;
    if (rest != 0.0f)  // something is not finite: 0 times it is NaN
        for (int l = 0; l < n; ++l)
            for (int k = 0; k < channels; ++k)
                if (color[l * channels + k] * 0.0f != 0.0f) finite[l] = 0;

    // every cull is written so that NaN fails it, and comes before the first division by z
    const F z = t[2];
    I status =
        (z <= lens.far_plane) ? ((opacity >= lens.alpha_min) ? I{} : I{} + TRANSPARENT) : I{} + FAR;
    status = (z >= lens.near_plane) ? status : I{} + NEAR;
    status = finite ? status : I{} + NOT_FINITE;
    I seen = (I)(status == 0) & (I)(lane < n);
    F center[2] = {}, conic[3] = {splat(1.0f), F{}, splat(1.0f)}, extent[2] = {}, depth = F{};
    F shown = F{};
    if (any_(seen)) {
        F slopes[2], M[2][3];
        jacobian_(camera, t, slopes, M);
        if (scene.quats.data) {
            F R[3][3], N[2][3];
            rotate_(q, length_(q), R);
            for (int r = 0; r < 2; ++r) turned_(M[r], R, N[r]);
            for (int k = 0; k < 3; ++k) M[0][k] = N[0][k], M[1][k] = N[1][k];
        }
        F *const m0 = M[0], *const m1 = M[1];
        for (int k = 0; k < 3; ++k) m0[k] = mul_(m0[k], scale[k]), m1[k] = mul_(m1[k], scale[k]);
        const F across[3] = {cross_(m0[1], m0[2], m1[1], m1[2]), cross_(m0[2], m0[0], m1[2], m1[0]),
            cross_(m0[0], m0[1], m1[0], m1[1])};
        const F det0 = dot_(across, across), d00 = dot_(m0, m0), d11 = dot_(m1, m1);
        const F eps = splat(lens.eps2d);
        F det = add_(add_(det0, mul_(eps, add_(d00, d11))), mul_(eps, eps));
        F syy = add_(d11, eps);
        const F sxx = add_(d00, eps), sxy = dot_(m0, m1);
        const I solid = finite_(det) & (I)(det > 0.0f) & (I)(syy > 0.0f);
        det = solid ? det : splat(1.0f);
        syy = solid ? syy : splat(1.0f);
        const F a = syy / det, e = splat(1.0f) / syy;
        const F x = add_(mul_(splat(K[0]), t[0]) / z, splat(K[2]));
        const F y = add_(mul_(splat(K[4]), t[1]) / z, splat(K[5]));
        const I thick = (I)(a > 0.0f) & (I)(a <= CONIC_MAX) & (I)(e <= CONIC_MAX);
        const I sound = solid & thick & finite_(x) & finite_(y);
        shown = opacity;
        I faint = I{};
        if (lens.antialiased) {
            shown = mul_(opacity, greater_(splat(COMPENSATION_MIN), root_(det0 / det)));
            faint = ~(I)(shown >= lens.alpha_min);
        }
        float cuts[16];
        const F over = shown / lens.alpha_min;
        // of all lanes: to ask each costs more than its logarithm
        for (int l = 0; l < 16; ++l) cuts[l] = wp::log(over[l]);
        const F cut = root_(mul_(splat(2.0f), *(const F*)cuts));
        extent[0] = mul_(cut, root_(sxx));
        extent[1] = mul_(cut, root_(syy));
        F rx = extent[0], ry = extent[1];
        if (lens.rounded) rx = __builtin_elementwise_ceil(rx), ry = __builtin_elementwise_ceil(ry);
        const I small = (I)(rx <= lens.radius_clip) & (I)(ry <= lens.radius_clip);
        const I inside = (I)(x + rx >= 0.0f) & (I)(x - rx <= lens.width) & (I)(y + ry >= 0.0f)
            & (I)(y - ry <= lens.height);
        I fate = inside ? I{} : I{} + OUTSIDE;
        fate = small ? I{} + SMALL : fate;
        fate = faint ? I{} + TRANSPARENT : fate;
        fate = sound ? fate : I{} + NOT_FINITE;
        status = status == 0 ? fate : status;
        seen = (I)(status == 0) & (I)(lane < n);
        auto keep_ = [&](F v, float other) -> F { return seen ? v : splat(other); };
        center[0] = keep_(x, 0.0f);
        center[1] = keep_(y, 0.0f);
        conic[0] = keep_(a, 1.0f);
        conic[1] = keep_(-sxy / syy, 0.0f);
        conic[2] = keep_(e, 1.0f);
        extent[0] = keep_(extent[0], 0.0f);
        extent[1] = keep_(extent[1], 0.0f);
        depth = keep_(z, 0.0f);
        shown = keep_(shown, 0.0f);
    }
    write_(splats.means2d.data + i, 2, n, center);
    write_(splats.conics.data + i, 3, n, conic);
    write_(splats.extents.data + i, 2, n, extent);
    write_(splats.depths.data + i, 1, n, &depth);
    write_(splats.opacities.data + i, 1, n, &shown);
    if (n == 16) *(I*)(splats.status.data + i) = status;
    else
        for (int l = 0; l < n; ++l) splats.status.data[i + l] = status[l];
}
