// Adds up the lanes of sums [states, TOKENS, 2], eight rows at a time, into [states, length].
typedef float E __attribute__((vector_size(32), aligned(4)));
auto pair_ = [](E a, E b) -> E {
    return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13)
        + __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
};
auto quad_ = [](E a, E b) -> E {
    return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13)
        + __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
};
auto sum_lanes_ = [&](const E* rows, float* total) {
    for (int n = 0; n < sizes.states; ++n)
        for (int t = 0; t < p.count; t += 8) {
            const E* const r = rows + 2 * (n * TOKENS + t);
            E v[8];
            for (int i = 0; i < 8; ++i) v[i] = r[2 * i] + r[2 * i + 1];
            const E low = quad_(pair_(v[0], v[1]), pair_(v[2], v[3]));
            const E high = quad_(pair_(v[4], v[5]), pair_(v[6], v[7]));
            const E all = __builtin_shufflevector(low, high, 0, 1, 2, 3, 8, 9, 10, 11)
                + __builtin_shufflevector(low, high, 4, 5, 6, 7, 12, 13, 14, 15);
            float* const out = total + n * (size_t)sizes.length + p.t0 + t;
            if (t + 8 <= p.count) *(E*)out = all;
            else
                for (int i = 0; i < p.count - t; ++i) out[i] = all[i];
        }
};
