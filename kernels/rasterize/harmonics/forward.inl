// needs: cpu.py: arrays, D, UNROLL
// gives: the body of harmonics
#include "gather.h"
float* const colors = arrays.colors.data;
for (int first = begin; first < end; first += 16) {
    const int live = end - first < 16 ? end - first : 16;
    F mean[3];
    means_(first, live, mean);

    F T[PADDED];
    I lost = {};
    for (int i = 0; i < 3; ++i) lost |= not_finite_(mean[i]);
    for (int view = 0; view < views; ++view) {
        const size_t image = (size_t)b * views + view, at = image * num + first;
        const size_t row = per_view ? at : (size_t)b * num + first;
        if (per_view || view == 0) load_rows_(coefficients.data + row * K_D, live, T);
        F t[3], Y[COUNT], sum[D];
        direction_(centers + image * 3, mean, t);
        basis_(t[0], t[1], t[2], Y);
        for (int d = 0; d < D; ++d) sum[d] = Y[0] * T[d];
        UNROLL
        for (int k = 1; k < COUNT; ++k) {
            UNROLL
            for (int d = 0; d < D; ++d) sum[d] = fma_(Y[k], T[k * D + d], sum[d]);
        }
        // a coefficient that is not finite leaves a sum that is not; the reverse need not hold
        I bad = lost;
        for (int d = 0; d < D; ++d) bad |= not_finite_(sum[d]);
        if (any_(bad))
            for (int j = 0; j < live; ++j) {
                bool finite = !lost[j];
                for (int i = 0; i < FLOATS; ++i)
                    finite &= __builtin_isfinite(coefficients.data[(row + j) * K_D + i]);
                bad[j] = finite ? 0 : -1;
            }
        float values[16 * D];
        for (int d = 0; d < D; ++d) {
            const F shown = bad ? F{} + __builtin_nanf("") : shown_(sum[d]);
            for (int j = 0; j < 16; ++j) values[j * D + d] = shown[j];
        }
        __builtin_memcpy(colors + at * D, values, (size_t)live * D * 4);
    }
}
