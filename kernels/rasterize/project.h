// The projection (README.md §1) and its gradient (§4) for both devices. A value F is WIDTH
// Gaussians: sixteen lanes on a CPU (cpu/project.h), one on CUDA (cuda/project.h), with the same
// bits where both run on a CPU. Config, from projection.py: RUN (Gaussians of a task), COVARS
// (covariances are in the place of quaternions and scales), ORIGINAL (README.md §7), statuses and
// limits.
#pragma STDC FP_CONTRACT OFF  // products and sums are rounded one by one: only fma is fused
namespace gamba::raster {

static inline F nonnegative(F a) { return larger(a, F{}); }
static inline F magnitude(const F* v) { return abs(v[0]) + abs(v[1]) + abs(v[2]); }
static inline F dot(const F* a, const F* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
static inline void cross(const F* a, const F* b, F* out) {
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        out[i] = a[j] * b[k] - a[k] * b[j];
    }
}

// The lengths of quaternions, in numbers that do not leave float32's range.
static inline F length_of(const F* q) {
    const F m = larger(larger(abs(q[0]), abs(q[1])), larger(abs(q[2]), abs(q[3])));
    F sum = F{};
    for (int k = 0; k < 4; ++k) {
        const F part = q[k] / m;
        sum += part * part;
    }
    return m > 0.0f ? m * sqrt(sum) : F{};
}

// Divides quaternions by their lengths, and fills R with their rotations.
static inline void rotation(F* q, F length, F (*R)[3]) {
    const Mask some = length > 0.0f;
    for (int k = 0; k < 4; ++k) q[k] = some ? q[k] / length : splat(k == 0);
    const F w = q[0], x = q[1], y = q[2], z = q[3], one = splat(1.0f), two = one + one;
    R[0][0] = one - two * (y * y + z * z);
    R[0][1] = two * (x * y - w * z);
    R[0][2] = two * (x * z + w * y);
    R[1][0] = two * (x * y + w * z);
    R[1][1] = one - two * (x * x + z * z);
    R[1][2] = two * (y * z - w * x);
    R[2][0] = two * (x * z - w * y);
    R[2][1] = two * (y * z + w * x);
    R[2][2] = one - two * (x * x + y * y);
}

// README eq. 15: the triangle L of covariances, kept within what rounding leaves.
static inline void triangle(const F* C, F (*L)[3]) {
    auto ratio = [](F part, F whole) -> F { return whole > 0.0f ? part / whole : F{}; };
    auto within = [](F x, F most) -> F { return smaller(larger(-most, x), most); };
    const F a = sqrt(nonnegative(C[0]));
    const F b = within(ratio(C[1], a), sqrt(nonnegative(C[3])));
    const F d = within(ratio(C[2], a), sqrt(nonnegative(C[5])));
    const F e = sqrt(nonnegative(C[3] - b * b)), rest = nonnegative(C[5] - d * d);
    const F f = within(ratio(C[4] - b * d, e), sqrt(rest));
    L[0][0] = a, L[0][1] = F{}, L[0][2] = F{};
    L[1][0] = b, L[1][1] = e, L[1][2] = F{};
    L[2][0] = d, L[2][1] = f, L[2][2] = sqrt(nonnegative(rest - f * f));
}

// Gaussians in the world. README eq. 3's R and s, or with COVARS the triangle L and 1.
template<class Config>
struct Gaussians {
    F means[3], scales[3], covars[6], quats[4], opacities, length, R[3][3];
    bool by_quats;

