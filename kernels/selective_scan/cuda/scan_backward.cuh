// The gradient of a segment, chunk by chunk, last first. A chunk starts from the state that the
// forward saved: states are recomputed and kept every few tokens, then tiles are processed, last
// first. Values of a channel are turned into operands in shared memory, and the recurrence iterates
// over a few tokens at a time, forwards again, holding decays and states in registers, and
// backwards. Sums over states and over the block's channels go through shared memory, so that dB
// and dC leave a block once per token and state.
#include "quads.cuh"
namespace gamba::scan {

// Equation 1 over a tile, whose first quad is ``first`` of the chunk. It keeps the states before
// the quads, up to the chunk's last one, ``quads``: those before that are whole, so none is masked.
template<class K>
static void recompute(const float* tile, float* memory, int first, int quads, const Position& p,
    const float (&A)[K::OWN], float (&h)[K::OWN]) {
    typedef Operands<K, RECOMPUTED> At;
    const int channel = p.slot * K::CHANNELS;
    WP_PRAGMA_NO_UNROLL
    for (int pass = 0; pass < K::PASSES; ++pass) {
        const int state = pass * K::WIDTH + p.q * K::STATES;
        float hn[K::HELD], An[K::HELD];
        WP_PRAGMA_UNROLL
        for (int k = 0; k < K::HELD; ++k)
            hn[k] = h[pass * K::HELD + k], An[k] = A[pass * K::HELD + k];
        WP_PRAGMA_UNROLL
        for (int quad = 0; quad < RECOMPUTED / QUAD; ++quad) {
            store(memory + Memory<K>::state(pass, first + quad), hn);
            if (first + quad >= quads) break;
            float step[K::CHANNELS][QUAD], x[K::CHANNELS][QUAD];
            WP_PRAGMA_UNROLL
            for (int i = 0; i < K::CHANNELS; ++i) {
                const int at = (quad * K::SPAN + channel + i) * QUAD;
                load(tile + At::STEP + at, step[i]);
                load(tile + At::INPUT + at, x[i]);
            }
            WP_PRAGMA_UNROLL
            for (int t = 0; t < QUAD; ++t) {
                float B[K::STATES];
                load(tile + At::MATRIX + (quad * QUAD + t) * K::PADDED + state, B);
                WP_PRAGMA_UNROLL
                for (int k = 0; k < K::HELD; ++k) {
                    const int i = k / K::STATES, j = k % K::STATES;
                    float f, g;
                    factors<K::MODE>(step[i][t], An[k], f, g);
                    hn[k] = f * hn[k] + g * (x[i][t] * B[j]);
                }
            }
        }
        WP_PRAGMA_UNROLL
        for (int k = 0; k < K::HELD; ++k) h[pass * K::HELD + k] = hn[k];
    }
}

// ``Memory`` of a chunk, from its first state h.
template<class K, class Number, class Delta, class Of>
static void recompute_chunk(float* shared, float* memory, int chunk, int end, const Position& p,
    const Tensors<Number, Delta, Of>& x, const float (&A)[K::OWN], float (&h)[K::OWN]) {
    typedef Operands<K, RECOMPUTED> At;
    unsigned u[At::COUNT], delta[At::COUNT], B[At::OF_MATRIX];
    auto load_tile = [&](int t0) {
        const int t = t0 + p.row * ADJACENT<K>;
        x.u.template load<K>(t, end - 1, u);
        x.delta.template load<K>(t, end - 1, delta);
        x.B.template load<K, RECOMPUTED>(p, t0, end - 1, B);
    };
    load_tile(chunk);
    const int quads = (end - chunk - 1) / QUAD;
    for (int i = 0; i < (end - chunk + RECOMPUTED - 1) / RECOMPUTED; ++i) {
        float* const tile = shared + i % 2 * At::SIZE;
        float step[At::COUNT], input[At::COUNT], slope[At::COUNT];
        WP_PRAGMA_UNROLL
        for (int j = 0; j < At::COUNT; ++j) {
            const float v = widen<Delta>(delta[j]) + x.delta_bias;
            step[j] = K::SOFTPLUS ? softplus(v) : v;
            if constexpr (K::SOFTPLUS) slope[j] = softplus_slope(v);
            input[j] = step[j] * widen<Number>(u[j]);
        }
        put_quads<K>(tile + At::STEP, p, step);
        put_quads<K>(tile + At::INPUT, p, input);
        store(memory + Memory<K>::STEPS + i * At::COUNT, step);
        if constexpr (K::SOFTPLUS) store(memory + Memory<K>::SLOPES + i * At::COUNT, slope);
        put_matrix<K, RECOMPUTED, Of>(tile + At::MATRIX, p, B);
        __syncthreads();
        load_tile(chunk + (i + 1) * RECOMPUTED);
        recompute<K>(tile, memory, i * (RECOMPUTED / QUAD), quads, p, A, h);
    }
}

// Registers of a quad and a pass.
template<class K>
struct Quad {
    typedef BackTile<K> At;
    float* tile;               // in shared memory
    int quad, slot, q, state;  // of the tile; of the thread; its first state
    bool first;                // pass
    float An[K::HELD];
    float step[K::CHANNELS][QUAD], x[K::CHANNELS][QUAD], dy[K::CHANNELS][QUAD];
    float f[QUAD][K::HELD], h[QUAD][K::HELD];  // decays, and the states before the tokens
    struct Token {
        float B[K::STATES], C[K::STATES];
    } next;

