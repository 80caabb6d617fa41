// needs: blocks.py: arena, base, p, CHANNELS, DECAY, TOKENS, WALKS, HELD, AT_STEP, SPAN, STATES, a,
//     WIDTH, UNROLL, REVERSE, AT_IN, AT_W, PADDED, READ, AT_C, AT_Y, PAD, h
// gives: the body of advance and of decay
// The recurrence over a tile: equation 1, and with READ the sums of equation 5 as partial sums of
// the lanes. In REVERSE it is equation 6, dh from after a tile to before it.
#include "io.inl"
#include "../discretize.h"
float* const s = arena.data.ptr + base;
const int channel = p.slot * CHANNELS;
#if DECAY
// Multiplies a tile's decays into ``h``, for rules whose decays are not exponentials.
for (int t = 0; t < TOKENS; ++t) WP_PRAGMA_UNROLL
for (int k = 0; k < WALKS * HELD; ++k) {
    float f, g;
    factors_(s[AT_STEP + t * SPAN + channel + k % HELD / STATES], a.c[k], f, g);
    h.c[k] *= f;
}
return h;
#else
WP_PRAGMA_NO_UNROLL
for (int walk = 0; walk < WALKS; ++walk) {  // the state blocks, over the same tile
    const int state = walk * WIDTH + p.q * STATES;
    float hn[HELD], an[HELD];
    WP_PRAGMA_UNROLL
    for (int k = 0; k < HELD; ++k) hn[k] = h.c[walk * HELD + k], an[k] = a.c[walk * HELD + k];
    WP_PRAGMA_NO_UNROLL
    for (int t0 = 0; t0 < TOKENS; t0 += UNROLL) {
        float y[UNROLL][CHANNELS] = {};
        WP_PRAGMA_UNROLL
        for (int u = 0; u < UNROLL; ++u) {
            const int t = REVERSE ? TOKENS - 1 - (t0 + u) : t0 + u;
            float r[CHANNELS], x[CHANNELS], w[STATES], c[STATES];
            load_(s + AT_STEP + t * SPAN + channel, r);
            load_(s + AT_IN + t * SPAN + channel, x);
            load_(s + AT_W + t * PADDED + state, w);
            if constexpr (READ) load_(s + AT_C + t * PADDED + state, c);
            WP_PRAGMA_UNROLL
            for (int i = 0; i < CHANNELS; ++i) WP_PRAGMA_UNROLL
            for (int j = 0; j < STATES; ++j) {
                const int k = i * STATES + j;
                float f, g;
                factors_(r[i], an[k], f, g);
                if constexpr (REVERSE) hn[k] = f * (hn[k] + x[i] * w[j]);
                else hn[k] = f * hn[k] + g * (x[i] * w[j]);
                if constexpr (READ) y[u][i] += c[j] * hn[k];
            }
        }
        if constexpr (READ) {
            WP_PRAGMA_UNROLL
            for (int u = 0; u < UNROLL; ++u) {
                float* to = s + AT_Y + p.q * (TOKENS * SPAN + PAD) + (t0 + u) * SPAN + channel;
                if (walk > 0) {
                    float before[CHANNELS];
                    load_(to, before);
                    WP_PRAGMA_UNROLL
                    for (int i = 0; i < CHANNELS; ++i) y[u][i] += before[i];
                }
                store_(to, y[u]);
            }
        }
    }
    WP_PRAGMA_UNROLL
    for (int k = 0; k < HELD; ++k) h.c[walk * HELD + k] = hn[k];
}
return h;
#endif
