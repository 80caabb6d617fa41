#include "group.h"
WP_PRAGMA_UNROLL
for (int k = 0; k < COUNT / ADJACENT; ++k) {
    WP_PRAGMA_UNROLL
    for (int m = 0; m < ADJACENT; ++m) v[m] = x.c[k * ADJACENT + m];
    store_(group_(k, 4 * SPAN) + p.c * 4, v);
}
