// The lanes' sums, which lie ``[token / 4, channel of a slot, slot, 4]``.
#include "group.h"
wp::vec_t<COUNT, float> x;
WP_PRAGMA_UNROLL
for (int k = 0; k < COUNT / ADJACENT; ++k) {
    const float* from =
        group_(k, 4 * CHANNELS * STEP) + (p.c % CHANNELS * STEP + p.c / CHANNELS) * 4;
    WP_PRAGMA_UNROLL
    for (int q = 0; q < LANES; ++q) {
        load_(from + q * LANE_STRIDE, v);
        WP_PRAGMA_UNROLL
        for (int m = 0; m < ADJACENT; ++m)
            x.c[k * ADJACENT + m] = q > 0 ? x.c[k * ADJACENT + m] + v[m] : v[m];
    }
}
return x;