    int element(int i) const { return (quad * K::SPAN + slot * K::CHANNELS + i) * QUAD; }
    void load_operands() {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < K::CHANNELS; ++i) {
            load(tile + At::STEP + element(i), step[i]);
            load(tile + At::INPUT + element(i), x[i]);
            if constexpr (K::OUTPUT) load(tile + At::DY + element(i), dy[i]);
        }
    }
    void load_token(int t) {
        const int at = (quad * QUAD + t) * K::PADDED + state;
        load(tile + At::MATRIX + at, next.B);
        if constexpr (K::OUTPUT) load(tile + At::C + at, next.C);
    }
    void put_products(int at, int t, const float (&products)[K::STATES]) const {
        at += (quad * QUAD + t) * At::TOKEN + slot * K::WIDTH + q * K::STATES;
        store(tile + at, products);
    }
    // Adds a lane's sums for each channel to those of the passes before.
    void add_sums(int at, float (&sums)[K::CHANNELS][QUAD]) const {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < K::CHANNELS; ++i) {
            float* to = tile + at + q * At::LANE + slot * QUAD;
            to += (quad * K::CHANNELS + i) * (At::SLOT_STEP * QUAD);
            if (!first) {
                float before[QUAD];
                load(to, before);
                WP_PRAGMA_UNROLL
                for (int t = 0; t < QUAD; ++t) sums[i][t] += before[t];
            }
            store(to, sums[i]);
        }
    }

    // Equation 1 from the state hn, and the sums of equations 5 and 8. Exponentials come first, as
    // they wait for no state, and loads a token ahead.
    void iterate(float (&hn)[K::HELD]) {
        if constexpr (K::MODE == MAMBA) {
            WP_PRAGMA_UNROLL
            for (int t = 0; t < QUAD; ++t) WP_PRAGMA_UNROLL
            for (int k = 0; k < K::HELD; ++k) {
                float g;
                factors<K::MODE>(step[k / K::STATES][t], An[k], f[t][k], g);
            }
        }
        load_token(0);
        float y[K::CHANNELS][QUAD] = {};
        WP_PRAGMA_UNROLL
        for (int t = 0; t < QUAD; ++t) {
            const Token token = next;
            if (t + 1 < QUAD) load_token(t + 1);
            float dC[K::STATES] = {};
            WP_PRAGMA_UNROLL
            for (int k = 0; k < K::HELD; ++k) {
                const int i = k / K::STATES, j = k % K::STATES;
                float g = 1.0f;
                if constexpr (K::MODE != MAMBA) factors<K::MODE>(step[i][t], An[k], f[t][k], g);
                h[t][k] = hn[k];
                hn[k] = f[t][k] * hn[k] + g * (x[i][t] * token.B[j]);
                if constexpr (K::NEED_DC) dC[j] += dy[i][t] * hn[k];
                if constexpr (K::NEED_DZ) y[i][t] += token.C[j] * hn[k];
            }
            if constexpr (K::NEED_DC) put_products(At::DC, t, dC);
        }
        if constexpr (K::NEED_DZ) add_sums(At::Y, y);
    }

    // Equations 6, 7, 9, 10 and 12 after ``iterate``, from dh after the quad to before it.
    void reverse(float (&dh)[K::HELD], float (&dA)[K::HELD]) {
        float S[K::CHANNELS][QUAD] = {}, Aq[K::CHANNELS][QUAD] = {};
        WP_PRAGMA_UNROLL
        for (int t = QUAD - 1; t >= 0; --t) {
            const Token token = next;
            if (t > 0) load_token(t - 1);
            float dB[K::STATES] = {}, xt[K::CHANNELS], dyt[K::CHANNELS];
            WP_PRAGMA_UNROLL
            for (int i = 0; i < K::CHANNELS; ++i) {
                // slopes of ZOH need the registers, so these are loaded again
                constexpr bool AGAIN = K::MODE == ZOH;
                xt[i] = AGAIN ? tile[At::INPUT + element(i) + t] : x[i][t];
                if constexpr (K::OUTPUT) dyt[i] = AGAIN ? tile[At::DY + element(i) + t] : dy[i][t];
            }
            WP_PRAGMA_UNROLL
            for (int k = 0; k < K::HELD; ++k) {
                const int i = k / K::STATES, j = k % K::STATES;
                float d = dh[k], w, q;
                if constexpr (K::OUTPUT) d = dh[k] + dyt[i] * token.C[j];
                if constexpr (K::MODE == MAMBA) {
                    w = d;
                    dh[k] = f[t][k] * d;
                    q = dh[k] * h[t][k];
                } else {
                    float f, g, df, dg;
                    slopes<K::MODE>(step[i][t], An[k], f, g, df, dg);
                    dh[k] = f * d;
                    w = g * d, q = d * (h[t][k] * df + xt[i] * token.B[j] * dg);
                }
                if constexpr (K::NEED_DB) dB[j] += w * xt[i];
                S[i][t] += w * token.B[j];
                Aq[i][t] += q * An[k];
                dA[k] += q * step[i][t];
            }
            if constexpr (K::NEED_DB) put_products(At::DB, t, dB);
        }
        add_sums(At::S, S);
        add_sums(At::AQ, Aq);
    }
};

