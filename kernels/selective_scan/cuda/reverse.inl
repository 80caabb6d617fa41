// needs: backward.py: marks_at, arena, p, CHANNELS, STATES, WALKS, WIDTH, HELD, a, both, tile,
//     TOKENS, AT_B, SUB, PADDED, READ, LANE_STRIDE, STEP, AT_STEP, AT_DU, AT_DY, MARK, NEED_DC,
//     NEED_Y, AT_DC, THROUGH, NEED_DB, AT_DB, AT_S, AT_P; blocks.py: AT_C, SPAN, AT_Y; problem.py:
//     MODE, MAMBA, ZOH
// gives: the body of reverse
// Equations 6 to 12 over the tokens of a tile, SUB at a time, last first: forwards again, holding
// their decays and states in registers, then backwards. ``both`` is dh and the sum of dA, from
// after the tokens to before them. Sums over states leave the threads as partial sums of the lanes,
// SUB tokens as one vector; sums over channels are completed over the block and stored.
#include "io.inl"
#include "../discretize.h"
#include "total.h"
float* const marks = (float*)marks_at;
float* const s = arena.data.ptr;
const int channel = p.slot * CHANNELS;
struct Token {
    float b[STATES], c[STATES];
};
WP_PRAGMA_NO_UNROLL
for (int walk = 0; walk < WALKS; ++walk) {
    const int state = walk * WIDTH + p.q * STATES;
    float an[HELD], dh[HELD], da[HELD];
    WP_PRAGMA_UNROLL
    for (int k = 0; k < HELD; ++k) {
        an[k] = a.c[walk * HELD + k];
        dh[k] = both.c[walk * HELD + k];
        da[k] = both.c[(WALKS + walk) * HELD + k];
    }
    WP_PRAGMA_NO_UNROLL
    for (int sub = TOKENS / SUB - 1; sub >= 0; --sub) {
        auto fetch = [&](int t, Token& v) {
            load_(s + AT_B + (sub * SUB + t) * PADDED + state, v.b);
            if constexpr (READ) load_(s + AT_C + (sub * SUB + t) * PADDED + state, v.c);
        };
        auto product = [&](int at, int t, const auto& values) {
            store_(s + at + (sub * SUB + t) * STRIDE + p.slot * WIDTH + p.q * STATES, values);
        };
        // a lane's sums for each channel, over all state blocks
        auto add = [&](int at, auto& values) {
            WP_PRAGMA_UNROLL
            for (int i = 0; i < CHANNELS; ++i) {
                float* to = s + at + p.q * LANE_STRIDE + (sub * CHANNELS + i) * (STEP * SUB);
                to += p.slot * SUB;
                if (walk > 0) {
                    float before[SUB];
                    load_(to, before);
                    WP_PRAGMA_UNROLL
                    for (int t = 0; t < SUB; ++t) values[i][t] += before[t];
                }
                store_(to, values[i]);
            }
        };
        Token next;
        float r[CHANNELS][SUB], x[CHANNELS][SUB], dy[CHANNELS][SUB];
        WP_PRAGMA_UNROLL
        for (int i = 0; i < CHANNELS; ++i) {
            const int first = (sub * SPAN + channel + i) * SUB;
            load_(s + AT_STEP + first, r[i]);
            load_(s + AT_DU + first, x[i]);
            if constexpr (READ) load_(s + AT_DY + first, dy[i]);
        }
        float hn[HELD], hs[SUB][HELD], fs[SUB][HELD];
        load_(marks + (walk * (MARK / SUB) + tile.mark + sub) * HELD, hn);
        // forwards: exponentials first, as they wait for no state, and loads a token ahead
        if constexpr (MODE == MAMBA) {
            WP_PRAGMA_UNROLL
            for (int t = 0; t < SUB; ++t) {
                float g;
                WP_PRAGMA_UNROLL
                for (int k = 0; k < HELD; ++k) factors_(r[k / STATES][t], an[k], fs[t][k], g);
            }
        }
        fetch(0, next);
        float y[CHANNELS][SUB] = {};
        WP_PRAGMA_UNROLL
        for (int t = 0; t < SUB; ++t) {
            const Token v = next;
            if (t + 1 < SUB) fetch(t + 1, next);
            float dc[STATES] = {};
            WP_PRAGMA_UNROLL
            for (int k = 0; k < HELD; ++k) {
                const int i = k / STATES, j = k % STATES;
                float g = 1.0f;
                if constexpr (MODE != MAMBA) factors_(r[i][t], an[k], fs[t][k], g);
                hs[t][k] = hn[k];
                hn[k] = fs[t][k] * hn[k] + g * (x[i][t] * v.b[j]);
                if constexpr (NEED_DC) dc[j] += dy[i][t] * hn[k];
                if constexpr (NEED_Y) y[i][t] += v.c[j] * hn[k];
            }
            if constexpr (NEED_DC) product(AT_DC, t, dc);
        }
        if constexpr (NEED_Y) add(AT_Y, y);
        if constexpr (THROUGH) {
            float through[CHANNELS][SUB] = {}, dstep[CHANNELS][SUB] = {};
            WP_PRAGMA_UNROLL
            for (int t = SUB - 1; t >= 0; --t) {
                const Token v = next;
                if (t > 0) fetch(t - 1, next);
                float db[STATES] = {}, rt[CHANNELS], xt[CHANNELS], dyt[CHANNELS];
                WP_PRAGMA_UNROLL
                for (int i = 0; i < CHANNELS; ++i) {
                    rt[i] = r[i][t], xt[i] = x[i][t];
                    if constexpr (READ) dyt[i] = dy[i][t];
                    if constexpr (MODE == ZOH) {
                        // its slopes need the registers, so these are loaded again
                        const int element = (sub * SPAN + channel + i) * SUB + t;
                        xt[i] = s[AT_DU + element];
                        if constexpr (READ) dyt[i] = s[AT_DY + element];
                    }
                }
                WP_PRAGMA_UNROLL
                for (int k = 0; k < HELD; ++k) {
                    const int i = k / STATES, j = k % STATES;
                    float d = dh[k], w, q;
                    if constexpr (READ) d = dh[k] + dyt[i] * v.c[j];
                    if constexpr (MODE == MAMBA) {
                        w = d;
                        dh[k] = fs[t][k] * d;
                        q = dh[k] * hs[t][k];
                    } else {
                        float f, g, df, dg;
                        slopes_(rt[i], an[k], f, g, df, dg);
                        dh[k] = f * d;
                        w = g * d, q = d * (hs[t][k] * df + xt[i] * v.b[j] * dg);
                    }
                    if constexpr (NEED_DB) db[j] += w * xt[i];
                    through[i][t] += w * v.b[j];
                    dstep[i][t] += q * an[k];
                    da[k] += q * rt[i];
                }
                if constexpr (NEED_DB) product(AT_DB, t, db);
            }
            add(AT_S, through);
            add(AT_P, dstep);
        }
    }
    WP_PRAGMA_UNROLL
    for (int k = 0; k < HELD; ++k) {
        both.c[walk * HELD + k] = dh[k];
        both.c[(WALKS + walk) * HELD + k] = da[k];
    }
    WP_TILE_SYNC();
    if constexpr (WALKS > 1) {
        if constexpr (NEED_DB || NEED_DC) total_(walk);
        WP_TILE_SYNC();
    }
}
return both;
