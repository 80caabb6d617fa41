// needs: project.py: num, RUN, task, scene, MARGIN, lens, GRADIENT, views, v_splats, splats,
//     v_scene, colors, colors_per_view, COMPENSATION_MIN, CONIC_MAX, RADIUS_MAX, TILE;
//     projection.py: VISIBLE, TRANSPARENT, FAR, NEAR, NOT_FINITE, OUTSIDE, SMALL
// gives: the bodies of project and project_vjp
// The projection on the CPU (README.md §1), and with GRADIENT its gradient (§4). Products and sums
// are rounded one by one, as in the kernels of ../cuda/project.py: only fma_ is fused.
#pragma clang fp contract(off)
#include "../../runtime/sixteen.inl"

const int runs = (num + RUN - 1) / RUN, begin = task % runs * RUN;
const int end = begin + RUN < num ? begin + RUN : num;
auto greater_ = [](F a, F b) -> F { return __builtin_elementwise_max(a, b); };
auto less_ = [](F a, F b) -> F { return __builtin_elementwise_min(a, b); };
auto cross_ = [](F a, F b, F c, F d) -> F { return a * d - b * c; };

// reads n rows of `size` numbers as lanes; loops of constant length become loads and shuffles
auto read_ = [](const void* from, int size, int n, F* v) {
    const float* const p = (const float*)from;
    float part[6][16] = {};
    auto fill = [&](int count, int numbers) {
        for (int l = 0; l < count; ++l)
            for (int k = 0; k < numbers; ++k) part[k][l] = p[numbers * l + k];
    };
    if (n == 16 && size == 3) fill(16, 3);
    else if (n == 16 && size == 4) fill(16, 4);
    else fill(n, size);
    for (int k = 0; k < size; ++k) v[k] = *(const F*)part[k];
};
auto write_ = [](void* to, int size, int n, const F* v) {
    float* const p = (float*)to;
    float part[6][16];
    for (int k = 0; k < size; ++k) *(F*)part[k] = v[k];
    auto spill = [&](int count, int numbers) {
        for (int l = 0; l < count; ++l)
            for (int k = 0; k < numbers; ++k) p[numbers * l + k] = part[k][l];
    };
    if (n == 16 && size == 2) spill(16, 2);
    else if (n == 16 && size == 3) spill(16, 3);
    else spill(n, size);
};

// the length of quaternions, in numbers that do not leave float32's range; 1 in the original
auto length_ = [&](const F* q) -> F {
    if (lens.original) return splat(1.0f);
    const F m = greater_(greater_(abs_(q[0]), abs_(q[1])), greater_(abs_(q[2]), abs_(q[3])));
    F sum = F{};
    for (int k = 0; k < 4; ++k) {
        const F part = q[k] / m;
        sum += part * part;
    }
    return m > 0.0f ? m * root_(sum) : F{};
};
// makes quaternions unit ones, and R their rotations
auto rotate_ = [&](F* q, F size, F (*R)[3]) {
    const I some = size > 0.0f;
    for (int k = 0; k < 4; ++k) q[k] = some ? q[k] / size : splat(k == 0);
    const F w = q[0], x = q[1], y = q[2], z = q[3], one = splat(1.0f), two = one + one;
    auto plus = [&](F a, F b, F c, F d) { return a * b + c * d; };
    auto minus = [&](F a, F b, F c, F d) { return a * b - c * d; };
    R[0][0] = one - two * plus(y, y, z, z);
    R[0][1] = two * minus(x, y, w, z);
    R[0][2] = two * plus(x, z, w, y);
    R[1][0] = two * plus(x, y, w, z);
    R[1][1] = one - two * plus(x, x, z, z);
    R[1][2] = two * minus(y, z, w, x);
    R[2][0] = two * minus(x, z, w, y);
    R[2][1] = two * plus(y, z, w, x);
    R[2][2] = one - two * plus(x, x, y, y);
};
// README eq. 15: the triangle whose square is the covariance; kept within what rounding leaves
auto root_of_ = [&](const F* c, F (*L)[3]) {
    auto ratio_ = [](F part, F whole) -> F { return whole > 0.0f ? part / whole : F{}; };
    auto within_ = [&](F x, F most) -> F { return less_(greater_(-most, x), most); };
    auto left_ = [&](F x) -> F { return greater_(x, F{}); };
    const F a = root_(left_(c[0])), along = root_(left_(c[3]));
    const F b = within_(ratio_(c[1], a), along);
    const F d = within_(ratio_(c[2], a), root_(left_(c[5])));
    const F e = root_(left_(c[3] - b * b)), rest = left_(c[5] - d * d);
    const F f = within_(ratio_(c[4] - b * d, e), root_(rest));
    L[0][0] = a, L[0][1] = F{}, L[0][2] = F{};
    L[1][0] = b, L[1][1] = e, L[1][2] = F{};
    L[2][0] = d, L[2][1] = f, L[2][2] = root_(left_(rest - f * f));
};
auto rotated_ = [&](const F* row, const F (*R)[3], F* out) {
    for (int k = 0; k < 3; ++k)
        out[k] = fma_(row[2], R[2][k], fma_(row[1], R[1][k], row[0] * R[0][k]));
};