// Sums the products for dB and dC over the block's channels, in a fixed order: a thread takes TAKEN
// sums at a time.
template<class K>
static void sum_products(const float* tile, int pass, int left, long long products,
    const Position& p, const Array<float>& dB_out, const Array<float>& dC_out) {
    typedef BackTile<K> At;
    constexpr int TAKEN = At::TAKEN, OF_ONE = K::TOKENS * K::WIDTH / TAKEN;
    auto take = [&](unsigned e) {
        const int t = e / (K::WIDTH / TAKEN) % K::TOKENS, n = e % (K::WIDTH / TAKEN) * TAKEN;
        const bool is_dB = K::NEED_DB && (!K::NEED_DC || e < OF_ONE);
        const float* from = tile + (is_dB ? At::DB : At::DC) + t * At::TOKEN + n;
        constexpr int PARTS = K::SLOTS < 4 ? K::SLOTS : 4;
        float v[PARTS][TAKEN];
        WP_PRAGMA_UNROLL
        for (int i = 0; i < K::SLOTS; ++i) {
            float one[TAKEN];
            load(from + i * K::WIDTH, one);
            WP_PRAGMA_UNROLL
            for (int m = 0; m < TAKEN; ++m) v[i % 4][m] = i < 4 ? one[m] : v[i % 4][m] + one[m];
        }
        float* to = is_dB ? dB_out.data : dC_out.data;
        to += products + wide(t, p.states) + pass * K::WIDTH + n;
        WP_PRAGMA_UNROLL
        for (int m = 0; m < TAKEN; ++m)
            if (t < left && pass * K::WIDTH + n + m < p.states) {
                if constexpr (PARTS == 4) to[m] = (v[0][m] + v[1][m]) + (v[2][m] + v[3][m]);
                else if constexpr (PARTS == 2) to[m] = v[0][m] + v[1][m];
                else to[m] = v[0][m];
            }
    };
    constexpr int SUMS = (K::NEED_DB + K::NEED_DC) * OF_ONE;
    if constexpr (SUMS > K::BLOCK)
        for (unsigned e = p.lane; e < SUMS; e += K::BLOCK) take(e);
    else if (p.lane < SUMS) take(p.lane);
}

