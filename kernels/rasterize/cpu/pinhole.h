// What the projection and its gradient share. A sum of products in one expression becomes fused
// operations, as it does in Warp's own functions; other sums are functions, so that they do not.
#include "lanes.h"

const int runs = (num + RUN - 1) / RUN, begin = task % runs * RUN;
const int end = begin + RUN < num ? begin + RUN : num;
auto add_ = [](F a, F b) -> F { return a + b; };
auto minus_ = [](F a, F b) -> F { return a - b; };
auto mul_ = [](F a, F b) -> F { return a * b; };
auto greater_ = [](F a, F b) -> F { return __builtin_elementwise_max(a, b); };
auto less_ = [](F a, F b) -> F { return __builtin_elementwise_min(a, b); };
auto cross_ = [](F a, F b, F c, F d) -> F { return a * d - b * c; };

// reads n rows of `size` numbers as lanes; loops of constant length become loads and shuffles
auto read_ = [](const void* from, int size, int n, F* v) {
    const float* const p = (const float*)from;
    float part[4][16] = {};
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
    float part[4][16];
    for (int k = 0; k < size; ++k) *(F*)part[k] = v[k];
    auto spill = [&](int count, int numbers) {
        for (int l = 0; l < count; ++l)
            for (int k = 0; k < numbers; ++k) p[numbers * l + k] = part[k][l];
    };
    if (n == 16 && size == 2) spill(16, 2);
    else if (n == 16 && size == 3) spill(16, 3);
    else spill(n, size);
};

// the length of quaternions, in numbers that do not leave float32's range
auto length_ = [&](const F* q) -> F {
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
    auto plus = [&](F a, F b, F c, F d) { return add_(mul_(a, b), mul_(c, d)); };
    auto minus = [&](F a, F b, F c, F d) { return add_(mul_(a, b), -mul_(c, d)); };
    R[0][0] = add_(one, -mul_(two, plus(y, y, z, z)));
    R[0][1] = mul_(two, minus(x, y, w, z));
    R[0][2] = mul_(two, plus(x, z, w, y));
    R[1][0] = mul_(two, plus(x, y, w, z));
    R[1][1] = add_(one, -mul_(two, plus(x, x, z, z)));
    R[1][2] = mul_(two, minus(y, z, w, x));
    R[2][0] = mul_(two, minus(x, z, w, y));
    R[2][1] = mul_(two, plus(y, z, w, x));
    R[2][2] = add_(one, -mul_(two, plus(x, x, y, y)));
};
auto turned_ = [&](const F* row, const F (*R)[3], F* out) {
    for (int k = 0; k < 3; ++k)
        out[k] = fma_(row[2], R[2][k], fma_(row[1], R[1][k], mul_(row[0], R[0][k])));
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
    const float left = K[2] / K[0] + across, top = K[5] / K[4] + along;
    return {V, K, -left, (lens.width - K[2]) / K[0] + across, -top,
        (lens.height - K[5]) / K[4] + along};
};
auto to_camera_ = [&](const Camera& camera, const F* mean, F* t) {
    for (int r = 0; r < 3; ++r) {
        const float* const row = camera.V + 4 * r;
        F sum = mul_(mean[0], splat(row[0]));
        sum = add_(sum, mul_(mean[1], splat(row[1])));
        sum = add_(sum, mul_(mean[2], splat(row[2])));
        t[r] = add_(sum, splat(row[3]));
    }
};
// (x, y)/z, clamped, and the rows of J W: those of J are (fx, 0, -fx sx) and (0, fy, -fy sy)
auto jacobian_ = [&](const Camera& camera, const F* t, F* slopes, F (*rows)[3]) {
    const float *V = camera.V, *K = camera.K;
    const F fx = K[0] / t[2], fy = K[4] / t[2];
    slopes[0] = t[0] / t[2], slopes[1] = t[1] / t[2];
    const F sx = less_(greater_(splat(camera.left), slopes[0]), splat(camera.right));
    const F sy = less_(greater_(splat(camera.top), slopes[1]), splat(camera.bottom));
    const F jx = -fx * sx, jy = -fy * sy;
    for (int k = 0; k < 3; ++k) {
        rows[0][k] = fma_(jx, splat(V[8 + k]), mul_(fx, splat(V[k])));
        rows[1][k] = fma_(jy, splat(V[8 + k]), mul_(fy, splat(V[4 + k])));
    }
};
