// A thread's states of a row of [*, D, N], walk by walk; those past the last are 0.
#include "shape.h"
#if LOAD
wp::vec_t<WALKS * HELD, float> h;
#endif
float* row = states.data + (size_t)i * (states.strides[0] / 4);
WP_PRAGMA_UNROLL
for (int k = 0; k < WALKS * HELD; ++k) {
    const int c = p.slot * CHANNELS + k % HELD / STATES;
    const int n = k / HELD * WIDTH + p.q * STATES + k % STATES;
    float* at = row + (size_t)(p.d0 + c) * p.states + n;
#if LOAD
    h.c[k] = c < p.count && n < p.states ? *at : 0.0f;
#else
    if (c < p.count && n < p.states) *at = h.c[k];
#endif
}
#if LOAD
return h;
#endif
