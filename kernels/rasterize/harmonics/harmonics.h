// Colours from spherical harmonics on a CPU, and their gradient (README.md §6): sixteen
// Gaussians as lanes. Coefficients are transposed, 16 x 16 floats at a time, so that a lane holds
// one Gaussian's; the gradient is transposed back. Lanes beyond the last Gaussian hold its
// coefficients again, and else zeros.
#include "../rows.h"
#include "basis.h"
namespace gamba::harmonics {
using namespace raster;

typedef wp::array_t<float> Coefficients;           // [rows, K, D]
typedef float A __attribute__((vector_size(64)));  // F as a template argument: not aligned to 4

// Constants that follow from Config's: of a row's K D floats the first FLOATS are used.
template<class Config>
struct Sizes : Config {
    static constexpr int COUNT = (Config::DEGREE + 1) * (Config::DEGREE + 1);
    static constexpr int FLOATS = COUNT * Config::D, PADDED = (FLOATS + 15) / 16 * 16;
    static constexpr int UNROLL = FLOATS <= 96 ? FLOATS : 1;  // of loops over a row that is short
};

// Transposes the rows of ``live`` Gaussians: the i-th float of each becomes into[i].
template<int FLOATS>
INLINE void load_rows(const Coefficients& coefficients, size_t first, int live, F* into) {
    const size_t length = coefficients.shape[1] * coefficients.shape[2];
    const float* const row = coefficients.data + first * length;
    const float* const stop = coefficients.data + (size_t)coefficients.shape[0] * length;
    const bool inside = row + (live - 1) * length + (FLOATS + 15) / 16 * 16 <= stop;
    for (int o = 0; o < FLOATS; o += 16) {
        F r[16];
        for (int j = 0; j < 16; ++j) {
            const float* const from = row + (j < live ? j : live - 1) * length + o;
            if (inside) {
                r[j] = *(const F*)from;
            } else {
                float part[16] = {};
                for (int i = 0; i < 16 && o + i < FLOATS; ++i) part[i] = from[i];
                r[j] = *(const F*)part;
            }
        }
        transpose(r);
        for (int i = 0; i < 16; ++i) into[o + i] = r[i];
    }
}

// The inverse of load_rows, with zeros for unused coefficients.
template<int FLOATS>
INLINE void store_rows(const Coefficients& coefficients, size_t first, int live, const F* from) {
    const size_t length = coefficients.shape[1] * coefficients.shape[2];
    float* const row = coefficients.data + first * length;
    for (int o = 0; o < FLOATS; o += 16) {
        F r[16];
        for (int i = 0; i < 16; ++i) r[i] = from[o + i];
        transpose(r);
        for (int j = 0; j < live; ++j)
            if (o + 16 <= FLOATS) *(F*)(row + j * length + o) = r[j];
            else __builtin_memcpy(row + j * length + o, r + j, FLOATS % 16 * 4);
    }
    for (int j = 0; j < live && length > FLOATS; ++j)
        __builtin_memset(row + j * length + FLOATS, 0, (length - FLOATS) * 4);
}

// From a centre to the means of the lanes: the length, and as t the direction, for which a length
// below ``shortest`` is that.
INLINE F direction(const F* mean, const float* center, float shortest, F* t) {
    for (int i = 0; i < 3; ++i) t[i] = mean[i] - center[i];
    const F square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2];
    const F size = sqrt(square);
    const F divisor = size > shortest ? size : splat(shortest);
    for (int i = 0; i < 3; ++i) t[i] /= divisor;
    return size;
}

// Which of ``live`` Gaussians have coefficients that are not finite.
template<int FLOATS>
static I broken(const Coefficients& coefficients, size_t first, int live) {
    const size_t length = coefficients.shape[1] * coefficients.shape[2];
    I found = {};
    for (int j = 0; j < live; ++j)
        for (int i = 0; i < FLOATS; ++i)
            if (!__builtin_isfinite(coefficients.data[(first + j) * length + i])) found[j] = -1;
    return found;
}

// Fills the colours of a chunk, [images, num, D], or the bare sums unless CLAMPED.
template<class Config, class Size, class Arrays>
static void forward(int task, const Size& size, const Arrays& arrays) {
    typedef Sizes<Config> S;
    constexpr int D = S::D;
    const Run chunk(task, size.num, S::CHUNK);
    const float* const centers = (const float*)arrays.centers.data;
    for (int first = chunk.begin; first < chunk.end; first += 16) {
        const int live = chunk.end - first < 16 ? chunk.end - first : 16;
        const size_t gaussian = (size_t)chunk.object * size.num + first;
        F mean[3], T[S::PADDED];
        load<3>(arrays.means.data + gaussian, live, mean);
        I lost = {};
        for (int i = 0; i < 3; ++i) lost |= ~finite(mean[i]);
        for (int view = 0; view < size.views; ++view) {
            const size_t image = (size_t)chunk.object * size.views + view;
            const size_t at = image * size.num + first, row = size.per_view ? at : gaussian;
            if (size.per_view || view == 0) load_rows<S::FLOATS>(arrays.coefficients, row, live, T);
            F t[3], sum[D];
            A Y[S::COUNT];
            direction(mean, centers + image * 3, S::SHORTEST, t);
            basis<S::DEGREE>(t[0], t[1], t[2], Y);
            for (int d = 0; d < D; ++d) sum[d] = Y[0] * T[d];
#pragma unroll(S::UNROLL)
            for (int k = 1; k < S::COUNT; ++k)
#pragma unroll(S::UNROLL)
                for (int d = 0; d < D; ++d) sum[d] = fma(Y[k], T[k * D + d], sum[d]);
            // a coefficient that is not finite leaves a sum that is not; the reverse need not hold
            I bad = lost;
            for (int d = 0; d < D; ++d) bad |= ~finite(sum[d]);
            if (any(bad)) bad = lost | broken<S::FLOATS>(arrays.coefficients, row, live);
            for (int d = 0; d < D; ++d) {
                if (S::CLAMPED) {
                    sum[d] += 0.5f;
                    sum[d] = sum[d] < 0.0f ? F{} : sum[d];
                }
                sum[d] = bad ? splat(__builtin_nanf("")) : sum[d];
            }
            store<D>(arrays.colors.data + at * D, live, sum);
        }
    }
}

