// needs: lanes.h: read_, softplus_, sigmoid_, max_abs_, scatter_; sixteen.inl: F, splat, fma_;
//     kernels.py: work_out, OUTPUT, sizes, rows_in, task, a_in, skip_in, bias_in, TOKENS, first_in,
//     starts_out, CHUNK, delta_in, u_in, z_in, y_out, SCALE, b_in, c_in, last_out, product_out
// gives: the body of scan_forward
// A strip of a lane group: equation 1 over its tokens, with equation 5 and the gate, or without
// OUTPUT with the product of the decays.
#include "task.h"
#include "strip.h"
const int states = sizes.states;
F* const work = piece_(work_out, sizes, task);
// of a lane group: states, then what Group has
const int own = (OUTPUT ? 2 : 4) * states, room = own + states + 3;
auto work_of = [&](const Position& p) { return work + p.j * room; };
auto enter = [&](const Position& p) {
    load_group_(a_in, skip_in, bias_in, p, work_of(p) + own);
    load_(first_in, p, states, work_of(p));
    if (!OUTPUT) pairs_(work_of(p) + 2 * states, states, 1.0f);
};
auto walk = [&](const Position p) __attribute__((always_inline)) {
    alignas(64) Token token[TOKENS];
    const Group group(work_of(p) + own, states);
    const int count = p.count;
    F *const h_of = work_of(p), *const product_of = h_of + 2 * states;
    if (starts_out.shape[0] > 0 && (p.t0 - p.begin) % CHUNK == 0) {
        F* const start = row_(starts_out, p.chunk + (p.t0 - p.begin) / CHUNK, p.k);
        for (int n = 0; n < states; ++n) start[n] = h_of[n];
    }

    // independent of the state n: step, input, D u and gate
    const bool use_softplus = sizes.use_softplus, use_z = OUTPUT && sizes.use_z;
    Fetches fetches;
    read_soon_(fetches, delta_in, p), read_soon_(fetches, u_in, p);
    if (use_z) read_soon_(fetches, z_in, p);
    if (OUTPUT) write_soon_(fetches, y_out, p, sizes.stream);
    F max_rate = F{};
    auto prepare = [&](int width, bool use_softplus, bool use_z) __attribute__((always_inline)) {
        const auto us = lanes_(u_in, p, width, token[0].du);
        const auto deltas = lanes_(delta_in, p, width, token[0].rate);
        const auto zs = lanes_(z_in, p, width, token[0].gate, use_z);
        for (int t = 0; t < count; ++t) {
            F step = read_(deltas, t) + group.bias, gate = splat(1.0f);
            if (use_softplus) step = softplus_(step);
            if (use_z) {
                const F z = read_(zs, t);
                gate = z * sigmoid_(z);
            }
            const F u = read_(us, t), rate = step * SCALE;
            max_rate = max_abs_(max_rate, rate);
            token[t] = {rate, step * u, group.skip * u, gate};
        }
    };
    if (p.width >= 16 && use_softplus && use_z)
        prepare(16, true, true);  // usual: compiled separately
    else prepare(p.width, use_softplus, use_z);

    auto recur = [&](auto kind, auto range, const auto& at) __attribute__((always_inline)) {
        using State = decltype(kind);
        constexpr int K = sizeof(at.a) / sizeof(F);
        const int n = at.n;
        const Column b = column_(b_in, p, n), c = column_(c_in, p, n);
        State hs[K], products[K];
#pragma unroll
        for (int k = 0; k < K; ++k) {
            hs[k] = State(h_of[n + k], h_of[states + n + k], at.slow[k]);
            if constexpr (!OUTPUT)
                products[k] = State(product_of[n + k], product_of[states + n + k], at.slow[k]);
        }
        Fetch fetch = fetches.next();
        for (int t = 0; t < count; ++t) {
            fetch.next();
            const float *const bt = b.row(t), *const ct = c.row(t);
            const F rate = token[t].rate, du = token[t].du;
            F y = token[t].y;
#pragma unroll
            for (int k = 0; k < K; ++k) {
                F fm1, g;
                const F f = factors_(rate * at.a[k], range, fm1, g);
                hs[k].step(f, fm1, g * (du * bt[k]));
                if constexpr (OUTPUT) y = fma_(hs[k].value(), splat(ct[k]), y);
                else products[k].decay(State::saved_of(f, fm1, at.slow[k]));
            }
            if constexpr (OUTPUT) token[t].y = y;
        }
#pragma unroll
        for (int k = 0; k < K; ++k) {
            hs[k].store(h_of[n + k], h_of[states + n + k]);
            if constexpr (!OUTPUT) products[k].store(product_of[n + k], product_of[states + n + k]);
        }
    };
    visit_(group, max_rate, true, recur);
    fetches.rest(count);
    if constexpr (OUTPUT) {
        auto value = [&](int t) { return token[t].y * token[t].gate; };
        scatter_(here_(y_out, p, p.width), 0, count, value, sizes.stream);
    }
};
each_(sizes, position_(sizes, rows_in, task, false), false, enter, walk, [&](const Position& p) {
    store_(last_out, p, work_of(p));
    if (!OUTPUT) store_(product_out, p, work_of(p) + 2 * states);
});
