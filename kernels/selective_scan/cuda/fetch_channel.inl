// As load_channel.inl for the gradient, ADJACENT tokens at a time, from an origin. In place of
// tokens after ``last`` that one is loaded: this costs less than conditions, and what comes of them
// is masked.
#include "shape.h"
const char* at = (const char*)origin;
__builtin_assume(__isGlobal(at));
wp::vec_t<COUNT, unsigned> r;
WP_PRAGMA_UNROLL
for (int i = 0; i < COUNT; ++i) {
    const int own = t + (i / ADJACENT * ROWS * ADJACENT + i % ADJACENT);
    r.c[i] = *(const WORD*)(at + wide_(own < last ? own : last, x_in.strides[1]));
}
return r;
