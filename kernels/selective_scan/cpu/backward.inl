// needs: lanes.h: put_, scatter_; sixteen.inl: F, fma_, splat; kernels.py: work_out, sums_out, sizes,
//     rows_in, task, a_in, skip_in, bias_in, u_in, delta_in, z_in, dout_in, dlast_in, TOKENS,
//     AT_ONCE, TRANSPOSED, starts_in, du_out, ddelta_out, dz_out, BLOCKS, b_in, c_in, NEED_DB,
//     NEED_DC, NEED_DZ, NEED_DH, SCALE, dchannel_out, db_out, dc_out, dfirst_out, da_out;
//     problem.py: WEIGHTED
// gives: the body of scan_backward
// Equation 1 again, keeping decay and state of every token, and the sums of equation 8; then
// backwards equations 6, 7 and 9 to 12. Σ rate q is left in da. Sums restart in the first of the
// BLOCKS lane groups that share them. Gradients that are not in ``needs`` are not computed.
#include "task.h"
#include "strip.h"
#include "prepare.h"
const int states = sizes.states, stream = sizes.stream;
F *const work = piece_(work_out, sizes, task), *const sums = piece_(sums_out, sizes, task);
// of a lane group: states, then what Group has
const int own = 3 * states, room = own + states + 3;
auto work_of = [&](const Position& p) { return work + p.j * room; };
auto enter = [&](const Position& p) {
    load_group_(a_in, skip_in, bias_in, p, work_of(p) + own);
    load_(dlast_in, p, states, work_of(p)), fill_(work_of(p) + 2 * states, states, 0.0f);
};
auto walk = [&](const Position p) __attribute__((always_inline)) {
    alignas(64) PerToken per_token[TOKENS];
    alignas(64) Saved saved[TOKENS * AT_ONCE];
    alignas(64) Token token[TOKENS];
    const Group group(work_of(p) + own, states);
    const int count = p.count;
    Fetches fetches;
    const F max_rate =
        prepare_(sizes, p, group, u_in, delta_in, z_in, dout_in, token, per_token, fetches);
    F *const dh_of = work_of(p), *const da_of = dh_of + 2 * states;
    const int chunk = p.chunk + (p.t0 - p.begin) / TOKENS;
    const F* const start = row_(starts_in, chunk, p.k);
    write_soon_(fetches, du_out, p, stream), write_soon_(fetches, ddelta_out, p, stream);
    write_soon_(fetches, dz_out, p, stream);
    const bool first = p.j % BLOCKS == 0;
    auto reverse = [&](auto kind, auto range, const auto& at,
                       int needs) __attribute__((always_inline)) {
        using State = decltype(kind);
        constexpr int K = sizeof(at.a) / sizeof(F);
        const int n = at.n;
        const Column b = column_(b_in, p, n), c = column_(c_in, p, n);
        F *const db = sums + n * TOKENS, *const dc = sums + (states + n) * TOKENS;
        if (first)
            for (int t = 0; t < K * TOKENS; ++t) {
                if (needs & NEED_DB) db[t] = F{};
                if (needs & NEED_DC) dc[t] = F{};
            }
        State hs[K], dhs[K];
        F das[K];
#pragma unroll
        for (int k = 0; k < K; ++k) hs[k] = State(start[n + k], F{}, at.slow[k]);
        Fetch fetch = fetches.next();
        for (int t = 0; t < count; ++t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du, dy = token[t].dy;
            F y = token[t].y;
#pragma unroll
            for (int k = 0; k < K; ++k) {
                State& h = hs[k];
                Saved& own = saved[t * K + k];
                F fm1, g;
                const F f = factors_(rate * at.a[k], range, fm1, g);
                own.m = State::saved_of(f, fm1, at.slow[k]), own.h = h.value();
#if WEIGHTED
                own.g = g;
#endif
                h.step(f, fm1, g * (du * bt[k]));
                if (needs & NEED_DZ) y = fma_(h.value(), splat(ct[k]), y);
                if (needs & NEED_DC) dc[k * TOKENS + t] = fma_(dy, h.value(), dc[k * TOKENS + t]);
            }
            token[t].y = y;
        }
        if (!(needs & NEED_DH)) return;
#pragma unroll
        for (int k = 0; k < K; ++k) {
            dhs[k] = State(dh_of[n + k], dh_of[states + n + k], at.slow[k]);
            das[k] = F{};
        }
        fetch = fetches.next();
        for (int t = count - 1; t >= 0; --t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du, dy = token[t].dy;
            F s = token[t].s, p = token[t].p;
#pragma unroll
            for (int k = 0; k < K; ++k) {
                State& dh = dhs[k];
                const Saved& own = saved[t * K + k];
                const float b_t = bt[k];
                dh.add(dy, splat(ct[k]));
                const F v = dh.value();
#if WEIGHTED
                const F g = own.g, gv = g * v;
#else
                const F gv = v;
#endif
                if (needs & NEED_DB) db[k * TOKENS + t] = fma_(gv, du, db[k * TOKENS + t]);
                s = fma_(gv, splat(b_t), s);
#if WEIGHTED
                F df, dg;
                slopes_(rate * at.a[k], State::decay_of(own.m, at.slow[k]), g, df, dg);
                const F q = v * (own.h * df + du * b_t * dg);
                dh.decay(own.m);
#else
                dh.decay(own.m);
                const F q = dh.value() * own.h;
#endif
                p = fma_(q, at.a[k], p);
                das[k] = fma_(q, rate, das[k]);
            }
            token[t].s = s, token[t].p = p;
        }
#pragma unroll
        for (int k = 0; k < K; ++k) {
            dhs[k].store(dh_of[n + k], dh_of[states + n + k]);
            da_of[n + k] += das[k];
        }
    };
    const int needs = sizes.needs, all = NEED_DZ | NEED_DC | NEED_DB | NEED_DH;
    auto walk = [&](auto kind, auto range, const auto& at) __attribute__((always_inline)) {
        if constexpr (sizeof(at.a) / sizeof(F) == 1) reverse(kind, range, at, needs);
        else reverse(kind, range, at, all);
    };
    visit_(group, max_rate, needs == all, walk);
    fetches.rest(count);

    // Equations 9 and 11, dz, and the chunk's sums for dD and ddelta_bias. They are added by runs
    // of eight tokens, because equal terms would round to the same side at every token.
    auto du = [&](int t) {
        return fma_(token[t].rate * (1.0f / SCALE), token[t].s, group.skip * token[t].dy);
    };
    auto ddelta = [&](int t) { return token[t].p; };
    auto dz = [&](int t) { return token[t].y * per_token[t].gate; };
    const auto dus = here_(du_out, p, p.width), dzs = here_(dz_out, p, p.width);
    const auto ddeltas = here_(ddelta_out, p, p.width);
    const bool need_u = du_out.shape[1] > 0, need_delta = ddelta_out.shape[1] > 0;
    const bool need_z = dz_out.shape[1] > 0;
    auto write = [&](auto put) __attribute__((always_inline)) {
        if (need_u) put(dus, du);
        if (need_delta) put(ddeltas, ddelta);
        if (need_z) put(dzs, dz);
    };
    F dskip = F{}, dbias = F{}, skips = F{}, biases = F{};
    for (int t = 0; t < count; ++t) {
        Token& now = token[t];
        const F u = per_token[t].u;
        skips = fma_(now.dy, u, skips);
        now.p = fma_(u, now.s, now.p) * per_token[t].slope;
        biases += now.p;
        if ((t & 7) == 7 || t == count - 1) {
            dskip += skips, dbias += biases;
            skips = biases = F{};
        }
        if constexpr (!TRANSPOSED)
            write([&](const auto& rows, auto value)
                      __attribute__((always_inline)) { put_(rows, t, value(t), stream); });
    }
    if constexpr (TRANSPOSED)
        write([&](const auto& rows, auto value)
                  __attribute__((always_inline)) { scatter_(rows, 0, count, value, stream); });
    *row_(dchannel_out, chunk, 0, p.k) = dskip;
    *row_(dchannel_out, chunk, 1, p.k) = dbias;
    // Adds the lanes of sums [states, TOKENS, 2], eight rows at a time, into [states, length].
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
        for (int n = 0; n < states; ++n)
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
    if (p.j % BLOCKS == BLOCKS - 1 || p.j == p.blocks - 1) {
        const size_t part = p.part + p.j / BLOCKS, size = (size_t)states * sizes.length;
        if (sizes.needs & NEED_DB) sum_lanes_((const E*)sums, db_out.data + part * size);
        if (sizes.needs & NEED_DC)
            sum_lanes_((const E*)(sums + states * TOKENS), dc_out.data + part * size);
    }
};
each_(sizes, position_(sizes, rows_in, task, true), true, enter, walk, [&](const Position& p) {
    store_(dfirst_out, p, work_of(p)), store_(da_out, p, work_of(p) + 2 * states);
});
