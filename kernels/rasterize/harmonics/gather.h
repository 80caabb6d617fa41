// needs: cpu.py: DEGREE, D, arrays, SHORTEST, CLAMPED, CHUNK, task
// gives: COUNT, FLOATS, PADDED, not_finite_, num, views, per_view, b, coefficients, centers, K_D,
//     stop, load_rows_, direction_, basis_, shown_, passes_, chunks, begin, end, means_
// Sixteen Gaussians as the lanes of one SIMD value. Coefficients are transposed, 16 x 16 floats
// at a time, so that a lane holds one Gaussian's; the gradient is transposed back. A row is K_D
// floats, of which FLOATS are used. Lanes beyond the last Gaussian hold the last one again.
#include "../../runtime/sixteen.inl"
const int COUNT = (DEGREE + 1) * (DEGREE + 1), FLOATS = COUNT * D, PADDED = (FLOATS + 15) / 16 * 16;
// not finite, by the exponent's bits
auto not_finite_ = [](F x) -> I { return ((I)x & 0x7fffffff) >= 0x7f800000; };
const int num = size.num, views = size.views;
const bool per_view = size.per_view;
const wp::array_t<float>& coefficients = arrays.coefficients;
const float* const centers = (const float*)arrays.centers.data;
const size_t K_D = coefficients.shape[1] * coefficients.shape[2];
const float* const stop = coefficients.data + (size_t)coefficients.shape[0] * K_D;
// transposes the rows of ``live`` Gaussians: the i-th float of each becomes into[i]
auto load_rows_ = [&](const float* row, int live, F* into) {
    const bool inside = row + (live - 1) * K_D + PADDED <= stop;
    for (int o = 0; o < FLOATS; o += 16) {
        F r[16];
        for (int j = 0; j < 16; ++j) {
            const float* const from = row + (j < live ? j : live - 1) * K_D + o;
            if (inside) {
                r[j] = *(const F*)from;
            } else {
                float part[16] = {};
                for (int i = 0; i < 16 && o + i < FLOATS; ++i) part[i] = from[i];
                r[j] = *(const F*)part;
            }
        }
        transpose_(r);
        for (int i = 0; i < 16; ++i) into[o + i] = r[i];
    }
};
// from the centre to the means of the lanes: its length, at least SHORTEST, and the direction
auto direction_ = [&](const float* center, const F* mean, F* t) -> F {
    for (int i = 0; i < 3; ++i) t[i] = mean[i] - center[i];
    const F square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2];
    const F size = __builtin_elementwise_sqrt(square);
    const F divisor = size > SHORTEST ? size : F{} + SHORTEST;
    for (int i = 0; i < 3; ++i) t[i] /= divisor;
    return size;
};
auto basis_ = [&](F x, F y, F z, F* Y) {
#include "basis.h"
};
// From a sum to the result, and which results pass a gradient on: colours above 0, and sums that
// are neither NaN, which says that something was not finite, nor -inf.
auto shown_ = [](F sum) -> F {
    if constexpr (!CLAMPED) return sum;
    const F c = sum + 0.5f;
    return c < 0.0f ? F{} : c;
};
auto passes_ = [](F shown) -> I { return shown > (CLAMPED ? 0.0f : -3.4e38f); };
const int chunks = (num + CHUNK - 1) / CHUNK;
const int b = task / chunks, begin = task % chunks * CHUNK;
const int end = begin + CHUNK < num ? begin + CHUNK : num;
// the means of the lanes from ``first`` on, of which ``live`` are Gaussians
auto means_ = [&](int first, int live, F* mean) {
    const float* const points = (const float*)arrays.means.data + ((size_t)b * num + first) * 3;
    for (int j = 0; j < 16; ++j)
        for (int i = 0; i < 3; ++i) mean[i][j] = points[(j < live ? j : live - 1) * 3 + i];
};