// A camera: its numbers, and README eq. 2's bounds of the slopes, the picture and a margin around.
struct Camera {
    const float *V, *K;
    float left, right, top, bottom;
};
auto camera_of = [&](size_t image) -> Camera {
    const float* const V = (const float*)(scene.viewmats.data + image);
    const float* const K = (const float*)(scene.Ks.data + image);
    const float half = MARGIN * 0.5f;
    const float across = half * lens.width / K[0], along = half * lens.height / K[4];
    const float x = lens.original ? 0.5f * lens.width : K[2];
    const float y = lens.original ? 0.5f * lens.height : K[5];
    const float left = x / K[0] + across, top = y / K[4] + along;
    return {V, K, -left, (lens.width - x) / K[0] + across, -top, (lens.height - y) / K[4] + along};
};
auto to_camera_ = [&](const Camera& camera, const F* mean, F* t) {
    for (int r = 0; r < 3; ++r) {
        const float* const row = camera.V + 4 * r;
        F sum = mean[0] * row[0];
        sum += mean[1] * row[1];
        sum += mean[2] * row[2];
        t[r] = sum + splat(row[3]);
    }
};
// (x, y)/z, clamped, and the rows of J W: J has the rows (fx, 0, -fx sx) and (0, fy, -fy sy)
auto jacobian_ = [&](const Camera& camera, const F* t, F* slopes, F (*rows)[3]) {
    const float *V = camera.V, *K = camera.K;
    const F fx = K[0] / t[2], fy = K[4] / t[2];
    slopes[0] = t[0] / t[2], slopes[1] = t[1] / t[2];
    const F sx = less_(greater_(splat(camera.left), slopes[0]), splat(camera.right));
    const F sy = less_(greater_(splat(camera.top), slopes[1]), splat(camera.bottom));
    const F jx = -fx * sx, jy = -fy * sy;
    for (int k = 0; k < 3; ++k) {
        rows[0][k] = fma_(jx, splat(V[8 + k]), fx * V[k]);
        rows[1][k] = fma_(jy, splat(V[8 + k]), fy * V[4 + k]);
    }
};

