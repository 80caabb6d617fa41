// Colours from spherical harmonics on a CPU, and their gradient (README.md §6): sixteen
// Gaussians as lanes. Coefficients are transposed, 16 x 16 floats at a time, so that a lane holds
// one Gaussian's; the gradient is transposed back. Lanes beyond the last Gaussian hold it again.
#include "../../runtime/sixteen.h"
#include "basis.h"
namespace gamba::harmonics {

typedef wp::array_t<float> Coefficients;           // [rows, K, D]
typedef float A __attribute__((vector_size(64)));  // F as templates know it: not aligned to 4

// What follows from a kernel's constants: of a row's K D floats the first FLOATS are used.
template<class Config>
struct Sizes : Config {
    static constexpr int COUNT = (Config::DEGREE + 1) * (Config::DEGREE + 1);
    static constexpr int FLOATS = COUNT * Config::D, PADDED = (FLOATS + 15) / 16 * 16;
    static constexpr int UNROLL = FLOATS <= 96 ? FLOATS : 1;  // longer code is no quicker
};

// A task's Gaussians [begin, end) of an object, which has ``count`` such chunks.
struct Chunk {
    int object, index, count, begin, end;
};
template<class Config>
static Chunk chunk_of(int task, int num) {
    const int chunks = (num + Config::CHUNK - 1) / Config::CHUNK;
    const int begin = task % chunks * Config::CHUNK;
    const int end = begin + Config::CHUNK < num ? begin + Config::CHUNK : num;
    return {task / chunks, task % chunks, chunks, begin, end};
}

static inline I not_finite(F x) { return ((I)x & 0x7fffffff) >= 0x7f800000; }

// Results that pass a gradient on: colours above 0, and sums that are neither NaN, which says that
// something was not finite, nor -inf.
static inline I passes(F shown, bool clamped) { return shown > (clamped ? 0.0f : -3.4e38f); }

static inline __attribute__((always_inline)) void load_means(
    const float* means, size_t first, int live, F* mean) {
    for (int j = 0; j < 16; ++j)
        for (int i = 0; i < 3; ++i) mean[i][j] = means[(first + (j < live ? j : live - 1)) * 3 + i];
}

// Transposes the rows of ``live`` Gaussians: the i-th float of each becomes into[i].
template<int FLOATS>
static inline __attribute__((always_inline)) void load_rows(
    const Coefficients& coefficients, size_t first, int live, F* into) {
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
static inline __attribute__((always_inline)) void store_rows(
    const Coefficients& coefficients, size_t first, int live, const F* from) {
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
static inline __attribute__((always_inline)) F direction(
    const F* mean, const float* center, float shortest, F* t) {
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
    const Chunk chunk = chunk_of<Config>(task, size.num);
    const float* const centers = (const float*)arrays.centers.data;
    for (int first = chunk.begin; first < chunk.end; first += 16) {
        const int live = chunk.end - first < 16 ? chunk.end - first : 16;
        const size_t gaussian = (size_t)chunk.object * size.num + first;
        F mean[3], T[S::PADDED];
        load_means((const float*)arrays.means.data, gaussian, live, mean);
        I lost = {};
        for (int i = 0; i < 3; ++i) lost |= not_finite(mean[i]);
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
            for (int d = 0; d < D; ++d) bad |= not_finite(sum[d]);
            if (any(bad)) bad = lost | broken<S::FLOATS>(arrays.coefficients, row, live);
            float values[16 * D];
            for (int d = 0; d < D; ++d) {
                F shown = sum[d];
                if (S::CLAMPED) {
                    shown = sum[d] + 0.5f;
                    shown = shown < 0.0f ? F{} : shown;
                }
                shown = bad ? splat(__builtin_nanf("")) : shown;
                for (int j = 0; j < 16; ++j) values[j * D + d] = shown[j];
            }
            __builtin_memcpy(arrays.colors.data + at * D, values, (size_t)live * D * 4);
        }
    }
}

// Fills v with the gradient of ``live`` Gaussians' colours, 0 where none passes; the result says
// which have one.
template<int D>
static inline __attribute__((always_inline)) I load_gradient(
    const float* colors, const float* v_colors, int live, bool clamped, F* v) {
    I alive = {};
    for (int d = 0; d < D; ++d) {
        F value = {}, shown = {};
        for (int j = 0; j < live; ++j) {
            value[j] = v_colors[j * D + d];
            shown[j] = colors[j * D + d];
        }
        const I passed = passes(shown, clamped);
        v[d] = passed ? value : F{};
        alive |= passed;
    }
    return alive;
}

// README eq. 13: the gradient v_t from v, through the sums and the direction t of a length.
template<class S>
static inline __attribute__((always_inline)) void geometry_gradient(
    const F* T, const F* v, const F* t, F length, I alive, A* v_t) {
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
    const Chunk chunk = chunk_of<Config>(task, size.num);
    const float* const centers = (const float*)arrays.centers.data;
    float* const v_means = (float*)v_arrays.means.data;
    float* const v_centers = (float*)v_arrays.centers.data;
    const bool geometry = S::DEGREE > 0 && (v_means || v_centers);
    for (int first = chunk.begin; first < chunk.end; first += 16) {
        const int live = chunk.end - first < 16 ? chunk.end - first : 16;
        const size_t gaussian = (size_t)chunk.object * size.num + first;
        F mean[3], T[S::PADDED], v_T[S::PADDED], v_mean[3] = {};
        load_means((const float*)arrays.means.data, gaussian, live, mean);
        for (int view = 0; view < size.views; ++view) {
            const size_t image = (size_t)chunk.object * size.views + view;
            const size_t at = image * size.num + first, row = size.per_view ? at : gaussian;
            const bool starts = size.per_view || view == 0;
            const bool ends = size.per_view || view == size.views - 1;
            if (geometry && starts) load_rows<S::FLOATS>(arrays.coefficients, row, live, T);
            F v[D], t[3];
            A Y[S::COUNT];
            const I alive = load_gradient<D>(
                arrays.colors.data + at * D, v_arrays.colors.data + at * D, live, S::CLAMPED, v);
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
        if (v_means)
            for (int j = 0; j < live; ++j)
                for (int i = 0; i < 3; ++i) v_means[(gaussian + j) * 3 + i] = v_mean[i][j];
    }
}

}  // namespace gamba::harmonics
