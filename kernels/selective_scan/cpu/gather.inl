// needs: sixteen.inl: F; kernels.py: work_out, sizes, rows_in, task, a_in, skip_in, bias_in, TOKENS,
//     u_in, delta_in, z_in, c_in, dout_in, dh_out, product_out
// gives: the body of scan_gradient_states
// The gradient of the outputs by the state before the first token, and the product of the decays.
#include "task.h"
#include "strip.h"
#include "prepare.h"
const int states = sizes.states;
F* const work = piece_(work_out, sizes, task);
// of a lane group: states, then what Group has
const int own = 4 * states, room = own + states + 3;
auto work_of = [&](const Position& p) { return work + p.j * room; };
auto enter = [&](const Position& p) {
    load_group_(a_in, skip_in, bias_in, p, work_of(p) + own);
    pairs_(work_of(p), states, 0.0f), pairs_(work_of(p) + 2 * states, states, 1.0f);
};
auto walk = [&](const Position p) __attribute__((always_inline)) {
    alignas(64) Token token[TOKENS];
    alignas(64) PerToken per_token[TOKENS];
    const Group group(work_of(p) + own, states);
    Fetches fetches;
    const F max_rate =
        prepare_(sizes, p, group, u_in, delta_in, z_in, dout_in, token, per_token, fetches);
    F *const dh_of = work_of(p), *const product_of = dh_of + 2 * states;
    auto gather = [&](auto kind, auto range, const auto& at) __attribute__((always_inline)) {
        using State = decltype(kind);
        constexpr int K = sizeof(at.a) / sizeof(F);
        const int n = at.n;
        const Column c = column_(c_in, p, n);
        State dhs[K], products[K];
#pragma unroll
        for (int k = 0; k < K; ++k) {
            dhs[k] = State(dh_of[n + k], dh_of[states + n + k], at.slow[k]);
            products[k] = State(product_of[n + k], product_of[states + n + k], at.slow[k]);
        }
        Fetch fetch = fetches.next();
        for (int t = 0; t < p.count; ++t) {
            fetch.next();
            const float* const ct = c.row(t);
#pragma unroll
            for (int k = 0; k < K; ++k) {
                F fm1, g;
                const F f = factors_(token[t].rate * at.a[k], range, fm1, g);
                products[k].decay(State::saved_of(f, fm1, at.slow[k]));
                dhs[k].add(products[k].value(), token[t].dy * ct[k]);
            }
        }
#pragma unroll
        for (int k = 0; k < K; ++k) {
            dhs[k].store(dh_of[n + k], dh_of[states + n + k]);
            products[k].store(product_of[n + k], product_of[states + n + k]);
        }
    };
    visit_(group, max_rate, true, gather);
    fetches.rest(p.count);
};
each_(sizes, position_(sizes, rows_in, task, false), false, enter, walk, [&](const Position& p) {
    store_(dh_out, p, work_of(p)), store_(product_out, p, work_of(p) + 2 * states);
});
