// The scan forward on a CPU: equation 1 over the tokens of a segment, strip by strip, with equation
// 5 and the gate, or without OUTPUT with the product of the decays.
#include "state.h"
#include "strip.h"
namespace gamba::scan {

// The values of a token are adjacent, because arrays of 4 KiB would evict one another from the
// cache. A rate is δ times SCALE.
struct Token {
    F rate, du, y, gate;
};

// The part of a strip that does not depend on the state n: step, input, D u and gate. Returns the
// largest |rate| of each lane.
template<class Config, class In>
INLINE F prepare(const In& in, const Position& p, const Group& group, int width, bool use_softplus,
    bool use_z, Token* token) {
    const auto us = lanes_of<Config>(in.u, p, width, token[0].du, sizeof(Token));
    const auto deltas = lanes_of<Config>(in.delta, p, width, token[0].rate, sizeof(Token));
    const auto zs = lanes_of<Config>(in.z, p, width, token[0].gate, sizeof(Token), use_z);
    F max_rate = F{};
    for (int t = 0; t < p.count; ++t) {
        F delta = read(deltas, t) + group.delta_bias, gate = splat(1.0f);
        if (use_softplus) delta = softplus(delta);
        if (use_z) {
            const F z = read(zs, t);
            gate = z * sigmoid(z);
        }
        const F u = read(us, t), rate = delta * Config::SCALE;
        max_rate = max_abs(max_rate, rate);
        token[t] = {rate, delta * u, group.D * u, gate};
    }
    return max_rate;
}

// Equations 1 and 5 for some states: h, or with it the product of the decays, from before the strip
// to after it. ``h_of`` and ``product_of`` are pairs.
template<class Config, class Kind, class States, class In>
INLINE void recur(Kind, const States& at, const In& in, const Position& p, F* h_of, F* product_of,
    Token* token, Fetch fetch) {
    using State = typename Kind::State;
    constexpr int K = States::K;
    const int n = at.n, states = in.sizes.states;
    const Column B = column_of(in.B, p, n), C = column_of(in.C, p, n);
    State hs[K], products[K];
#pragma unroll
    for (int k = 0; k < K; ++k) {
        hs[k] = State(h_of[n + k], h_of[states + n + k], at.slow[k]);
        if constexpr (!Config::OUTPUT)
            products[k] = State(product_of[n + k], product_of[states + n + k], at.slow[k]);
    }
    for (int t = 0; t < p.count; ++t) {
        fetch.next();
        const float *const B_t = B.row(t), *const C_t = C.row(t);
        const F rate = token[t].rate, du = token[t].du;
        F y = token[t].y;
#pragma unroll
        for (int k = 0; k < K; ++k) {
            F fm1, g;
            const F f = factors<Config, Kind::IN_RANGE>(rate * at.A[k], fm1, g);
            hs[k].step(f, fm1, g * (du * B_t[k]));
            if constexpr (Config::OUTPUT) y = fma(hs[k].value(), splat(C_t[k]), y);
            else products[k].decay(State::saved_of(f, fm1, at.slow[k]));
        }
        if constexpr (Config::OUTPUT) token[t].y = y;
    }
#pragma unroll
    for (int k = 0; k < K; ++k) {
        hs[k].store(h_of[n + k], h_of[states + n + k]);
        if constexpr (!Config::OUTPUT)
            products[k].store(product_of[n + k], product_of[states + n + k]);
    }
}

template<class Config, class In, class Out>
static void forward(int task, const In& in, const Out& out) {
    constexpr bool OUTPUT = Config::OUTPUT;
    constexpr int CHUNK = Config::CHUNK;
    const int states = in.sizes.states;
    F* const work = workspace(out.work, in.sizes, task);
    // of a lane group: states, then the group's values
    const int own = (OUTPUT ? 2 : 4) * states, room = own + states + Group::MORE;
    auto work_of = [&](const Position& p) { return work + p.j * room; };
    auto enter = [&](const Position& p) {
        load_group(in, p, work_of(p) + own);
        load_pairs(in.first, p, states, work_of(p));
        if (!OUTPUT) fill_pairs(work_of(p) + 2 * states, states, 1.0f);
    };
    auto traverse = [&](const Position p) __attribute__((always_inline)) {
        alignas(64) Token token[Config::TOKENS];
        const Group group(work_of(p) + own, states);
        F *const h_of = work_of(p), *const product_of = h_of + 2 * states;
        if (out.starts.shape[0] > 0 && (p.t0 - p.begin) % CHUNK == 0) {
            F* const start = at(out.starts, p.chunk + (p.t0 - p.begin) / CHUNK, p.k);
            for (int n = 0; n < states; ++n) start[n] = h_of[n];
        }
        const bool use_softplus = in.sizes.use_softplus, use_z = OUTPUT && in.sizes.use_z;
        Fetches fetches;
        read_soon<Config>(fetches, in.delta, p), read_soon<Config>(fetches, in.u, p);
        if (use_z) read_soon<Config>(fetches, in.z, p);
        if (OUTPUT) write_soon<Config>(fetches, out.y, p, in.sizes.stream);
        F max_rate;
        if (p.width >= 16 && use_softplus && use_z)  // usual: compiled separately
            max_rate = prepare<Config>(in, p, group, 16, true, true, token);
        else max_rate = prepare<Config>(in, p, group, p.width, use_softplus, use_z, token);
        auto visit = [&](auto kind, const auto& at) __attribute__((always_inline)) {
            recur<Config>(kind, at, in, p, h_of, product_of, token, fetches.next());
        };
        each_state<Config>(group, max_rate, true, visit);
        fetches.rest(p.count);
        if constexpr (OUTPUT) {
            auto value = [&](int t) { return token[t].y * token[t].gate; };
            scatter(rows_of(out.y, p, p.width), 0, p.count, value, in.sizes.stream);
        }
    };
    const Position p = position_of<Config>(in, task, false);
    each_strip<Config>(in.sizes, p, false, enter, traverse, [&](const Position& p) {
        store_states(out.last, p, work_of(p));
        if (!OUTPUT) store_states(out.product, p, work_of(p) + 2 * states);
    });
}

}  // namespace gamba::scan