// Equations 6 to 12 over a tile, a quad at a time, last first. Sums over states leave the threads
// as sums of the lanes, a quad as one vector.
template<class K>
static void reverse(float* tile, const float* memory, int first, int left, long long products,
    const Position& p, const float (&A)[K::OWN], float (&dh)[K::OWN], float (&dA)[K::OWN],
    const Array<float>& dB_out, const Array<float>& dC_out) {
    WP_PRAGMA_NO_UNROLL
    for (int pass = 0; pass < K::PASSES; ++pass) {
        Quad<K> v;
        v.tile = tile, v.slot = p.slot, v.q = p.q, v.first = pass == 0;
        v.state = pass * K::WIDTH + p.q * K::STATES;
        float dhn[K::HELD], dAn[K::HELD];
        WP_PRAGMA_UNROLL
        for (int k = 0; k < K::HELD; ++k) {
            v.An[k] = A[pass * K::HELD + k];
            dhn[k] = dh[pass * K::HELD + k];
            dAn[k] = dA[pass * K::HELD + k];
        }
        WP_PRAGMA_NO_UNROLL
        for (v.quad = K::TOKENS / QUAD - 1; v.quad >= 0; --v.quad) {
            v.load_operands();
            float hn[K::HELD];
            load(memory + Memory<K>::state(pass, first + v.quad), hn);
            v.iterate(hn);
            if constexpr (K::NEED_DH) v.reverse(dhn, dAn);
        }
        WP_PRAGMA_UNROLL
        for (int k = 0; k < K::HELD; ++k) {
            dh[pass * K::HELD + k] = dhn[k];
            dA[pass * K::HELD + k] = dAn[k];
        }
        __syncthreads();
        if constexpr (K::PASSES > 1) {
            sum_products<K>(tile, pass, left, products, p, dB_out, dC_out);
            __syncthreads();
        }
    }
}

// A thread's elements of a tile.
template<class K>
struct Elements {
    static constexpr int N = BackTile<K>::COUNT;
    float u[N], gate[N];                        // of the gate the factor of y in dz
    float D_sum = 0.0f, delta_bias_sum = 0.0f;  // of a chunk
};
template<class K>
struct Loads {
    static constexpr int N = BackTile<K>::COUNT, M = BackTile<K>::OF_MATRIX;
    unsigned u[N], dout[N], z[N], B[M], C[M];
    float step[N];
};

// Values of a channel: operands of a tile, and what its gradients need after the recurrence.
template<class K, class Number, class Of>
static void put_tile(
    float* tile, int left, const Position& p, const Loads<K>& loads, Elements<K>& own) {
    typedef BackTile<K> At;
    float step[At::COUNT], input[At::COUNT], dy[At::COUNT];
    WP_PRAGMA_UNROLL
    for (int i = 0; i < At::COUNT; ++i) {
        step[i] = token_of<K>(i) < left ? loads.step[i] : 0.0f;
        own.u[i] = widen<Number>(loads.u[i]);
        input[i] = step[i] * own.u[i];
    }
    put_quads<K>(tile + At::STEP, p, step);
    put_quads<K>(tile + At::INPUT, p, input);
    if constexpr (K::OUTPUT) {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < At::COUNT; ++i) {
            dy[i] = token_of<K>(i) < left ? widen<Number>(loads.dout[i]) : 0.0f;
            if constexpr (K::GATE) {
                const float z = widen<Number>(loads.z[i]), s = sigmoid(z);
                own.gate[i] = dy[i] * s;
                dy[i] = own.gate[i] * z;
                own.gate[i] += dy[i] * (1.0f - s);
            }
        }
        put_quads<K>(tile + At::DY, p, dy);
        put_matrix<K, K::TOKENS, Of>(tile + At::C, p, loads.C);
    }
    put_matrix<K, K::TOKENS, Of>(tile + At::MATRIX, p, loads.B);
}