// Makes v, the gradient of results, 0 where these pass none on: colours that are 0, and sums that
// are NaN, which says that something was not finite, or -inf. The result says which Gaussians have
// one.
template<class S>
static inline I masked(const F* shown, F* v) {
    I alive = {};
    for (int d = 0; d < S::D; ++d) {
        const I passes = shown[d] > (S::CLAMPED ? 0.0f : -3.4e38f);
        v[d] = passes ? v[d] : F{};
        alive |= passes;
    }
    return alive;
}

// README eq. 13: the gradient v_t from v, through the sums and the direction t of a length.
template<class S>
INLINE void geometry_gradient(const F* T, const F* v, const F* t, F length, I alive, A* v_t) {
    A s[S::COUNT];
#pragma unroll(S::UNROLL)
    for (int k = 0; k < S::COUNT; ++k) {
        s[k] = T[k * S::D] * v[0];
#pragma unroll(S::UNROLL)
        for (int d = 1; d < S::D; ++d) s[k] = fma(T[k * S::D + d], v[d], s[k]);
    }
    v_t[0] = v_t[1] = v_t[2] = F{};
    slopes<S::DEGREE>(t[0], t[1], t[2], s, v_t[0], v_t[1], v_t[2]);
    // through the division by the length, which is a constant where it is SHORTEST
    F along = t[0] * v_t[0] + t[1] * v_t[1] + t[2] * v_t[2];
    along = length >= S::SHORTEST ? along : F{};
    const F divisor = length > S::SHORTEST ? length : splat(S::SHORTEST);
    for (int i = 0; i < 3; ++i) v_t[i] = alive ? (v_t[i] - t[i] * along) / divisor : F{};
}

// The gradient from v_arrays' colours to its other arrays, of which some may be empty.
template<class Config, class Size, class Arrays>
static void backward(int task, const Size& size, const Arrays& arrays, const Arrays& v_arrays) {
    typedef Sizes<Config> S;
    constexpr int D = S::D;
    const Run chunk(task, size.num, S::CHUNK);
    const float* const centers = (const float*)arrays.centers.data;
    float* const v_centers = (float*)v_arrays.centers.data;
    const bool geometry = S::DEGREE > 0 && (v_arrays.means.data || v_centers);
    for (int first = chunk.begin; first < chunk.end; first += 16) {
        const int live = chunk.end - first < 16 ? chunk.end - first : 16;
        const size_t gaussian = (size_t)chunk.object * size.num + first;
        F mean[3], T[S::PADDED], v_T[S::PADDED], v_mean[3] = {};
        load<3>(arrays.means.data + gaussian, live, mean);
        for (int view = 0; view < size.views; ++view) {
            const size_t image = (size_t)chunk.object * size.views + view;
            const size_t at = image * size.num + first, row = size.per_view ? at : gaussian;
            const bool starts = size.per_view || view == 0;
            const bool ends = size.per_view || view == size.views - 1;
            if (geometry && starts) load_rows<S::FLOATS>(arrays.coefficients, row, live, T);
            F shown[D], v[D], t[3];
            A Y[S::COUNT];
            load<D>(arrays.colors.data + at * D, live, shown);
            load<D>(v_arrays.colors.data + at * D, live, v);
            const I alive = masked<S>(shown, v) & (lane < live);
            const F length = direction(mean, centers + image * 3, S::SHORTEST, t);
            // channels that pass no gradient on may hold NaN, which must not meet a zero
            for (int i = 0; i < 3; ++i) t[i] = alive ? t[i] : F{};
            basis<S::DEGREE>(t[0], t[1], t[2], Y);
            if (v_arrays.coefficients.data) {
#pragma unroll(S::UNROLL)
                for (int k = 0; k < S::COUNT; ++k)
#pragma unroll(S::UNROLL)
                    for (int d = 0; d < D; ++d)
                        v_T[k * D + d] = starts ? Y[k] * v[d] : fma(Y[k], v[d], v_T[k * D + d]);
                if (ends) store_rows<S::FLOATS>(v_arrays.coefficients, row, live, v_T);
            }
            if (!geometry) continue;
            A v_t[3];
            geometry_gradient<S>(T, v, t, length, alive, v_t);
            for (int i = 0; i < 3; ++i) v_mean[i] += v_t[i];
            if (!v_centers) continue;
            float* const out = v_centers + (image * chunk.count + chunk.index) * 3;
            for (int i = 0; i < 3; ++i)
                out[i] = (first == chunk.begin ? 0.0f : out[i]) - total(v_t[i]);
        }
        if (v_arrays.means.data) store<3>(v_arrays.means.data + gaussian, live, v_mean);
    }
}

}  // namespace gamba::harmonics
