"""The walks of several states at once, in C++ text for the leaves of ``recurrence.py``.

What does not depend on the state is read and written once for all of them. It is done where none of
them needs care: no exponential needs a clamp, no decay is slow, and in the gradient all is wanted.
Sums are in the same order as state by state, to the last bit.
"""

# Begins the loop over the states; BLOCK is one of the texts below, ALSO a further condition.
BLOCKS = """
for (int n = 0; n < states; ++n) {
    bool together = tame && n + AT_ONCE <= states ALSO;
    for (int k = 0; together && k < AT_ONCE; ++k)
        together = !slow_(tail.top * rates[n + k]);
    if (together) {
        auto exp2 = exp2_tame_;
        F a[AT_ONCE];
        for (int k = 0; k < AT_ONCE; ++k) a[k] = rates[n + k];
BLOCK
        n += AT_ONCE - 1;
        continue;
    }
    const F a = rates[n];
"""

# Equations 1 and 5.
ADVANCE_BLOCK = """
        const Column b = column_(b_in, n), c = column_(c_in, n);
        F h[AT_ONCE];
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k)
            h[k] = state_(h_out, n + k) + state_(h_out, states + n + k);
        Fetch fetch = fetch_();
        for (int t = 0; t < count; ++t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du;
            F y = token[t].y;
            #pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const F x = rate * a[k];
                FACTORS
                h[k] = fma_(m, h[k], g * (du * bt[k]));
                y = fma_(h[k], splat(ct[k]), y);
            }
            token[t].y = y;
        }
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k)
            state_(h_out, n + k) = h[k], state_(h_out, states + n + k) = F{};
"""

# Equations 1, 6 to 9, 11 and 12, and the sums of 7 and 8.
RETREAT_BLOCK = """
        const Column b = column_(b_in, n), c = column_(c_in, n);
        F* const db = (F*)db_out.data + n * CHUNK;
        F* const dc = (F*)dc_out.data + n * CHUNK;
        if (first) for (int t = 0; t < AT_ONCE * CHUNK; ++t) db[t] = dc[t] = F{};
        F h[AT_ONCE], dh[AT_ONCE], da[AT_ONCE];
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) h[k] = state_(starts_in, n + k);
        Fetch fetch = fetch_();
        for (int t = 0; t < count; ++t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du, dy = token[t].dy;
            F y = token[t].y;
            #pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const F x = rate * a[k];
                FACTORS
                kept[t * AT_ONCE + k].m = m;
                kept[t * AT_ONCE + k].h = h[k];
                h[k] = fma_(m, h[k], g * (du * bt[k]));
                y = fma_(h[k], splat(ct[k]), y);
                dc[k * CHUNK + t] = fma_(dy, h[k], dc[k * CHUNK + t]);
            }
            token[t].y = y;
        }
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            dh[k] = state_(dh_out, n + k) + state_(dh_out, states + n + k);
            da[k] = F{};
        }
        fetch = fetch_();
        for (int t = count - 1; t >= 0; --t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du, dy = token[t].dy;
            F s = token[t].s, p = token[t].p;
            #pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const F v = fma_(dy, splat(ct[k]), dh[k]);
                db[k * CHUNK + t] = fma_(v, du, db[k * CHUNK + t]);
                s = fma_(v, splat(bt[k]), s);
                dh[k] = v * kept[t * AT_ONCE + k].m;
                const F q = dh[k] * kept[t * AT_ONCE + k].h;
                p = fma_(q, a[k], p);
                da[k] = fma_(q, rate, da[k]);
            }
            token[t].s = s, token[t].p = p;
        }
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            state_(dh_out, n + k) = dh[k], state_(dh_out, states + n + k) = F{};
            state_(da_out, n + k) += da[k];
        }
"""
