// needs: lanes.h: F, read_, splat, softplus_, sigmoid_, max_abs_, in_range_, fma_, put_;
//     kernels.py: work_out, OUTPUT, sizes, first_in, starts_out, CHUNK, delta_in, u_in, z_in,
//     y_out, SCALE, b_in, c_in, last_out, product_out
// gives: the body of scan_forward
// A strip of a lane group: equation 1 over its tokens, with equation 5 and the gate, or without
// OUTPUT with the product of the decays.
#include "task.h"
F* const work = row_(work_out, piece_(work_out));
auto work_of = [&](const Position& p) { return work + p.j * (OUTPUT ? 2 : 4) * sizes.states; };
auto enter = [&](const Position& p) {
    load_(first_in, p, work_of(p));
    if (!OUTPUT) pairs_(work_of(p) + 2 * sizes.states, 1.0f);
};
auto walk = [&](const Position p) __attribute__((always_inline)) {
#include "strip.h"
    F *const h_of = work_of(p), *const product_of = h_of + 2 * states;
    if (starts_out.shape[0] > 0 && (p.t0 - p.begin) % CHUNK == 0) {
        F* const start = row_(starts_out, p.chunk + (p.t0 - p.begin) / CHUNK, p.k);
        for (int n = 0; n < states; ++n) start[n] = h_of[n];
    }

    // independent of the state n: step, input, D u and gate
    const bool use_z = OUTPUT && sizes.use_z;
    read_soon_(delta_in), read_soon_(u_in);
    if (use_z) read_soon_(z_in);
    if (OUTPUT) write_soon_(y_out);
    auto prepare = [&](int width, bool use_softplus, bool use_z) __attribute__((always_inline)) {
        const auto us = here_(u_in, width);
        const auto deltas = here_(delta_in, width);
        const auto zs = here_(z_in, width);
        for (int t = 0; t < count; ++t) {
            F step = read_(deltas, t) + bias, gate = splat(1.0f);
            if (use_softplus) step = softplus_(step);
            if (use_z) {
                const F z = read_(zs, t);
                gate = z * sigmoid_(z);
            }
            const F u = read_(us, t), rate = step * SCALE;
            max_rate = max_abs_(max_rate, rate);
            token[t] = {rate, step * u, skip * u, gate};
        }
    };
    if (p.width >= 16 && use_softplus && use_z)
        prepare(16, true, true);  // usual: compiled separately
    else prepare(p.width, use_softplus, use_z);
    in_range = in_range_(max_rate * max_a);

    visit_(true, [&](auto kind, auto range, const auto& at) __attribute__((always_inline)) {
        using State = decltype(kind);
        constexpr int K = sizeof(at.a) / sizeof(F);
        const int n = at.n;
        const Column b = column_(b_in, n), c = column_(c_in, n);
        State hs[K], products[K];
#pragma unroll
        for (int k = 0; k < K; ++k) {
            hs[k] = State(h_of[n + k], h_of[states + n + k], at.slow[k]);
            if constexpr (!OUTPUT)
                products[k] = State(product_of[n + k], product_of[states + n + k], at.slow[k]);
        }
        Fetch fetch = fetch_();
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
    });
    if constexpr (OUTPUT) {
        const auto y = here_(y_out, p.width);
        for (int t = 0; t < count; ++t) put_(y, t, token[t].y * token[t].gate, stream);
    }
};
each_(false, enter, walk, [&](const Position& p) {
    store_(last_out, p, work_of(p));
    if (!OUTPUT) store_(product_out, p, work_of(p) + 2 * sizes.states);
});