    template<class Scene>
    void read(const Scene& scene, size_t first, int n) {
        by_quats = !Config::COVARS && scene.quats.data;
        load<3>(scene.means.data + first, n, means);
        load<1>(scene.opacities.data + first, n, &opacities);
        if (Config::COVARS) {
            load<6>(scene.covars.data + first, n, covars);
            for (int k = 0; k < 3; ++k) scales[k] = splat(1.0f);
        } else load<3>(scene.scales.data + first, n, scales);
        if (by_quats) load<4>(scene.quats.data + first, n, quats);
    }
    Mask all_finite() const {
        Mask found = finite(magnitude(means)) & finite(magnitude(scales)) & finite(opacities);
        if (Config::COVARS) found &= finite(magnitude(covars)) & finite(magnitude(covars + 3));
        if (!by_quats) return found;
        F sum = F{};
        for (int k = 0; k < 4; ++k) sum += abs(quats[k]) * 0.25f;
        return found & finite(sum);
    }
    void rotate() {
        length = Config::ORIGINAL || !by_quats ? splat(1.0f) : length_of(quats);
        if (by_quats) rotation(quats, length, R);
        if (Config::COVARS) triangle(covars, R);
    }
    // Rows of N = P R and of M = N diag(s).
    void shape(const F (*P)[3], F (*N)[3], F (*M)[3]) const {
        for (int r = 0; r < 2; ++r)
            for (int k = 0; k < 3; ++k) {
                N[r][k] = P[r][k];
                if (Config::COVARS || by_quats)
                    N[r][k] = fma(P[r][2], R[2][k], fma(P[r][1], R[1][k], P[r][0] * R[0][k]));
                M[r][k] = N[r][k] * scales[k];
            }
    }
};

// A camera: its viewmat and K, and the bounds of σ, the image and a margin around (README eq. 2).
template<class Config>
struct Camera {
    const float *V, *K;
    float left, right, top, bottom;

    template<class Scene, class Options>
    Camera(const Scene& scene, const Options& options, size_t image)
        : V((const float*)(scene.viewmats.data + image)), K((const float*)(scene.Ks.data + image)) {
        const float half = Config::MARGIN * 0.5f;
        const float across = half * options.width / K[0], along = half * options.height / K[4];
        const float x = Config::ORIGINAL ? 0.5f * options.width : K[2];
        const float y = Config::ORIGINAL ? 0.5f * options.height : K[5];
        left = -(x / K[0] + across), right = (options.width - x) / K[0] + across;
        top = -(y / K[4] + along), bottom = (options.height - y) / K[4] + along;
    }
    // t = W mean + w
    void transform(const F* mean, F* t) const {
        for (int r = 0; r < 3; ++r) {
            F sum = mean[0] * V[4 * r];
            sum += mean[1] * V[4 * r + 1];
            sum += mean[2] * V[4 * r + 2];
            t[r] = sum + splat(V[4 * r + 3]);
        }
    }
    // (x, y)/z, README eq. 2's J as (focal/z, -focal σ/z) by row, and the rows of P = J W
    void jacobian(const F* t, F* slopes, F (*J)[2], F (*P)[3]) const {
        const float low[] = {left, top}, high[] = {right, bottom};
        for (int r = 0; r < 2; ++r) {
            J[r][0] = K[4 * r] / t[2], slopes[r] = t[r] / t[2];
            J[r][1] = -J[r][0] * smaller(larger(splat(low[r]), slopes[r]), splat(high[r]));
            for (int k = 0; k < 3; ++k)
                P[r][k] = fma(J[r][1], splat(V[8 + k]), J[r][0] * V[4 * r + k]);
        }
    }
};

// Gaussians in an image.
struct Projected {
    F means2d[2] = {}, conics[3] = {splat(1.0f), F{}, splat(1.0f)}, extents[2] = {};
    F depths = F{}, opacities = F{};
    I status;  // 0 where visible