// Equations 9 and 11, and the terms of dD and ddelta_bias, of a thread's elements from token t on.
template<class K, class Number, class Delta, class Of>
static void store_gradients(const float* tile, int t, int left, const Position& p,
    const Tensors<Number, Delta, Of>& x, const float (&slope)[BackTile<K>::COUNT],
    Elements<K>& own) {
    typedef BackTile<K> At;
    float dy[At::COUNT] = {};
    float dD = 0.0f, ddelta_bias = 0.0f;
    if constexpr (K::OUTPUT) get_quads<K>(tile + At::DY, p, dy);
    if constexpr (K::NEED_DZ) {
        float y[At::COUNT];
        sum_lanes<K>(tile + At::Y, p, y);
        WP_PRAGMA_UNROLL
        for (int i = 0; i < At::COUNT; ++i) {
            const float dz = own.gate[i] * (y[i] + x.D * own.u[i]);
            x.dz.store(t + token_of<K>(i), token_of<K>(i) < left, dz);
        }
    }
    if constexpr (K::NEED_DH) {
        float S[At::COUNT], Aq[At::COUNT], step[At::COUNT];
        sum_lanes<K>(tile + At::S, p, S);
        sum_lanes<K>(tile + At::AQ, p, Aq);
        get_quads<K>(tile + At::STEP, p, step);
        WP_PRAGMA_UNROLL
        for (int i = 0; i < At::COUNT; ++i) {
            const bool inside = token_of<K>(i) < left;
            // A has log2(e) for an exponential
            float ddelta =
                own.u[i] * S[i] + Aq[i] * (K::MODE == BILINEAR ? 1.0f : 0.6931471805599453f);
            if constexpr (K::SOFTPLUS) ddelta = ddelta * slope[i];
            ddelta_bias += inside ? ddelta : 0.0f;
            if constexpr (K::NEED_DU)
                x.du.store(t + token_of<K>(i), inside, x.D * dy[i] + step[i] * S[i]);
            if constexpr (K::NEED_DDELTA) x.ddelta.store(t + token_of<K>(i), inside, ddelta);
        }
    }
    WP_PRAGMA_UNROLL
    for (int i = 0; i < At::COUNT; ++i) dD += dy[i] * own.u[i];
    own.D_sum += dD;
    own.delta_bias_sum += ddelta_bias;
}

// The tiles of a chunk, last first. ``products`` is where the block's of token 0 begin.
template<class K, class Number, class Delta, class Of>
static void reverse_chunk(float* tile, const float* memory, int chunk, int end, long long products,
    const Position& p, const Tensors<Number, Delta, Of>& x, const float (&A)[K::OWN],
    float (&dh)[K::OWN], float (&dA)[K::OWN], Elements<K>& own) {
    typedef BackTile<K> At;
    Loads<K> loads;
    const int tiles = (end - chunk + K::TOKENS - 1) / K::TOKENS;
    int kept = (tiles - 1) * At::COUNT;
    auto load_tile = [&](int t0) {
        const int t = t0 + p.row * ADJACENT<K>;
        x.u.template load<K>(t, end - 1, loads.u);
        load(memory + Memory<K>::STEPS + kept, loads.step);
        x.B.template load<K, K::TOKENS>(p, t0, end - 1, loads.B);
        if constexpr (K::OUTPUT) {
            x.dout.template load<K>(t, end - 1, loads.dout);
            x.C.template load<K, K::TOKENS>(p, t0, end - 1, loads.C);
            if constexpr (K::GATE) x.z.template load<K>(t, end - 1, loads.z);
        }
    };
    load_tile(chunk + (tiles - 1) * K::TOKENS);
    for (int i = tiles - 1; i >= 0; --i) {
        const int t0 = chunk + i * K::TOKENS, t = t0 + p.row * ADJACENT<K>;
        const int left = p.active ? end - t : 0;
        const long long of_tile = products + wide(t0, p.states);
        put_tile<K, Number, Of>(tile, left, p, loads, own);
        __syncthreads();
        reverse<K>(
            tile, memory, (t0 - chunk) / QUAD, end - t0, of_tile, p, A, dh, dA, x.dB_out, x.dC_out);
        // the loads of the tile before are in flight while the sums are completed
        float slope[At::COUNT];
        load(memory + Memory<K>::SLOPES + kept, slope);
        kept = max(kept - At::COUNT, 0);
        load_tile(max(t0 - K::TOKENS, chunk));
        if constexpr (K::PASSES == 1)
            sum_products<K>(tile, 0, end - t0, of_tile, p, x.dB_out, x.dC_out);
        store_gradients<K>(tile, t, left, p, x, slope, own);
    }
    __syncthreads();
}

