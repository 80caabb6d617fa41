// As load_matrix.inl for the gradient, from an origin.
#include "shape.h"
const char* at = (const char*)origin;
__builtin_assume(__isGlobal(at));
wp::vec_t<COUNT, unsigned> r;
WP_PRAGMA_UNROLL
for (int i = 0; i < COUNT; ++i) {
    const int e = BLOCK * i + p.lane, n = e % PADDED;
    int t = t0 + e / PADDED;
    t = t < last ? t : last;
    const char* from = at + wide_(n, x_in.strides[3]);
    if (n < p.states && e < TOKENS * PADDED)
        r.c[i] = *(const WORD*)(from + wide_(t, x_in.strides[1]));
}
return r;
