// What the outputs send back to the state before the first token, and the product of the decays.
#include "task.h"
each_(false, [&](const Place p) __attribute__((always_inline)) {
#include "prepare.h"
#include "states.h"
    F *const dh_of = row_(dh_out, p.state, p.k),
             *const product_of = row_(product_out, p.state, p.k);
    visit_(true, [&](auto kind, auto range, const auto& at) __attribute__((always_inline)) {
        using State = decltype(kind);
        constexpr int K = sizeof(at.a) / sizeof(F);
        const int n = at.n;
        const Column c = column_(c_in, n);
        State dhs[K], products[K];
#pragma unroll
        for (int k = 0; k < K; ++k) {
            dhs[k] = State(dh_of[n + k], dh_of[states + n + k], at.quiet[k]);
            products[k] = State(product_of[n + k], product_of[states + n + k], at.quiet[k]);
        }
        Fetch fetch = fetch_();
        for (int t = 0; t < count; ++t) {
            fetch.next();
            const float* const ct = c.row(t);
#pragma unroll
            for (int k = 0; k < K; ++k) {
                F rise, g;
                const F f = factors_(token[t].rate * at.a[k], range, rise, g);
                products[k].decay(State::one_of(f, rise, at.quiet[k]));
                dhs[k].add(products[k].value(), token[t].dy * ct[k]);
            }
        }
#pragma unroll
        for (int k = 0; k < K; ++k) {
            dhs[k].keep(dh_of[n + k], dh_of[states + n + k]);
            products[k].keep(product_of[n + k], product_of[states + n + k]);
        }
    });
});
