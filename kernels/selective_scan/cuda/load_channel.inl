// The bits of a thread's elements of a tile of [B, L, D], every ROWS-th token of its channel; 0
// from
// ``left`` on. Bits: loads are on their way while the tile before is worked on, and converting
// would wait for them.
#include "shape.h"
const char* at = (char*)((ELEMENT*)x_in.data + p.d) + wide_(p.b, x_in.strides[0]);
at += wide_(t, x_in.strides[1]);
wp::vec_t<COUNT, unsigned> r;
const long long step = wide_(ROWS, x_in.strides[1]);
WP_PRAGMA_UNROLL
for (int i = 0; i < COUNT; ++i, at += step) {
    r.c[i] = 0;
    if (ROWS * i < left) r.c[i] = *(const WORD*)at;
}
return r;