// A segment.
template<class K, class Sizes, class Number, class Delta, class Of>
static void scan_backward(int index, int lane, float* shared, const Sizes& sizes,
    const Array<int>& packed_in, const Array<Number>& u_in, const Array<Delta>& delta_in,
    const Array<Number>& z_in, const Array<float>& A_in, const Array<Of>& B_in,
    const Array<Of>& C_in, const Array<float>& D_in, const Array<float>& delta_bias_in,
    const Array<Number>& dout_in, const Array<float>& saved_in, const Array<float>& dlast_state_in,
    const Array<float>& dinitial_state_out, const Array<Number>& du_out,
    const Array<Delta>& ddelta_out, const Array<Number>& dz_out, const Array<float>& dA_out,
    const Array<float>& dB_out, const Array<float>& dC_out, const Array<float>& dD_out,
    const Array<float>& ddelta_bias_out) {
    const Position p = position<K>(index, lane, sizes, packed_in);
    const Tensors<Number, Delta, Of> x = {{u_in, p}, {z_in, p}, {dout_in, p}, {du_out, p},
        {dz_out, p}, {delta_in, p}, {ddelta_out, p}, {B_in, p}, {C_in, p}, D_in.data[p.d],
        delta_bias_in.data[p.d], dB_out, dC_out};
    alignas(16) float own_memory[Memory<K>::FLOATS] = {};  // states past the end are read
    float* const memory = (float*)origin(own_memory, 0);
    float A[K::OWN], dh[K::OWN], dA[K::OWN] = {};
    load_A<K>(A_in, p, A);
    load_states<K>(dlast_state_in, p.segment_row, p, dh);
    Elements<K> own;
    const int row = (p.b * sizes.groups + p.group) * sizes.parts + p.part;
    const long long products = wide(row, sizes.length) * sizes.states;
    const int chunks = (p.end - p.begin + K::CHUNK - 1) / K::CHUNK;
    for (int i = chunks - 1; i >= 0; --i) {
        const int chunk = p.begin + i * K::CHUNK, end = min(chunk + K::CHUNK, p.end);
        float h[K::OWN];
        load_states<K>(saved_in, p.saved_row + i, p, h);
        recompute_chunk<K>(shared, memory, chunk, end, p, x, A, h);
        __syncthreads();
        reverse_chunk<K>(shared, memory, chunk, end, products, p, x, A, dh, dA, own);
        // the chunk's sums are added to its run's, which begin at 0 in memory
        const int run = p.run + (chunks - 1 - i) / K::RUN;
        float before[K::OWN];
        load_states<K>(dA_out, run, p, before);
        WP_PRAGMA_UNROLL
        for (int k = 0; k < K::OWN; ++k) before[k] = dA[k] + before[k], dA[k] = 0.0f;
        store_states<K>(dA_out, run, p, before);
        if (p.active) {
            *wp::address(dD_out, run, p.row, p.d) += own.D_sum;
            *wp::address(ddelta_bias_out, run, p.row, p.d) += own.delta_bias_sum;
        }
        own.D_sum = own.delta_bias_sum = 0.0f;
    }
    if (p.segment == 0) store_states<K>(dinitial_state_out, p.sequence, p, dh);
}

}  // namespace gamba::scan