    template<class Splats>
    void write(const Splats& splats, size_t first, int n) const {
        store<2>(splats.means2d.data + first, n, means2d);
        store<3>(splats.conics.data + first, n, conics);
        store<2>(splats.extents.data + first, n, extents);
        store<1>(splats.depths.data + first, n, &depths);
        store<1>(splats.view_opacities.data + first, n, &opacities);
        store_status(splats.status.data + first, n, status);
    }
};

// README eq. 16: the radius of the original, and whether its square of tiles has some.
template<class Config, class Options>
static inline Mask square(const Options& options, F x, F y, F sxx, F sxy, F syy, F& radius) {
    const F half = 0.5f * (sxx - syy);
    const F spread = sqrt(larger(half * half + sxy * sxy, splat(0.1f)));
    const F most = 0.5f * (sxx + syy) + spread;
    radius = smaller(ceil(3.0f * sqrt(most)), splat(Config::RADIUS_MAX));
    constexpr int TILE = Config::TILE;
    const float right = ((int)options.width + TILE - 1) / TILE * TILE + 0.5f;
    const float bottom = ((int)options.height + TILE - 1) / TILE * TILE + 0.5f;
    return (Mask)(x + radius >= 1.5f) & (Mask)(x - radius < right) & (Mask)(y + radius >= 1.5f)
        & (Mask)(y - radius < bottom);
}

// Half sides of the boxes around alpha >= alpha_min, and what culls these: the status.
template<class Config, class Options>
static inline I box(const Options& options, F x, F y, F sxx, F syy, F opacities, F* extents) {
    const F cut = sqrt(2.0f * log(opacities / options.alpha_min));
    extents[0] = cut * sqrt(sxx);
    extents[1] = cut * sqrt(syy);
    F rx = extents[0], ry = extents[1];
    if (options.rounded) rx = ceil(rx), ry = ceil(ry);
    const Mask small = (Mask)(rx <= options.radius_clip) & (Mask)(ry <= options.radius_clip);
    const Mask inside = (Mask)(x + rx >= 0.0f) & (Mask)(x - rx <= options.width)
        & (Mask)(y + ry >= 0.0f) & (Mask)(y - ry <= options.height);
    return small ? I{} + Config::SMALL : inside ? I{} : I{} + Config::OUTSIDE;
}

// README eq. 1, 4 and 5: fills ``out`` where its status is 0, or sets this to what culls.
template<class Config, class Options>
static inline void project_covariance(const Options& options, const float* K, const F* t,
    const F (*M)[3], F opacities, Mask there, Projected& out) {
    F n[3];
    cross(M[0], M[1], n);
    const F det0 = dot(n, n), d00 = dot(M[0], M[0]), d11 = dot(M[1], M[1]);
    const F eps = splat(options.eps2d);
    F det = det0 + eps * (d00 + d11) + eps * eps;
    F syy = d11 + eps;
    const F sxx = d00 + eps, sxy = dot(M[0], M[1]);
    const Mask solid = finite(det) & (Mask)(det > 0.0f) & (Mask)(syy > 0.0f);
    det = solid ? det : splat(1.0f);
    syy = solid ? syy : splat(1.0f);
    const F a = syy / det, e = splat(1.0f) / syy;
    const F x = K[0] * t[0] / t[2] + splat(K[2]);
    const F y = K[4] * t[1] / t[2] + splat(K[5]);
    const Mask thick =
        (Mask)(a > 0.0f) & (Mask)(a <= Config::CONIC_MAX) & (Mask)(e <= Config::CONIC_MAX);
    const Mask sound = solid & thick & finite(x) & finite(y);
    F shown = opacities, extents[2];
    if (options.antialiased)
        shown = opacities * larger(splat(Config::COMPENSATION_MIN), sqrt(det0 / det));
    const Mask bright = shown >= options.alpha_min;
    I culled;
    if (Config::ORIGINAL) {
        const Mask touches = square<Config>(options, x, y, sxx, sxy, syy, extents[0]);
        culled = touches ? (bright ? I{} : I{} + Config::TRANSPARENT) : I{} + Config::OUTSIDE;
        const Mask reaches = there & (Mask)(out.status == 0) & sound & touches;
        extents[0] = extents[1] = reaches ? extents[0] : F{};
    } else {
        culled = box<Config>(options, x, y, sxx, syy, shown, extents);
        if (options.antialiased) culled = bright ? culled : I{} + Config::TRANSPARENT;
    }
    culled = sound ? culled : I{} + Config::NOT_FINITE;
    out.status = out.status == 0 ? culled : out.status;
    const Mask seen = there & (Mask)(out.status == 0);
    auto keep = [&](F v, float other) -> F { return seen ? v : splat(other); };
    out.means2d[0] = keep(x, 0.0f);
    out.means2d[1] = keep(y, 0.0f);
    out.conics[0] = keep(a, 1.0f);
    out.conics[1] = keep(-sxy / syy, 0.0f);
    out.conics[2] = keep(e, 1.0f);
    for (int i = 0; i < 2; ++i)
        out.extents[i] = Config::ORIGINAL ? extents[i] : keep(extents[i], 0.0f);
    out.depths = keep(t[2], 0.0f);
    out.opacities = keep(shown, 0.0f);
}

// Projects a run of an object's Gaussians into an image.
template<class Config, class Options, class Scene, class Splats>
static void project(int task, int views, int num, const Options& options, const Scene& scene,
    int colors_per_view, const wp::array_t<float>& colors, const Splats& splats) {
    const Run run(task, num, Config::RUN);
    const int image = run.object, object = image / views, channels = colors.shape[1];
    const Camera<Config> camera(scene, options, image);
    for (int i0 = run.begin; i0 < run.end; i0 += WIDTH) {
        const int n = run.end - i0 < WIDTH ? run.end - i0 : WIDTH;
        const size_t i = (size_t)image * num + i0, g = (size_t)object * num + i0;
        Gaussians<Config> gaussians;
        F t[3];
        gaussians.read(scene, g, n);
        camera.transform(gaussians.means, t);
        const size_t row = colors_per_view ? i : g;
        const Mask sane = gaussians.all_finite() & finite(magnitude(t))
            & finite_colors(colors.data + row * channels, channels, n);
        Projected out;
        // every cull is written so that NaN fails it, and comes before the first division by z
        const Mask shows = gaussians.opacities >= options.alpha_min;
        out.status = I{};
        if (!Config::ORIGINAL) out.status = shows ? I{} : I{} + Config::TRANSPARENT;
        out.status = (t[2] <= options.far_plane) ? out.status : I{} + Config::FAR;
        out.status = (t[2] >= options.near_plane) ? out.status : I{} + Config::NEAR;
        out.status = sane ? out.status : I{} + Config::NOT_FINITE;
        const Mask there = first(n);
        if (any(there & (Mask)(out.status == 0))) {
            F slopes[2], J[2][2], P[2][3], N[2][3], M[2][3];
            camera.jacobian(t, slopes, J, P);
            gaussians.rotate();
            gaussians.shape(P, N, M);
            project_covariance<Config>(options, camera.K, t, M, gaussians.opacities, there, out);
        }
        out.write(splats, i, n);
    }
}

// The gradient that comes from an image, and which Gaussians have some.
struct Upstream {
    F means2d[2], conics[3], depths, opacities;
    Mask seen;

