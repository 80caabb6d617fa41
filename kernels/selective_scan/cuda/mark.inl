// needs: backward.py: marks_at, arena, base, p, CHANNELS, WALKS, WIDTH, STATES, HELD, a, TOKENS,
//     SUB, tile, walked, MARK, AT_STEP, AT_DU, AT_B, PADDED, h; blocks.py: SPAN
// gives: the body of mark
// Walks the recurrence over a tile and keeps the state before every SUB tokens; of the chunk only
// ``walked`` times SUB tokens are walked. δ and δu are ``[token / 4, channel, 4]``, as in
// groups.py.
#include "io.inl"
#include "../discretize.h"
// Local memory, up to 1 KB per channel: too much for registers, and left to the cache where shared
// memory would limit the number of blocks.
float* const marks = (float*)marks_at;
float* const s = arena.data.ptr + base;
const int channel = p.slot * CHANNELS;
WP_PRAGMA_NO_UNROLL
for (int walk = 0; walk < WALKS; ++walk) {
    const int state = walk * WIDTH + p.q * STATES;
    float hn[HELD], an[HELD];
    WP_PRAGMA_UNROLL
    for (int k = 0; k < HELD; ++k) hn[k] = h.c[walk * HELD + k], an[k] = a.c[walk * HELD + k];
    WP_PRAGMA_UNROLL
    for (int sub = 0; sub < TOKENS / SUB; ++sub) {
        store_(marks + (walk * (MARK / SUB) + tile * (TOKENS / SUB) + sub) * HELD, hn);
        if (tile * (TOKENS / SUB) + sub >= walked) break;
        float r[CHANNELS][SUB], x[CHANNELS][SUB];
        WP_PRAGMA_UNROLL
        for (int i = 0; i < CHANNELS; ++i) {
            const int first = (sub * SPAN + channel + i) * SUB;
            load_(s + AT_STEP + first, r[i]);
            load_(s + AT_DU + first, x[i]);
        }
        WP_PRAGMA_UNROLL
        for (int t = 0; t < SUB; ++t) {
            float w[STATES];
            load_(s + AT_B + (sub * SUB + t) * PADDED + state, w);
            WP_PRAGMA_UNROLL
            for (int i = 0; i < CHANNELS; ++i) WP_PRAGMA_UNROLL
            for (int j = 0; j < STATES; ++j) {
                const int k = i * STATES + j;
                float f, g;
                factors_(r[i][t], an[k], f, g);
                hn[k] = f * hn[k] + g * (x[i][t] * w[j]);
            }
        }
    }
    WP_PRAGMA_UNROLL
    for (int k = 0; k < HELD; ++k) h.c[walk * HELD + k] = hn[k];
}
return h;
