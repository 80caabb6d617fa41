#include "group.h"
wp::vec_t<COUNT, float> x;
WP_PRAGMA_UNROLL
for (int k = 0; k < COUNT / ADJACENT; ++k) {
    load_(group_(k, 4 * SPAN) + p.c * 4, v);
    WP_PRAGMA_UNROLL
    for (int m = 0; m < ADJACENT; ++m) x.c[k * ADJACENT + m] = v[m];
}
return x;