    template<class Splats>
    Upstream(const Splats& v_splats, const int* status, size_t at, int n, bool skip_unused) {
        load<2>(v_splats.means2d.data + at, n, means2d);
        load<3>(v_splats.conics.data + at, n, conics);
        load<1>(v_splats.depths.data + at, n, &depths);
        load<1>(v_splats.view_opacities.data + at, n, &opacities);
        seen = (Mask)(load_status(status + at, n) == 0) & first(n);
        if (!skip_unused) return;
        Mask nonzero = (Mask)(depths != 0.0f) | (Mask)(opacities != 0.0f);
        for (const F& v : means2d) nonzero |= v != 0.0f;
        for (const F& v : conics) nonzero |= v != 0.0f;
        seen &= nonzero;
    }
};

// README eq. 8: the gradient by M's rows.
static inline void conic_gradient(
    const F* conics, const F* v_conics, const F (*M)[3], float eps2d, F (*v_M)[3]) {
    const F a = conics[0], k = conics[1], e = conics[2], two = splat(2.0f);
    F n[3], outer[3];
    cross(M[0], M[1], n);
    cross(M[1], n, outer);
    const F v_r = -two * a * a * v_conics[0];
    const F shear = e * v_conics[1];
    const F along = v_r * k - shear;
    const F whole = e * (v_conics[1] * k + two * e * v_conics[2]);
    for (int j = 0; j < 3; ++j) {
        const F r = e * (eps2d * M[0][j] + outer[j]);
        v_M[0][j] = v_r * r - shear * M[1][j];
        v_M[1][j] = along * r - whole * M[1][j];
    }
}

// README eq. 9 and 17: adds the gradient of the factor of antialiasing, by M's rows to v_M and by
// the covariance to v_S (xx, xy, yy); v becomes that of the opacities before it.
template<class Config>
static inline void factor_gradient(
    const F (*M)[3], F opacities, float eps2d, F& v, F (*v_M)[3], F* v_S) {
    F n[3], m1_n[3], n_m0[3];
    cross(M[0], M[1], n);
    const F det0 = dot(n, n), eps = splat(eps2d);
    F xx = dot(M[0], M[0]), yy = dot(M[1], M[1]);
    const F xy = dot(M[0], M[1]), det = det0 + eps * (xx + yy) + eps * eps;
    const F factor = sqrt(det0 / det), v_factor = v * opacities,
            low = splat(Config::COMPENSATION_MIN);
    v *= larger(low, factor);
    const Mask some = factor > low;
    if (!any(some)) return;
    auto where = [&](F x) -> F { return some ? x : F{}; };
    const F v_det0 = where(0.5f * v_factor / (factor * det));
    const F v_det = where(-0.5f * v_factor * factor / det), v_n = 2.0f * (v_det0 + v_det);
    if (Config::ORIGINAL) {
        // the slope of the factor where eps2d is added once more
        xx += eps, yy += eps;
        const F whole = det + eps * (xx + yy) + eps * eps;
        const F v_whole = v_det0 * det * eps / (whole * whole);
        v_S[0] = v_whole * (eps * yy + yy * yy + xy * xy);
        v_S[1] = -2.0f * v_whole * xy * (eps + xx + yy);
        v_S[2] = v_whole * (eps * xx + xx * xx + xy * xy);
        for (int j = 0; j < 3; ++j) {
            v_M[0][j] += 2.0f * v_S[0] * M[0][j] + v_S[1] * M[1][j];
            v_M[1][j] += 2.0f * v_S[2] * M[1][j] + v_S[1] * M[0][j];
        }
        return;
    }
    v_S[0] = v_det0 * yy + v_det * (yy + eps);
    v_S[1] = -v_n * xy;
    v_S[2] = v_det0 * xx + v_det * (xx + eps);
    for (int j = 0; j < 3; ++j) n[j] *= v_n;
    cross(M[1], n, m1_n);
    cross(n, M[0], n_m0);
    for (int j = 0; j < 3; ++j) {
        v_M[0][j] += m1_n[j] + 2.0f * v_det * eps * M[0][j];
        v_M[1][j] += n_m0[j] + 2.0f * v_det * eps * M[1][j];
    }
}

// Gradients of Gaussians, summed over views.
struct Gradients {
    F means[3] = {}, scales[3] = {}, covars[6] = {}, R[3][3] = {}, opacities = F{};
    Mask ever = Mask{};  // those that have some

