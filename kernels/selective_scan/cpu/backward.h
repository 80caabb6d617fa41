// The scan's gradient on a CPU: equation 1 again, keeping decay and state of every token, and the
// sums of equation 8; then backwards equations 6, 7 and 9 to 12. Σ rate q is left in dA.
#include "state.h"
#include "strip.h"
namespace gamba::scan {

// As in the forward; s and p are sums over the states. Values that the states do not need are
// separate.
struct Token {
    F rate, du, dy, y, s, p;
};
struct PerToken {
    F u, slope, gate;
};
// Of a token and state: f or f - 1, the state before, and g where it is not 1.
template<bool WEIGHTED>
struct Saved {
    F m, h, g;
};
template<>
struct Saved<false> {
    F m, h;
};

// The part of a strip that does not depend on the state n: as in the forward, with
// dy = dout silu(z), and the slopes of the step and of the gate. Returns the largest |rate|.
template<class Config, class In>
INLINE F prepare(const In& in, const Position& p, const Group& group, int width, bool use_softplus,
    bool use_z, Token* token, PerToken* per_token) {
    const auto us = lanes_of<Config>(in.u, p, width, token[0].du, sizeof(Token));
    const auto deltas = lanes_of<Config>(in.delta, p, width, token[0].rate, sizeof(Token));
    const auto zs = lanes_of<Config>(in.z, p, width, token[0].y, sizeof(Token), use_z);
    const auto douts = lanes_of<Config>(in.dout, p, width, token[0].dy, sizeof(Token));
    F max_rate = F{};
    for (int t = 0; t < p.count; ++t) {
        F delta = read(deltas, t) + group.delta_bias, slope = splat(1.0f), dy = read(douts, t),
          gate = F{};
        if (use_softplus && use_z) {  // both slopes with one division
            const F z = read(zs, t), e = decay(delta), ez = decay(z);
            const F ds = e + 1.0f, dz = ez + 1.0f, r = 1.0f / (ds * dz);
            const F sig = (z < 0.0f ? ez : splat(1.0f)) * (ds * r), silu = z * sig;
            gate = dy * fma(silu, 1.0f - sig, sig);
            dy *= silu;
            slope = (delta < 0.0f ? e : splat(1.0f)) * (dz * r);
            delta = softplus_of(delta, e / (e + 2.0f));  // as in the forward, to the last bit
        } else {
            if (use_z) {
                const F z = read(zs, t), sig = sigmoid(z), silu = z * sig;
                gate = dy * fma(silu, 1.0f - sig, sig);
                dy *= silu;
            }
            if (use_softplus) {
                slope = sigmoid(delta);
                delta = softplus(delta);
            }
        }
        const F u = read(us, t), rate = delta * Config::SCALE;
        max_rate = max_abs(max_rate, rate);
        token[t] = {rate, delta * u, dy, group.D * u, F{}, F{}};
        per_token[t] = {u, slope, gate};
    }
    return max_rate;
}
// Of both kernels, with the rows of the strip that is next.
template<class Config, class In>
INLINE F prepare_strip(const In& in, const Position& p, const Group& group, Token* token,
    PerToken* per_token, Fetches& fetches) {
    const bool use_softplus = in.sizes.use_softplus, use_z = in.sizes.use_z;
    read_soon<Config>(fetches, in.delta, p), read_soon<Config>(fetches, in.u, p);
    read_soon<Config>(fetches, in.dout, p);
    if (use_z) read_soon<Config>(fetches, in.z, p);
    if (p.width >= 16 && use_softplus && use_z)  // usual: compiled separately
        return prepare<Config>(in, p, group, 16, true, true, token, per_token);
    return prepare<Config>(in, p, group, p.width, use_softplus, use_z, token, per_token);
}

// The gradient of a segment's outputs by the state before its first token, dh, and the product of
// its decays.
template<class Config, class In, class Out>
static void gradient_states(int task, const In& in, const Out& out) {
    const int states = in.sizes.states;
    F* const work = workspace(out.work, in.sizes, task);
    // of a lane group: states, then the group's values
    const int own = 4 * states, room = own + states + Group::MORE;
    auto work_of = [&](const Position& p) { return work + p.j * room; };
    auto enter = [&](const Position& p) {
        load_group(in, p, work_of(p) + own);
        fill_pairs(work_of(p), states, 0.0f), fill_pairs(work_of(p) + 2 * states, states, 1.0f);
    };
    auto traverse = [&](const Position p) __attribute__((always_inline)) {
        alignas(64) Token token[Config::TOKENS];
        alignas(64) PerToken per_token[Config::TOKENS];
        const Group group(work_of(p) + own, states);
        Fetches fetches;
        const F max_rate = prepare_strip<Config>(in, p, group, token, per_token, fetches);
        F *const dh_of = work_of(p), *const product_of = dh_of + 2 * states;
        auto visit = [&](auto kind, const auto& at) __attribute__((always_inline)) {
            using State = typename decltype(kind)::State;
            constexpr int K = sizeof(at.A) / sizeof(F);
            const int n = at.n;
            const Column C = column_of(in.C, p, n);
            State dhs[K], products[K];
#pragma unroll
            for (int k = 0; k < K; ++k) {
                dhs[k] = State(dh_of[n + k], dh_of[states + n + k], at.slow[k]);
                products[k] = State(product_of[n + k], product_of[states + n + k], at.slow[k]);
            }
            Fetch fetch = fetches.next();
            for (int t = 0; t < p.count; ++t) {
                fetch.next();
                const float* const C_t = C.row(t);
#pragma unroll
                for (int k = 0; k < K; ++k) {
                    F fm1, g;
                    const F f =
                        factors<Config, decltype(kind)::IN_RANGE>(token[t].rate * at.A[k], fm1, g);
                    products[k].decay(State::saved_of(f, fm1, at.slow[k]));
                    dhs[k].add(products[k].value(), token[t].dy * C_t[k]);
                }
            }
#pragma unroll
            for (int k = 0; k < K; ++k) {
                dhs[k].store(dh_of[n + k], dh_of[states + n + k]);
                products[k].store(product_of[n + k], product_of[states + n + k]);
            }
        };
        each_state<Config>(group, max_rate, true, visit);
        fetches.rest(p.count);
    };
    const Position p = position_of<Config>(in, task, false);
    each_strip<Config>(in.sizes, p, false, enter, traverse, [&](const Position& p) {
        store_states(out.dh, p, work_of(p)), store_states(out.product, p, work_of(p) + 2 * states);
    });
}

// A chunk of a lane group while its states are traversed.
template<class Config>
struct Chunk {
    Token* token;
    Saved<Config::WEIGHTED>* saved;  // [TOKENS, K]
    const F* start;                  // its first states
    F *dh, *dA;                      // dh: pairs
    F *dB, *dC;                      // sums over lane groups, [states, TOKENS]
};

// Equations 1 and 8 for some states, and then backwards 6, 7, 9, 10 and 12. The sums dB and dC
// restart in the first of the lane groups that share them. Gradients that are not in ``needs`` are
// not computed.
template<class Config, class Kind, class States>
INLINE void recompute(Kind, const States& at, const Position& p, int needs, const Column& B,
    const Column& C, const Chunk<Config>& chunk, Fetch fetch) {
    using State = typename Kind::State;
    constexpr int K = States::K, TOKENS = Config::TOKENS;
    const int n = at.n;
    F *const dB = chunk.dB + n * TOKENS, *const dC = chunk.dC + n * TOKENS;
    if (p.j % Config::BLOCKS == 0)
        for (int t = 0; t < K * TOKENS; ++t) {
            if (needs & Config::NEED_DB) dB[t] = F{};
            if (needs & Config::NEED_DC) dC[t] = F{};
        }
    State hs[K];
#pragma unroll
    for (int k = 0; k < K; ++k) hs[k] = State(chunk.start[n + k], F{}, at.slow[k]);
    for (int t = 0; t < p.count; ++t) {
        fetch.next();
        const float *const B_t = B.row(t), *const C_t = C.row(t);
        Token& token = chunk.token[t];
        const F rate = token.rate, du = token.du, dy = token.dy;
        F y = token.y;
#pragma unroll
        for (int k = 0; k < K; ++k) {
            State& h = hs[k];
            auto& saved = chunk.saved[t * K + k];
            F fm1, g;
            const F f = factors<Config, Kind::IN_RANGE>(rate * at.A[k], fm1, g);
            saved.m = State::saved_of(f, fm1, at.slow[k]), saved.h = h.value();
            if constexpr (Config::WEIGHTED) saved.g = g;
            h.step(f, fm1, g * (du * B_t[k]));
            if (needs & Config::NEED_DZ) y = fma(h.value(), splat(C_t[k]), y);
            if (needs & Config::NEED_DC)
                dC[k * TOKENS + t] = fma(dy, h.value(), dC[k * TOKENS + t]);
        }
        token.y = y;
    }
}
template<class Config, class Kind, class States>
INLINE void reverse(Kind, const States& at, const Position& p, int needs, int states,
    const Column& B, const Column& C, const Chunk<Config>& chunk, Fetch fetch) {
    using State = typename Kind::State;
    constexpr int K = States::K, TOKENS = Config::TOKENS;
    const int n = at.n;
    F* const dB = chunk.dB + n * TOKENS;
    State dhs[K];
    F dAs[K];
#pragma unroll
    for (int k = 0; k < K; ++k) {
        dhs[k] = State(chunk.dh[n + k], chunk.dh[states + n + k], at.slow[k]);
        dAs[k] = F{};
    }
    for (int t = p.count - 1; t >= 0; --t) {
        fetch.next();
        const float *const B_t = B.row(t), *const C_t = C.row(t);
        Token& token = chunk.token[t];
        const F rate = token.rate, du = token.du, dy = token.dy;
        F s = token.s, sum = token.p;
#pragma unroll
        for (int k = 0; k < K; ++k) {
            State& dh = dhs[k];
            const auto& saved = chunk.saved[t * K + k];
            const float b = B_t[k];
            dh.add(dy, splat(C_t[k]));
            const F v = dh.value();
            F gv = v;
            if constexpr (Config::WEIGHTED) gv = saved.g * v;
            if (needs & Config::NEED_DB) dB[k * TOKENS + t] = fma(gv, du, dB[k * TOKENS + t]);
            s = fma(gv, splat(b), s);
            F q;
            if constexpr (Config::WEIGHTED) {
                F df, dg;
                const F f = State::decay_of(saved.m, at.slow[k]);
                slopes<Config>(rate * at.A[k], f, saved.g, df, dg);
                q = v * (saved.h * df + du * b * dg);
                dh.decay(saved.m);
            } else {
                dh.decay(saved.m);
                q = dh.value() * saved.h;
            }
            sum = fma(q, at.A[k], sum);
            dAs[k] = fma(q, rate, dAs[k]);
        }
        token.s = s, token.p = sum;
    }
#pragma unroll
    for (int k = 0; k < K; ++k) {
        dhs[k].store(chunk.dh[n + k], chunk.dh[states + n + k]);
        chunk.dA[n + k] += dAs[k];
    }
}

// Equations 9 and 11, dz, and the chunk's sums for dD and ddelta_bias. They are added by runs of
// eight tokens, because equal terms would round to the same side at every token.
template<class Config, class Out>
INLINE void store_tokens(const Position& p, const Group& group, Token* token,
    const PerToken* per_token, bool stream, const Out& out, F& dD, F& ddelta_bias) {
    auto du = [&](int t) {
        return fma(token[t].rate * (1.0f / Config::SCALE), token[t].s, group.D * token[t].dy);
    };
    auto ddelta = [&](int t) { return token[t].p; };
    auto dz = [&](int t) { return token[t].y * per_token[t].gate; };
    const auto dus = rows_of(out.du, p, p.width), dzs = rows_of(out.dz, p, p.width);
    const auto ddeltas = rows_of(out.ddelta, p, p.width);
    const bool need_u = out.du.shape[1] > 0, need_delta = out.ddelta.shape[1] > 0;
    const bool need_z = out.dz.shape[1] > 0;
    auto write = [&](auto put) __attribute__((always_inline)) {
        if (need_u) put(dus, du);
        if (need_delta) put(ddeltas, ddelta);
        if (need_z) put(dzs, dz);
    };
    F D_run = F{}, bias_run = F{};
    dD = ddelta_bias = F{};
    for (int t = 0; t < p.count; ++t) {
        Token& now = token[t];
        const F u = per_token[t].u;
        D_run = fma(now.dy, u, D_run);
        now.p = fma(u, now.s, now.p) * per_token[t].slope;
        bias_run += now.p;
        if ((t & 7) == 7 || t == p.count - 1) {
            dD += D_run, ddelta_bias += bias_run;
            D_run = bias_run = F{};
        }
        if constexpr (!Config::TRANSPOSED)
            write([&](const auto& rows, auto value)
                      __attribute__((always_inline)) { put(rows, t, value(t), stream); });
    }
    if constexpr (Config::TRANSPOSED)
        write([&](const auto& rows, auto value)
                  __attribute__((always_inline)) { scatter(rows, 0, p.count, value, stream); });
}

// Adds the lanes of sums [states, TOKENS, 2], eight rows at a time, into total [states, length].
typedef float E __attribute__((vector_size(32), aligned(4)));
static inline E add_pairs(E a, E b) {
    return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13)
        + __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
}
static inline E add_quads(E a, E b) {
    return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13)
        + __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
}
template<class Config>
static inline void sum_lanes(
    const Position& p, int states, int length, const F* sums, float* total) {
    for (int n = 0; n < states; ++n)
        for (int t = 0; t < p.count; t += 8) {
            const E* const r = (const E*)(sums + n * Config::TOKENS + t);
            E v[8];
            for (int i = 0; i < 8; ++i) v[i] = r[2 * i] + r[2 * i + 1];
            const E low = add_quads(add_pairs(v[0], v[1]), add_pairs(v[2], v[3]));
            const E high = add_quads(add_pairs(v[4], v[5]), add_pairs(v[6], v[7]));
            const E all = __builtin_shufflevector(low, high, 0, 1, 2, 3, 8, 9, 10, 11)
                + __builtin_shufflevector(low, high, 4, 5, 6, 7, 12, 13, 14, 15);
            float* const out = total + n * (size_t)length + p.t0 + t;
            if (t + 8 <= p.count) *(E*)out = all;
            else
                for (int i = 0; i < p.count - t; ++i) out[i] = all[i];
        }
}

