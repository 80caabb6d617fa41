"""The walks of several states at once, in C++ text for the leaves of ``recurrence.py``.

What does not depend on the state is read and written once for all of them. It is done where none of
their exponentials needs a clamp, and where in the gradient all is wanted.
Sums are in the same order as state by state, to the last bit.
"""

# Begins the loop over the states; BLOCK is one of the texts below, ALSO a further condition.
BLOCKS = """
for (int n = 0; n < states; ++n) {
    const bool together = tame && n + AT_ONCE <= states ALSO;
    if (together) {
        F as[AT_ONCE], least = splat(125.0f);
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            as[k] = rates[n + k];
            least = __builtin_elementwise_min(least, __builtin_elementwise_abs(tail.top * as[k]));
        }
        I quiets[AT_ONCE], any = I{};
        const bool look = worth_(least);  // if no state is worth it, this is all that is looked at
        for (int k = 0; look && k < AT_ONCE; ++k) any |= quiets[k] = quiet_(tail.top * as[k]);
BLOCK
        if (look && __builtin_reduce_or(any)) block(Slow(), tamed);
        else block(Plain(), tamed);
        n += AT_ONCE - 1;
        continue;
    }
    const F a = rates[n];
"""

# Equations 1 and 5.
ADVANCE_BLOCK = """
        const Column b = column_(b_in, n), c = column_(c_in, n);
        State hs[AT_ONCE];
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k)
            hs[k] = State(state_(h_out, n + k), state_(h_out, states + n + k), quiets[k]);
        Fetch fetch = fetch_();
        for (int t = 0; t < count; ++t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du;
            F y = token[t].y;
            #pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const F x = rate * as[k];
                FACTORS
                hs[k].step(f, rise, g * (du * bt[k]));
                y = fma_(hs[k].value(), splat(ct[k]), y);
            }
            token[t].y = y;
        }
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k)
            hs[k].keep(state_(h_out, n + k), state_(h_out, states + n + k));
"""

# Equations 1, 6 to 9, 11 and 12, and the sums of 7 and 8.
RETREAT_BLOCK = """
        const Column b = column_(b_in, n), c = column_(c_in, n);
        F* const db = (F*)db_out.data + n * CHUNK;
        F* const dc = (F*)dc_out.data + n * CHUNK;
        if (first) for (int t = 0; t < AT_ONCE * CHUNK; ++t) db[t] = dc[t] = F{};
        State hs[AT_ONCE], dhs[AT_ONCE];
        F das[AT_ONCE];
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) hs[k] = State(state_(starts_in, n + k), F{}, quiets[k]);
        Fetch fetch = fetch_();
        for (int t = 0; t < count; ++t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du, dy = token[t].dy;
            F y = token[t].y;
            #pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                State& h = hs[k];
                Kept& own = kept[t * AT_ONCE + k];
                const F x = rate * as[k];
                FACTORS
                own.m = State::one_of(f, rise, quiets[k]), own.h = h.value();
                KEEP
                h.step(f, rise, g * (du * bt[k]));
                y = fma_(h.value(), splat(ct[k]), y);
                dc[k * CHUNK + t] = fma_(dy, h.value(), dc[k * CHUNK + t]);
            }
            token[t].y = y;
        }
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            dhs[k] = State(state_(dh_out, n + k), state_(dh_out, states + n + k), quiets[k]);
            das[k] = F{};
        }
        fetch = fetch_();
        for (int t = count - 1; t >= 0; --t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du, dy = token[t].dy;
            F s = token[t].s, p = token[t].p;
            #pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                State& dh = dhs[k];
                const Kept& own = kept[t * AT_ONCE + k];
                const F a = as[k];
                const I quiet = quiets[k];
                const float b_t = bt[k];
                dh.add(dy, splat(ct[k]));
                const F v = dh.value();
                WEIGH
                db[k * CHUNK + t] = fma_(gv, du, db[k * CHUNK + t]);
                s = fma_(gv, splat(b_t), s);
                GRADIENT
                p = fma_(q, a, p);
                das[k] = fma_(q, rate, das[k]);
            }
            token[t].s = s, token[t].p = p;
        }
        #pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            dhs[k].keep(state_(dh_out, n + k), state_(dh_out, states + n + k));
            state_(da_out, n + k) += das[k];
        }
"""