#if GRADIENT
// The gradient of a run of an object's Gaussians, over its views in their order, to the bits of the
// kernel of ../cuda/project.py. Gradients of antialiasing and of viewmats are that kernel's alone.
// gradient of j = -focal slope(x/z)/z to (x, z), p = x/z; a clamped slope is a constant, and in the
// original slope z is one
auto slope_ = [&](F p, F z, float low, float high, float focal, F v, F& vx, F& vz) {
    const F s = less_(greater_(splat(low), p), splat(high));
    const F f = v * focal / (z * z);
    const I free = p == s;
    vx = free ? -f : F{};
    vz = free | (I{} - lens.original) ? 2.0f * f * s : f * s;
};
const int object = task / runs;
for (int i0 = begin; i0 < end; i0 += 16) {
    const int n = end - i0 < 16 ? end - i0 : 16;
    const size_t g = (size_t)object * num + i0;
    F v_mean[3] = {}, v_scale[3] = {}, v_opacity = F{}, v_R[3][3] = {}, v_covar[6] = {};
    F mean[3], scale[3], q[4], R[3][3] = {}, size = F{};
    const bool rotates = scene.quats.data || scene.covars.data;
    I ever = I{};
    for (int view = 0; view < views; ++view) {
        const size_t image = (size_t)object * views + view, i = image * num + i0;
        F v_u[2], v_conic[3], v_z, v_o;
        read_(v_splats.means2d.data + i, 2, n, v_u);
        read_(v_splats.conics.data + i, 3, n, v_conic);
        read_(v_splats.depths.data + i, 1, n, &v_z);
        read_(v_splats.view_opacities.data + i, 1, n, &v_o);
        I seen = I{};
        for (int l = 0; l < n; ++l) seen[l] = splats.status.data[i + l] == VISIBLE ? -1 : 0;
        if (lens.skip_unused)
            seen &= (I)(v_u[0] != 0.0f) | (I)(v_u[1] != 0.0f) | (I)(v_conic[0] != 0.0f)
                | (I)(v_conic[1] != 0.0f) | (I)(v_conic[2] != 0.0f) | (I)(v_z != 0.0f)
                | (I)(v_o != 0.0f);
        if (!any_(seen)) continue;
        if (!any_(ever)) {
            read_(scene.means.data + g, 3, n, mean);
            if (scene.covars.data) {  // its root in the place of the rotation, with scales of 1
                F covar[6];
                read_(scene.covars.data + g, 6, n, covar);
                root_of_(covar, R);
                for (int k = 0; k < 3; ++k) scale[k] = splat(1.0f);
            } else read_(scene.scales.data + g, 3, n, scale);
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
            if (rotates) rotated_(P[r], R, N[r]);
            else
                for (int k = 0; k < 3; ++k) N[r][k] = P[r][k];
        for (int k = 0; k < 3; ++k) {
            m0[k] = N[0][k] * scale[k];
            m1[k] = N[1][k] * scale[k];
        }

        // README eq. 8: the conic's gradient to the covariance's
        read_(splats.conics.data + i, 3, n, conic);
        const F a = conic[0], k = conic[1], e = conic[2], two = splat(2.0f);
        const F c[3] = {cross_(m0[1], m0[2], m1[1], m1[2]), cross_(m0[2], m0[0], m1[2], m1[0]),
            cross_(m0[0], m0[1], m1[0], m1[1])};
        const F d[3] = {cross_(m1[1], m1[2], c[1], c[2]), cross_(m1[2], m1[0], c[2], c[0]),
            cross_(m1[0], m1[1], c[0], c[1])};
        const F v_across = -two * a * a * v_conic[0];
        const F shear = e * v_conic[1];
        const F along = v_across * k - shear;
        const F whole = e * (v_conic[1] * k + two * e * v_conic[2]);
        F v_m[2][3], v_N[2][3], v_P[2][3];
        for (int j = 0; j < 3; ++j) {
            const F across = e * (lens.eps2d * m0[j] + d[j]);
            v_m[0][j] = v_across * across - shear * m1[j];
            v_m[1][j] = along * across - whole * m1[j];
        }
        auto gather_ = [&](F& to, F value) { to = seen ? to + value : to; };
        gather_(v_opacity, v_o);
        if (v_scene.covars.data) {  // README eq. 15
            const F a2 = a * a, v_xx = F{} - a2 * v_conic[0];
            const F v_xy = F{} - (two * a2 * k * v_conic[0] + e * v_conic[1]);
            const F v_yy =
                F{} - (a2 * k * k * v_conic[0] + k * e * v_conic[1] + e * e * v_conic[2]);
            int at = 0;
            for (int r = 0; r < 3; ++r)
                for (int j = r; j < 3; ++j) {
                    const F across = 0.5f * v_xy * (P[0][r] * P[1][j] + P[1][r] * P[0][j]);
                    const F entry = v_xx * P[0][r] * P[0][j] + across + v_yy * P[1][r] * P[1][j];
                    gather_(v_covar[at++], r == j ? entry : two * entry);
                }
        }
        for (int j = 0; j < 3; ++j) gather_(v_scale[j], N[0][j] * v_m[0][j] + N[1][j] * v_m[1][j]);
        for (int r = 0; r < 2; ++r)
            for (int j = 0; j < 3; ++j) v_N[r][j] = v_m[r][j] * scale[j];
        for (int r = 0; r < 3; ++r)
            for (int j = 0; j < 3; ++j)
                gather_(v_R[r][j], fma_(P[1][r], v_N[1][j], P[0][r] * v_N[0][j]));
        for (int r = 0; r < 2; ++r)
            for (int j = 0; j < 3; ++j)
                v_P[r][j] = rotates
                    ? fma_(v_N[r][2], R[j][2], fma_(v_N[r][1], R[j][1], v_N[r][0] * R[j][0]))
                    : v_N[r][j];
        auto v_J = [&](int r, int j) -> F {  // times the transpose of W
            return fma_(v_P[r][2], splat(V[4 * j + 2]),
                fma_(v_P[r][1], splat(V[4 * j + 1]), v_P[r][0] * V[4 * j]));
        };
        const F z = t[2];
        F xx, xz, yy, yz;
        slope_(slopes[0], z, camera.left, camera.right, K[0], v_J(0, 2), xx, xz);
        slope_(slopes[1], z, camera.top, camera.bottom, K[4], v_J(1, 2), yy, yz);
        const F zz = z * z, ux = v_u[0] * K[0], uy = v_u[1] * K[4];
        const F focal = v_J(0, 0) * K[0] + v_J(1, 1) * K[4];
        const F center = ux * t[0] + uy * t[1];
        const F v_t[3] = {xx + ux / z, yy + uy / z, xz + yz + v_z - focal / zz - center / zz};
        for (int j = 0; j < 3; ++j) {
            F sum = V[j] * v_t[0];
            sum += V[4 + j] * v_t[1];
            gather_(v_mean[j], sum + V[8 + j] * v_t[2]);
        }
    }
    if (v_scene.means.data) write_(v_scene.means.data + g, 3, n, v_mean);
    if (v_scene.scales.data) write_(v_scene.scales.data + g, 3, n, v_scale);
    if (v_scene.covars.data) write_(v_scene.covars.data + g, 6, n, v_covar);
    if (v_scene.opacities.data) write_(v_scene.opacities.data + g, 1, n, &v_opacity);
    if (!v_scene.quats.data) continue;
    F v_q[4] = {};
    if (any_(ever)) {
        const F w = q[0], x = q[1], y = q[2], u = q[3], two = splat(2.0f);
        const auto& v = v_R;
        auto plus = [&](int r, int c) { return v[r][c] + v[c][r]; };
        auto less = [&](int r, int c) { return v[r][c] - v[c][r]; };
        auto both = [&](int r, int c) { return v[r][r] + v[c][c]; };
        F s[4];
        s[0] = x * less(2, 1) + y * less(0, 2) + u * less(1, 0);
        s[1] = -two * x * both(1, 2) + y * plus(0, 1) + u * plus(0, 2) + w * less(2, 1);
        s[2] = x * plus(0, 1) - two * y * both(0, 2) + u * plus(1, 2) + w * less(0, 2);
        s[3] = x * plus(0, 2) + y * plus(1, 2) - two * u * both(0, 1) + w * less(1, 0);
        F dot = F{};
        for (int j = 0; j < 4; ++j) {
            s[j] *= two;
            dot += q[j] * s[j];
        }
        // the gradient of a shorter one leaves float32's range
        const I some = ever & (I)(size > 1e-30f);
        const F along_q = lens.original ? F{} : dot;
        for (int j = 0; j < 4; ++j) v_q[j] = some ? (s[j] - q[j] * along_q) / size : F{};
    }
    write_(v_scene.quats.data + g, 4, n, v_q);
}

#else
// Projects a run of an object's Gaussians into an image, sixteen at a time, to the bits of the
// kernel of ../cuda/project.py, whose operations are done here in the same order.
const int image = task / runs, object = image / views, channels = colors.shape[1];
const Camera camera = camera_of(image);
const float* const K = camera.K;
auto finite_ = [&](F a) -> I { return abs_(a) <= 3.402823466e38f; };
auto sum_ = [&](const F* v) -> F { return abs_(v[0]) + abs_(v[1]) + abs_(v[2]); };
auto dot_ = [](const F* a, const F* b) -> F { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
for (int i0 = begin; i0 < end; i0 += 16) {
    const int n = end - i0 < 16 ? end - i0 : 16;
    const size_t i = (size_t)image * num + i0, g = (size_t)object * num + i0;
    F mean[3], scale[3], covar[6], opacity, t[3];
    read_(scene.means.data + g, 3, n, mean);
    if (scene.covars.data) read_(scene.covars.data + g, 6, n, covar);
    else read_(scene.scales.data + g, 3, n, scale);
    read_(scene.opacities.data + g, 1, n, &opacity);
    to_camera_(camera, mean, t);
    I finite = finite_(sum_(mean)) & finite_(opacity) & finite_(sum_(t));
    finite &=
        scene.covars.data ? finite_(sum_(covar)) & finite_(sum_(covar + 3)) : finite_(sum_(scale));
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
    const I shows = (I)(opacity >= lens.alpha_min) | (I{} - lens.original);
    I status = (z <= lens.far_plane) ? (shows ? I{} : I{} + TRANSPARENT) : I{} + FAR;
    status = (z >= lens.near_plane) ? status : I{} + NEAR;
    status = finite ? status : I{} + NOT_FINITE;
    I seen = (I)(status == 0) & (I)(lane < n);
    F center[2] = {}, conic[3] = {splat(1.0f), F{}, splat(1.0f)}, extent[2] = {}, depth = F{};
    F shown = F{};
    if (any_(seen)) {
        F slopes[2], M[2][3];
        jacobian_(camera, t, slopes, M);
        if (scene.quats.data || scene.covars.data) {
            F R[3][3], N[2][3];
            if (scene.covars.data) root_of_(covar, R);
            else rotate_(q, length_(q), R);
            for (int r = 0; r < 2; ++r) rotated_(M[r], R, N[r]);
            for (int k = 0; k < 3; ++k) M[0][k] = N[0][k], M[1][k] = N[1][k];
        }
        F *const m0 = M[0], *const m1 = M[1];
        if (!scene.covars.data)
            for (int k = 0; k < 3; ++k) m0[k] *= scale[k], m1[k] *= scale[k];
        const F across[3] = {cross_(m0[1], m0[2], m1[1], m1[2]), cross_(m0[2], m0[0], m1[2], m1[0]),
            cross_(m0[0], m0[1], m1[0], m1[1])};
        const F det0 = dot_(across, across), d00 = dot_(m0, m0), d11 = dot_(m1, m1);
        const F eps = splat(lens.eps2d);
        F det = det0 + eps * (d00 + d11) + eps * eps;
        F syy = d11 + eps;
        const F sxx = d00 + eps, sxy = dot_(m0, m1);
        const I solid = finite_(det) & (I)(det > 0.0f) & (I)(syy > 0.0f);
        det = solid ? det : splat(1.0f);
        syy = solid ? syy : splat(1.0f);
        const F a = syy / det, e = splat(1.0f) / syy;
        const F x = K[0] * t[0] / z + splat(K[2]);
        const F y = K[4] * t[1] / z + splat(K[5]);
        const I thick = (I)(a > 0.0f) & (I)(a <= CONIC_MAX) & (I)(e <= CONIC_MAX);
        const I sound = solid & thick & finite_(x) & finite_(y);
        shown = opacity;
        I faint = I{};
        if (lens.antialiased) {
            shown = opacity * greater_(splat(COMPENSATION_MIN), root_(det0 / det));
            faint = ~(I)(shown >= lens.alpha_min);
        }
        float cuts[16];
        const F over = shown / lens.alpha_min;
        // of all lanes: to ask each costs more than its logarithm
        for (int l = 0; l < 16; ++l) cuts[l] = wp::log(over[l]);
        const F cut = root_(2.0f * (*(const F*)cuts));
        extent[0] = cut * root_(sxx);
        extent[1] = cut * root_(syy);
        F rx = extent[0], ry = extent[1];
        if (lens.rounded) rx = __builtin_elementwise_ceil(rx), ry = __builtin_elementwise_ceil(ry);
        const I small = (I)(rx <= lens.radius_clip) & (I)(ry <= lens.radius_clip);
        const I inside = (I)(x + rx >= 0.0f) & (I)(x - rx <= lens.width) & (I)(y + ry >= 0.0f)
            & (I)(y - ry <= lens.height);
        I fate = inside ? I{} : I{} + OUTSIDE;
        fate = small ? I{} + SMALL : fate;
        fate = faint ? I{} + TRANSPARENT : fate;
        if (lens.original) {
            // README eq. 16: the radius, and whether its square of tiles is empty
            const F half = 0.5f * (sxx - syy);
            const F spread = root_(greater_(half * half + sxy * sxy, splat(0.1f)));
            const F most = 0.5f * (sxx + syy) + spread;
            const F whole = __builtin_elementwise_ceil(3.0f * root_(most));
            const F radius = less_(whole, splat(RADIUS_MAX));
            const float right = ((int)lens.width + TILE - 1) / TILE * TILE + 0.5f;
            const float bottom = ((int)lens.height + TILE - 1) / TILE * TILE + 0.5f;
            const I touches = (I)(x + radius >= 1.5f) & (I)(x - radius < right)
                & (I)(y + radius >= 1.5f) & (I)(y - radius < bottom);
            fate = (shown >= lens.alpha_min) ? I{} : I{} + TRANSPARENT;
            fate = touches ? fate : I{} + OUTSIDE;
            const I drawn = seen & sound & touches;
            extent[0] = extent[1] = drawn ? radius : F{};
        }
        fate = sound ? fate : I{} + NOT_FINITE;
        status = status == 0 ? fate : status;
        seen = (I)(status == 0) & (I)(lane < n);
        auto keep_ = [&](F v, float other) -> F { return seen ? v : splat(other); };
        center[0] = keep_(x, 0.0f);
        center[1] = keep_(y, 0.0f);
        conic[0] = keep_(a, 1.0f);
        conic[1] = keep_(-sxy / syy, 0.0f);
        conic[2] = keep_(e, 1.0f);
        if (!lens.original) {
            extent[0] = keep_(extent[0], 0.0f);
            extent[1] = keep_(extent[1], 0.0f);
        }
        depth = keep_(z, 0.0f);
        shown = keep_(shown, 0.0f);
    }
    write_(splats.means2d.data + i, 2, n, center);
    write_(splats.conics.data + i, 3, n, conic);
    write_(splats.extents.data + i, 2, n, extent);
    write_(splats.depths.data + i, 1, n, &depth);
    write_(splats.view_opacities.data + i, 1, n, &shown);
    if (n == 16) *(I*)(splats.status.data + i) = status;
    else
        for (int l = 0; l < n; ++l) splats.status.data[i + l] = status[l];
}
#endif
