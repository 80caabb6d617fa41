// needs: backward.py: SLOTS, WIDTH, TOKENS, TAKEN, NEED_DB, NEED_DC, arena, AT_DB, AT_DC, db_out,
//     dc_out, tile, p, BLOCK; scalars.py: wide_
// gives: STRIDE, total_
// Sums the products for dB and dC over the block's channels, in a fixed order: a thread takes
// TAKEN sums at a time. Where only one of them is wanted, the other's is not there.
constexpr int STRIDE = (SLOTS + 1) * WIDTH;  // between the products of two tokens, half the banks
auto total_ = [&](int walk) {
    constexpr int OWN = TOKENS * WIDTH / TAKEN, SUMS = (NEED_DB + NEED_DC) * OWN;
    auto take = [&](unsigned e) {
        const int t = e / (WIDTH / TAKEN) % TOKENS, n = e % (WIDTH / TAKEN) * TAKEN;
        const bool is_b = NEED_DB && NEED_DC ? e < OWN : NEED_DB;
        const float* from = arena.data.ptr + (is_b ? AT_DB : AT_DC) + t * STRIDE + n;
        struct alignas(4 * TAKEN) Sums {
            float v[TAKEN];
        };
        constexpr int PARTS = SLOTS < 4 ? SLOTS : 4;
        Sums v[PARTS];
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SLOTS; ++i) {
            const Sums one = *(const Sums*)(from + i * WIDTH);
            WP_PRAGMA_UNROLL
            for (int m = 0; m < TAKEN; ++m)
                v[i % 4].v[m] = i < 4 ? one.v[m] : v[i % 4].v[m] + one.v[m];
        }
        float* to = is_b ? db_out.data : dc_out.data;
        to += tile.product + wide_(tile.t0 + t, p.states) + walk * WIDTH + n;
        WP_PRAGMA_UNROLL
        for (int m = 0; m < TAKEN; ++m)
            if (t < tile.left && walk * WIDTH + n + m < p.states) {
                if constexpr (PARTS == 4) to[m] = (v[0].v[m] + v[1].v[m]) + (v[2].v[m] + v[3].v[m]);
                else if constexpr (PARTS == 2) to[m] = v[0].v[m] + v[1].v[m];
                else to[m] = v[0].v[m];
            }
    };
    if constexpr (SUMS > BLOCK)
        for (unsigned e = p.lane; e < SUMS; e += BLOCK) take(e);
    else if (p.lane < SUMS) take(p.lane);
};
