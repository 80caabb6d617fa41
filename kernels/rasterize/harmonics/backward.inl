// needs: cpu.py: arrays, v_arrays, D, UNROLL, SHORTEST, task
// gives: the body of harmonics_vjp
#include "gather.h"
const float *const colors = arrays.colors.data, *const v_colors = v_arrays.colors.data;
float *const v_coefficients = v_arrays.coefficients.data,
             *const v_means = (float*)v_arrays.means.data;
float* const v_centers = (float*)v_arrays.centers.data;
auto slopes_ = [&](F x, F y, F z, const F* s, F& v_x, F& v_y, F& v_z) {
#include "slopes.h"
};
// pairwise, in a fixed order
auto total_ = [](F x) -> float {
    float s[16];
    *(F*)s = x;
    for (int w = 8; w > 0; w >>= 1)
        for (int l = 0; l < w; ++l) s[l] += s[l + w];
    return s[0];
};
// the inverse of load_rows_, with zeros for unused coefficients
auto store_rows_ = [&](float* row, int live, const F* from) {
    for (int o = 0; o < FLOATS; o += 16) {
        F r[16];
        for (int i = 0; i < 16; ++i) r[i] = from[o + i];
        transpose_(r);
        for (int j = 0; j < live; ++j)
            if (o + 16 <= FLOATS) *(F*)(row + j * K_D + o) = r[j];
            else __builtin_memcpy(row + j * K_D + o, r + j, FLOATS % 16 * 4);
    }
    for (int j = 0; j < live && K_D > FLOATS; ++j)
        __builtin_memset(row + j * K_D + FLOATS, 0, (K_D - FLOATS) * 4);
};
for (int first = begin; first < end; first += 16) {
    const int live = end - first < 16 ? end - first : 16;
    F mean[3];
    means_(first, live, mean);

    F T[PADDED], v_T[PADDED], v_mean[3] = {};
    const bool slopes = COUNT > 1 && (v_means || v_centers);
    for (int view = 0; view < views; ++view) {
        const size_t image = (size_t)b * views + view, at = image * num + first;
        const size_t row = per_view ? at : (size_t)b * num + first;
        if (slopes && (per_view || view == 0)) load_rows_(coefficients.data + row * K_D, live, T);
        F v[D];
        I alive = {};
        const float* const values = v_colors + at * D;
        for (int d = 0; d < D; ++d) {
            F value = {}, shown = {};
            for (int j = 0; j < live; ++j) {
                value[j] = values[j * D + d];
                shown[j] = colors[(at + j) * D + d];
            }
            const I passes = passes_(shown);
            v[d] = passes ? value : F{};
            alive |= passes;
        }
        F t[3], Y[COUNT];
        const F size = direction_(centers + image * 3, mean, t);
        // channels that pass no gradient on may hold NaN, which must not meet a zero
        for (int i = 0; i < 3; ++i) t[i] = alive ? t[i] : F{};
        basis_(t[0], t[1], t[2], Y);
        if (v_coefficients) {
            if (per_view || view == 0) {
                UNROLL
                for (int k = 0; k < COUNT; ++k) {
                    UNROLL
                    for (int d = 0; d < D; ++d) v_T[k * D + d] = Y[k] * v[d];
                }
            } else {
                UNROLL
                for (int k = 0; k < COUNT; ++k) {
                    UNROLL
                    for (int d = 0; d < D; ++d) v_T[k * D + d] = fma_(Y[k], v[d], v_T[k * D + d]);
                }
            }
            if (per_view || view == views - 1) store_rows_(v_coefficients + row * K_D, live, v_T);
        }
        if (!slopes) continue;
        F s[COUNT];
        UNROLL
        for (int k = 0; k < COUNT; ++k) {
            s[k] = T[k * D] * v[0];
            UNROLL
            for (int d = 1; d < D; ++d) s[k] = fma_(T[k * D + d], v[d], s[k]);
        }
        F v_t[3] = {};
        slopes_(t[0], t[1], t[2], s, v_t[0], v_t[1], v_t[2]);
        // through the division by the length, which is a constant where it is SHORTEST
        F along = t[0] * v_t[0] + t[1] * v_t[1] + t[2] * v_t[2];
        along = size >= SHORTEST ? along : F{};
        const F divisor = size > SHORTEST ? size : F{} + SHORTEST;
        for (int i = 0; i < 3; ++i) {
            v_t[i] = alive ? (v_t[i] - t[i] * along) / divisor : F{};
            v_mean[i] += v_t[i];
        }
        if (v_centers) {
            float* const out = v_centers + (image * chunks + task % chunks) * 3;
            for (int i = 0; i < 3; ++i) out[i] = (first == begin ? 0.0f : out[i]) - total_(v_t[i]);
        }
    }
    if (v_means)
        for (int j = 0; j < live; ++j)
            for (int i = 0; i < 3; ++i)
                v_means[((size_t)b * num + first + j) * 3 + i] = v_mean[i][j];
}