    static void gather(F& to, F value, Mask seen) { to = seen ? to + value : to; }

    // README eq. 15: v_C = Pᵀ [[v_xx, v_xy/2], [v_xy/2, v_yy]] P, these from v_S and the conics
    void gather_covars(
        const F* conics, const F* v_conics, const F* v_S, const F (*P)[3], Mask seen) {
        const F a = conics[0], k = conics[1], e = conics[2], two = splat(2.0f), a2 = a * a;
        const F v_xx = v_S[0] - a2 * v_conics[0];
        const F v_xy = v_S[1] - (two * a2 * k * v_conics[0] + e * v_conics[1]);
        const F v_yy =
            v_S[2] - (a2 * k * k * v_conics[0] + k * e * v_conics[1] + e * e * v_conics[2]);
        int at = 0;
        for (int r = 0; r < 3; ++r)
            for (int j = r; j < 3; ++j) {
                const F across = 0.5f * v_xy * (P[0][r] * P[1][j] + P[1][r] * P[0][j]);
                const F entry = v_xx * P[0][r] * P[0][j] + across + v_yy * P[1][r] * P[1][j];
                gather(covars[at++], r == j ? entry : two * entry, seen);
            }
    }
    // from M = N diag(s), N = P R to s, R and v_P
    template<class Config>
    void gather_shape(const Gaussians<Config>& gaussians, const F (*P)[3], const F (*N)[3],
        const F (*v_M)[3], Mask seen, F (*v_P)[3]) {
        F v_N[2][3];
        for (int j = 0; j < 3; ++j) {
            gather(scales[j], N[0][j] * v_M[0][j] + N[1][j] * v_M[1][j], seen);
            for (int r = 0; r < 2; ++r) v_N[r][j] = v_M[r][j] * gaussians.scales[j];
        }
        for (int r = 0; r < 3; ++r)
            for (int j = 0; j < 3; ++j)
                gather(R[r][j], fma(P[1][r], v_N[1][j], P[0][r] * v_N[0][j]), seen);
        const auto& G = gaussians.R;
        for (int r = 0; r < 2; ++r)
            for (int j = 0; j < 3; ++j)
                v_P[r][j] = Config::COVARS || gaussians.by_quats
                    ? fma(v_N[r][2], G[j][2], fma(v_N[r][1], G[j][1], v_N[r][0] * G[j][0]))
                    : v_N[r][j];
    }
    // From R to quaternions, which are divided by their lengths.
    template<class Config>
    void quaternions(const Gaussians<Config>& gaussians, F* v_quats) const {
        const F* const q = gaussians.quats;
        const F w = q[0], x = q[1], y = q[2], z = q[3], two = splat(2.0f);
        auto plus = [&](int r, int c) { return R[r][c] + R[c][r]; };
        auto less = [&](int r, int c) { return R[r][c] - R[c][r]; };
        auto both = [&](int r, int c) { return R[r][r] + R[c][c]; };
        F s[4];
        s[0] = x * less(2, 1) + y * less(0, 2) + z * less(1, 0);
        s[1] = -two * x * both(1, 2) + y * plus(0, 1) + z * plus(0, 2) + w * less(2, 1);
        s[2] = x * plus(0, 1) - two * y * both(0, 2) + z * plus(1, 2) + w * less(0, 2);
        s[3] = x * plus(0, 2) + y * plus(1, 2) - two * z * both(0, 1) + w * less(1, 0);
        F along = F{};
        for (int j = 0; j < 4; ++j) {
            s[j] *= two;
            along += q[j] * s[j];
        }
        // the gradient of a shorter one leaves float32's range
        const Mask some = ever & (Mask)(gaussians.length > 1e-30f);
        for (int j = 0; j < 4; ++j) {
            if (!Config::ORIGINAL) s[j] -= q[j] * along;
            v_quats[j] = some ? s[j] / gaussians.length : F{};
        }
    }
};

// The gradient of j = -focal σ/z by x and z, with σ = clamp(x/z). A clamped σ is a constant, and in
// the original σ z is one.
template<class Config>
static inline void slope_gradient(
    F slope, F z, float low, float high, float focal, F v_j, F& v_x, F& v_z) {
    const F s = smaller(larger(splat(low), slope), splat(high));
    const F f = v_j * focal / (z * z);
    const Mask free = slope == s;
    v_x = free ? -f : F{};
    v_z = 2.0f * f * s;
    if (!Config::ORIGINAL) v_z = free ? v_z : f * s;
}

// The gradient by t, from that of P = J W, of the centre in the image and of the depth.
template<class Config>
static inline void point_gradient(const Camera<Config>& camera, const F* t, const F* slopes,
    const F (*v_P)[3], const Upstream& v, F* v_t) {
    const float *V = camera.V, *K = camera.K;
    auto v_J = [&](int r, int j) -> F {  // times the transpose of W
        return fma(v_P[r][2], splat(V[4 * j + 2]),
            fma(v_P[r][1], splat(V[4 * j + 1]), v_P[r][0] * V[4 * j]));
    };
    const F z = t[2];
    F xx, xz, yy, yz;
    slope_gradient<Config>(slopes[0], z, camera.left, camera.right, K[0], v_J(0, 2), xx, xz);
    slope_gradient<Config>(slopes[1], z, camera.top, camera.bottom, K[4], v_J(1, 2), yy, yz);
    const F zz = z * z, ux = v.means2d[0] * K[0], uy = v.means2d[1] * K[4];
    const F focal = v_J(0, 0) * K[0] + v_J(1, 1) * K[4];
    const F center = ux * t[0] + uy * t[1];
    v_t[0] = xx + ux / z;
    v_t[1] = yy + uy / z;
    v_t[2] = xz + yz + v.depths - focal / zz - center / zz;
}

// The gradient by a viewmat's rows, of each Gaussian, through P = J W and t = W mean + w.
static inline void viewmat_gradient(
    const F (*J)[2], const F (*v_P)[3], const F* v_t, const F* mean, Mask seen, F* v) {
    for (int k = 0; k < 3; ++k) {
        const F v_W[] = {
            J[0][0] * v_P[0][k], J[1][0] * v_P[1][k], fma(J[1][1], v_P[1][k], J[0][1] * v_P[0][k])};
        for (int r = 0; r < 3; ++r) v[4 * r + k] = seen ? v_W[r] + v_t[r] * mean[k] : F{};
        v[4 * k + 3] = seen ? v_t[k] : F{};
    }
}

// The gradient of a run of an object's Gaussians, over its views in their order.
template<class Config, class Options, class Scene, class Splats>
static void project_vjp(int task, int views, int num, const Options& options, const Scene& scene,
    const Splats& splats, const Splats& v_splats, const Scene& v_scene,
    const wp::array_t<float>& v_viewmats) {
    const Run run(task, num, Config::RUN);
    for (int i0 = run.begin; i0 < run.end; i0 += WIDTH) {
        const int n = run.end - i0 < WIDTH ? run.end - i0 : WIDTH;
        const size_t g = (size_t)run.object * num + i0;
        Gradients sums;
        Gaussians<Config> gaussians;
        for (int view = 0; view < views; ++view) {
            const size_t image = (size_t)run.object * views + view, i = image * num + i0;
            Upstream v(v_splats, splats.status.data, i, n, options.skip_unused);
            if (!any(v.seen)) continue;
            if (!any(sums.ever)) {
                gaussians.read(scene, g, n);
                gaussians.rotate();
            }
            sums.ever |= v.seen;
            const Camera<Config> camera(scene, options, image);
            F t[3], slopes[2], J[2][2], P[2][3], N[2][3], M[2][3], conics[3];
            F v_M[2][3], v_S[3] = {}, v_P[2][3], v_t[3];
            camera.transform(gaussians.means, t);
            camera.jacobian(t, slopes, J, P);
            gaussians.shape(P, N, M);
            load<3>(splats.conics.data + i, n, conics);
            conic_gradient(conics, v.conics, M, options.eps2d, v_M);
            if (options.antialiased)
                factor_gradient<Config>(
                    M, gaussians.opacities, options.eps2d, v.opacities, v_M, v_S);
            sums.gather(sums.opacities, v.opacities, v.seen);
            if (Config::COVARS) sums.gather_covars(conics, v.conics, v_S, P, v.seen);
            sums.gather_shape(gaussians, P, N, v_M, v.seen, v_P);
            point_gradient(camera, t, slopes, v_P, v, v_t);
            const float* const V = camera.V;
            for (int j = 0; j < 3; ++j) {
                F sum = V[j] * v_t[0];
                sum += V[4 + j] * v_t[1];
                sums.gather(sums.means[j], sum + V[8 + j] * v_t[2], v.seen);
            }
            if (!v_viewmats.data) continue;
            F v_V[12];
            viewmat_gradient(J, v_P, v_t, gaussians.means, v.seen, v_V);
            store<12>(v_viewmats.data + i * 12, n, v_V);
        }
        if (v_scene.means.data) store<3>(v_scene.means.data + g, n, sums.means);
        if (v_scene.scales.data) store<3>(v_scene.scales.data + g, n, sums.scales);
        if (Config::COVARS && v_scene.covars.data)
            store<6>(v_scene.covars.data + g, n, sums.covars);
        if (v_scene.opacities.data) store<1>(v_scene.opacities.data + g, n, &sums.opacities);
        if (!v_scene.quats.data) continue;
        F v_quats[4] = {};
        if (any(sums.ever)) sums.quaternions(gaussians, v_quats);
        store<4>(v_scene.quats.data + g, n, v_quats);
    }
}

}  // namespace gamba::raster
#pragma STDC FP_CONTRACT DEFAULT
