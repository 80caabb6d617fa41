// Multiplies a tile's decays into ``h``, for the rules whose decays are no exponentials.
#include "shape.h"
#include "../discretize.h"
float* const s = arena.data.ptr + base;
const int channel = p.slot * CHANNELS;
for (int t = 0; t < TOKENS; ++t) WP_PRAGMA_UNROLL
for (int k = 0; k < WALKS * HELD; ++k) {
    float f, g;
    factors_(s[AT_STEP + t * SPAN + channel + k % HELD / STATES], a.c[k], f, g);
    h.c[k] *= f;
}
return h;