template<class Config, class In, class Out>
static void backward(int task, const In& in, const Out& out) {
    constexpr int TOKENS = Config::TOKENS, BLOCKS = Config::BLOCKS;
    const int states = in.sizes.states, stream = in.sizes.stream;
    F *const work = workspace(out.work, in.sizes, task),
             *const sums = workspace(out.sums, in.sizes, task);
    // of a lane group: states, then the group's values
    const int own = 3 * states, room = own + states + Group::MORE;
    auto work_of = [&](const Position& p) { return work + p.j * room; };
    auto enter = [&](const Position& p) {
        load_group(in, p, work_of(p) + own);
        load_pairs(in.dlast, p, states, work_of(p)), fill(work_of(p) + 2 * states, states, 0.0f);
    };
    auto traverse = [&](const Position p) __attribute__((always_inline)) {
        alignas(64) PerToken per_token[TOKENS];
        alignas(64) Saved<Config::WEIGHTED> saved[TOKENS * Config::AT_ONCE];
        alignas(64) Token token[TOKENS];
        const Group group(work_of(p) + own, states);
        Fetches fetches;
        const F max_rate = prepare_strip<Config>(in, p, group, token, per_token, fetches);
        const int row = p.chunk + (p.t0 - p.begin) / TOKENS;
        write_soon<Config>(fetches, out.du, p, stream);
        write_soon<Config>(fetches, out.ddelta, p, stream);
        write_soon<Config>(fetches, out.dz, p, stream);
        F* const dh = work_of(p);
        const Chunk<Config> chunk = {token, saved, at(in.starts, row, p.k), dh, dh + 2 * states,
            sums, sums + states * TOKENS};
        const int all = Config::NEED_DZ | Config::NEED_DC | Config::NEED_DB | Config::NEED_DH;
        auto visit = [&](auto kind, const auto& at) __attribute__((always_inline)) {
            const int needs = sizeof(at.A) == sizeof(F) ? in.sizes.needs : all;
            const Column B = column_of(in.B, p, at.n), C = column_of(in.C, p, at.n);
            recompute<Config>(kind, at, p, needs, B, C, chunk, fetches.next());
            if (needs & Config::NEED_DH)
                reverse<Config>(kind, at, p, needs, states, B, C, chunk, fetches.next());
        };
        each_state<Config>(group, max_rate, in.sizes.needs == all, visit);
        fetches.rest(p.count);
        store_tokens<Config>(p, group, token, per_token, stream, out,
            *at(out.dchannel, row, 0, p.k), *at(out.dchannel, row, 1, p.k));
        if (p.j % BLOCKS == BLOCKS - 1 || p.j == p.blocks - 1) {
            const size_t part = p.part + p.j / BLOCKS, size = (size_t)states * in.sizes.length;
            if (in.sizes.needs & Config::NEED_DB)
                sum_lanes<Config>(p, states, in.sizes.length, chunk.dB, out.dB.data + part * size);
            if (in.sizes.needs & Config::NEED_DC)
                sum_lanes<Config>(p, states, in.sizes.length, chunk.dC, out.dC.data + part * size);
        }
    };
    const Position p = position_of<Config>(in, task, true);
    each_strip<Config>(in.sizes, p, true, enter, traverse, [&](const Position& p) {
        store_states(out.dfirst, p, work_of(p)), store_states(out.dA, p, work_of(p) + 2 * states);
    });
}

}  // namespace gamba::scan
