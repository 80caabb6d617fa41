// As load_channel.inl for a block's tile of B or C, [B, L, G, N].
#include "shape.h"
const char* from = (const char*)x_in.data + wide_(p.b, x_in.strides[0]);
from += wide_(p.group, x_in.strides[2]);
wp::vec_t<COUNT, unsigned> r;
WP_PRAGMA_UNROLL
for (int i = 0; i < COUNT; ++i) {
    const int e = BLOCK * i + p.lane, t = e / PADDED, n = e % PADDED;
    r.c[i] = 0;
    if (t < left && n < p.states && e < TOKENS * PADDED)
        r.c[i] = *(const WORD*)(from + wide_(n, x_in.strides[3]) + wide_(t0 + t, x_in.strides[1]));
}
return r;
