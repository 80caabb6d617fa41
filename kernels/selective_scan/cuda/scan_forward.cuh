// The recurrence over a segment from its first state: the forward, and in reverse the first kernel
// of a gradient in segments. A tile of tokens at a time is loaded, turned into operands in shared
// memory, iterated by the recurrence, and gated and stored, with one barrier a tile: there are two
// buffers, and the loads of the next tile are on their way meanwhile.
#include "block.cuh"
namespace gamba::scan {

// The bits of a thread's elements of the tile of [B, L, D] from token t0 on; 0 from ``end`` on.
template<class K, class Number, int N>
static void load_channel(
    const Array<Number>& x_in, const Position& p, int t0, int end, unsigned (&bits)[N]) {
    const int t = t0 + p.row, left = end - t;
    const char* at = (char*)(x_in.data + p.d) + wide(p.b, x_in.strides[0]);
    at += wide(t, x_in.strides[1]);
    const long long step = wide(K::ROWS, x_in.strides[1]);
    WP_PRAGMA_UNROLL
    for (int i = 0; i < N; ++i, at += step)
        bits[i] = K::ROWS * i < left ? bits_of((const Number*)at) : 0;
}
// The same for a block's tile of B or C, [B, L, G, N].
template<class K, class Number, int N>
static void load_matrix(
    const Array<Number>& x_in, const Position& p, int t0, int end, unsigned (&bits)[N]) {
    const char* from = (const char*)x_in.data + wide(p.b, x_in.strides[0]);
    from += wide(p.group, x_in.strides[2]);
    WP_PRAGMA_UNROLL
    for (int i = 0; i < N; ++i) {
        const int e = K::BLOCK * i + p.lane, t = e / K::PADDED, n = e % K::PADDED;
        const char* at = from + wide(n, x_in.strides[3]) + wide(t0 + t, x_in.strides[1]);
        bits[i] = 0;
        if (t < end - t0 && n < p.states && e < K::TOKENS * K::PADDED)
            bits[i] = bits_of((const Number*)at);
    }
}

// δ of a delta's bits, or 0.
template<class K, class Delta>
static float step_of(unsigned bits, float delta_bias, bool inside) {
    float step = widen<Delta>(bits) + delta_bias;
    if constexpr (K::SOFTPLUS) step = softplus(step);
    return inside ? step : 0.0f;
}

// A tile in shared memory: after the operands C, and sums over a lane's states, [LANES, TOKENS,
// SPAN].
template<class K>
struct Tile : Operands<K, K::TOKENS> {
    static constexpr int C = Operands<K, K::TOKENS>::SIZE, Y = C + K::TOKENS * K::PADDED;
    static constexpr int LANE = K::TOKENS * K::SPAN + K::PAD;  // of Y
    static constexpr bool SUMS = K::OUTPUT && !K::SUMMARY;
    static constexpr int FLOATS = SUMS ? Y + K::LANES * LANE : C;
    static_assert(2 * FLOATS == K::SHARED, "kernels.py computes the size of shared memory");
};

// Equation 1 over a tile, and with outputs the sums of equation 5 for each lane. In REVERSE it is
// equation 6, dh from after the tile to before it. Tokens past the end have δ = 0 and change
// nothing.
template<class K, bool REVERSE>
static void advance(float* tile, const Position& p, const float (&A)[K::OWN], float (&h)[K::OWN]) {
    typedef Tile<K> At;
    constexpr int TOKENS = 4;  // whose sums wait in registers: their loads need not wait for stores
    const int channel = p.slot * K::CHANNELS;
    WP_PRAGMA_NO_UNROLL
    for (int pass = 0; pass < K::PASSES; ++pass) {
        const int state = pass * K::WIDTH + p.q * K::STATES;
        float hn[K::HELD], An[K::HELD];
        WP_PRAGMA_UNROLL
        for (int k = 0; k < K::HELD; ++k)
            hn[k] = h[pass * K::HELD + k], An[k] = A[pass * K::HELD + k];
        WP_PRAGMA_NO_UNROLL
        for (int t0 = 0; t0 < K::TOKENS; t0 += TOKENS) {
            float y[TOKENS][K::CHANNELS] = {};
            WP_PRAGMA_UNROLL
            for (int i = 0; i < TOKENS; ++i) {
                const int t = REVERSE ? K::TOKENS - 1 - (t0 + i) : t0 + i;
                float step[K::CHANNELS], x[K::CHANNELS], w[K::STATES], c[K::STATES];
                load(tile + At::STEP + t * K::SPAN + channel, step);
                load(tile + At::INPUT + t * K::SPAN + channel, x);
                load(tile + At::MATRIX + t * K::PADDED + state, w);
                if constexpr (At::SUMS) load(tile + At::C + t * K::PADDED + state, c);
                WP_PRAGMA_UNROLL
                for (int k = 0; k < K::HELD; ++k) {
                    const int d = k / K::STATES, n = k % K::STATES;
                    float f, g;
                    factors<K::MODE>(step[d], An[k], f, g);
                    if constexpr (REVERSE) hn[k] = f * (hn[k] + x[d] * w[n]);
                    else hn[k] = f * hn[k] + g * (x[d] * w[n]);
                    if constexpr (At::SUMS) y[i][d] += c[n] * hn[k];
                }
            }
            if constexpr (At::SUMS) {
                WP_PRAGMA_UNROLL
                for (int i = 0; i < TOKENS; ++i) {
                    float* to = tile + At::Y + p.q * At::LANE + (t0 + i) * K::SPAN + channel;
                    if (pass > 0) {
                        float before[K::CHANNELS];
                        load(to, before);
                        WP_PRAGMA_UNROLL
                        for (int d = 0; d < K::CHANNELS; ++d) y[i][d] += before[d];
                    }
                    store(to, y[i]);
                }
            }
        }
        WP_PRAGMA_UNROLL
        for (int k = 0; k < K::HELD; ++k) h[pass * K::HELD + k] = hn[k];
    }
}

// A segment's decay: the product of its f, or where these are exponentials the sum of its steps.
template<class K>
struct Decay {
    float product[K::OWN], steps = 0.0f;
    Decay() {
        WP_PRAGMA_UNROLL
        for (int k = 0; k < K::OWN; ++k) product[k] = 1.0f;
    }
    void multiply(const float* tile, const Position& p, const float (&A)[K::OWN]) {
        if constexpr (K::MODE == BILINEAR) {
            for (int t = 0; t < K::TOKENS; ++t) WP_PRAGMA_UNROLL
            for (int k = 0; k < K::OWN; ++k) {
                const int d = p.slot * K::CHANNELS + k % K::HELD / K::STATES;
                float f, g;
                factors<K::MODE>(tile[Tile<K>::STEP + t * K::SPAN + d], A[k], f, g);
                product[k] *= f;
            }
        }
    }
    void store(const Array<float>& decay_out, const Position& p) const {
        if constexpr (K::MODE == BILINEAR) store_states<K>(decay_out, p.segment_row, p, product);
        else if (p.active) *wp::address(decay_out, p.segment_row, p.row, p.d) = steps;
    }
};

// Equation 5 for a tile whose sums are in shared memory.
template<class K, class Number, int N>
static void store_outputs(const float* tile, const Position& p, int t0, int end,
    const unsigned (&u)[N], const unsigned (&z)[N], float D, const Array<Number>& y_out) {
    typedef Tile<K> At;
    WP_PRAGMA_UNROLL
    for (int i = 0; i < N; ++i) {
        if (i * K::ROWS >= end - t0) continue;
        float y = D * widen<Number>(u[i]);
        const float* const sums = tile + At::Y + (p.row + i * K::ROWS) * K::SPAN + p.c;
        WP_PRAGMA_UNROLL
        for (int q = 0; q < K::LANES; ++q) y += sums[q * At::LANE];
        if constexpr (K::GATE) {
            const float gate = widen<Number>(z[i]);
            y *= gate * sigmoid(gate);
        }
        char* at = (char*)(y_out.data + p.d) + wide(p.b, y_out.strides[0]);
        *(Number*)(at + wide(t0 + p.row + i * K::ROWS, y_out.strides[1])) = (Number)y;
    }
}

// A segment. As a SUMMARY it is computed from h = 0 for all but the last, without outputs, and
// gives its last state and decay.
template<class K, class Sizes, class Number, class Delta, class Matrix>
static void scan_forward(int index, int lane, float* shared, const Sizes& sizes,
    const Array<int>& packed_in, const Array<Number>& u_in, const Array<Delta>& delta_in,
    const Array<Number>& z_in, const Array<float>& A_in, const Array<Matrix>& B_in,
    const Array<Matrix>& C_in, const Array<float>& D_in, const Array<float>& delta_bias_in,
    const Array<float>& initial_state_in, const Array<float>& last_state_out,
    const Array<float>& decay_out, const Array<float>& saved_out, const Array<Number>& y_out) {
    typedef Tile<K> At;
    const Position p = position<K>(index, lane, sizes, packed_in);
    float A[K::OWN], h[K::OWN] = {};
    load_A<K>(A_in, p, A);
    if constexpr (!K::SUMMARY) load_states<K>(initial_state_in, p.segment_row, p, h);
    Decay<K> decay;
    const float delta_bias = delta_bias_in.data[p.d], D = D_in.data[p.d];
    unsigned u[At::COUNT], delta[At::COUNT], u_before[At::COUNT] = {}, z_before[At::COUNT] = {};
    unsigned B[At::OF_MATRIX], C[At::OF_MATRIX];
    auto load_tile = [&](int t0) {
        if constexpr (K::OUTPUT) load_matrix<K>(C_in, p, t0, p.end, C);
        load_channel<K>(u_in, p, t0, p.end, u);
        load_channel<K>(delta_in, p, t0, p.end, delta);
        load_matrix<K>(B_in, p, t0, p.end, B);
    };
    load_tile(p.begin);
    // of the last segment a summary is not needed; a packed sequence may have no token
    const int end = K::SUMMARY && p.segment == p.last ? p.begin : p.end;
    const int own_end = p.active ? p.end - p.row : 0;
    int t0 = p.begin, buffer = 0;
    for (; t0 < end; t0 += K::TOKENS, buffer = At::FLOATS - buffer) {
        float* const tile = shared + buffer;
        WP_PRAGMA_UNROLL
        for (int j = 0; j < At::COUNT; ++j) {
            const bool inside = j * K::ROWS < own_end - t0;
            const float step = step_of<K, Delta>(delta[j], delta_bias, inside);
            float* const at = tile + p.row * K::SPAN + p.c + j * K::ROWS * K::SPAN;
            at[At::STEP] = step;
            at[At::INPUT] = step * widen<Number>(u[j]);
            decay.steps += step;
        }
        put_matrix<K, K::TOKENS, Matrix>(tile + At::MATRIX, p, B);
        if constexpr (K::OUTPUT) put_matrix<K, K::TOKENS, Matrix>(tile + At::C, p, C);
        __syncthreads();
        if constexpr (K::OUTPUT) {
            if (t0 > p.begin)
                store_outputs<K>(shared + At::FLOATS - buffer, p, t0 - K::TOKENS, own_end, u_before,
                    z_before, D, y_out);
            WP_PRAGMA_UNROLL
            for (int j = 0; j < At::COUNT; ++j) u_before[j] = u[j];
            if constexpr (K::GATE) load_channel<K>(z_in, p, t0, p.end, z_before);
        }
        load_tile(t0 + K::TOKENS);
        if (!K::SUMMARY && sizes.save && (t0 - p.begin) % K::CHUNK == 0)
            store_states<K>(saved_out, p.saved_row + (t0 - p.begin) / K::CHUNK, p, h);
        if constexpr (K::SUMMARY) decay.multiply(tile, p, A);
        advance<K, false>(tile, p, A, h);
    }
    if constexpr (K::OUTPUT) {
        __syncthreads();
        if (t0 > p.begin)
            store_outputs<K>(shared + At::FLOATS - buffer, p, t0 - K::TOKENS, own_end, u_before,
                z_before, D, y_out);
    }
    if constexpr (K::SUMMARY) {
        store_states<K>(last_state_out, p.segment_row, p, h);
        decay.store(decay_out, p);
    } else if (p.segment == p.last) {
        store_states<K>(last_state_out, p.sequence, p, h);
    }
}

// A segment's gradient from its outputs alone: that of its first state, and its decay. It is
// computed for all segments but the first at once; ``carry`` then gives each the gradient of the
// state after it.
template<class K, class Sizes, class Number, class Delta, class Matrix>
static void summarise_backward(int index, int lane, float* shared, const Sizes& sizes,
    const Array<int>& packed_in, const Array<Delta>& delta_in, const Array<Number>& z_in,
    const Array<float>& A_in, const Array<Matrix>& C_in, const Array<float>& delta_bias_in,
    const Array<Number>& dout_in, const Array<float>& dinitial_state_out,
    const Array<float>& decay_out) {
    typedef Tile<K> At;
    const Position p = position<K>(index, lane, sizes, packed_in);
    float A[K::OWN], dh[K::OWN] = {};
    load_A<K>(A_in, p, A);
    Decay<K> decay;
    const float delta_bias = delta_bias_in.data[p.d];
    int tiles = (p.end - p.begin + K::TOKENS - 1) / K::TOKENS;
    if (p.segment == 0) tiles = 0;  // it is not needed
    int t0 = max(p.begin + (tiles - 1) * K::TOKENS, 0);
    const int end = tiles > 0 ? p.end : 0;
    unsigned delta[At::COUNT], dout[At::COUNT], z[At::COUNT], C[At::OF_MATRIX];
    auto load_tile = [&]() {
        load_channel<K>(delta_in, p, t0, end, delta);
        load_channel<K>(dout_in, p, t0, end, dout);
        load_matrix<K>(C_in, p, t0, end, C);
        if constexpr (K::GATE) load_channel<K>(z_in, p, t0, end, z);
    };
    load_tile();
    const int own_end = p.active ? end - p.row : 0;
    int buffer = 0;
    for (int i = 0; i < tiles; ++i, buffer = At::FLOATS - buffer) {
        float* const tile = shared + buffer;
        WP_PRAGMA_UNROLL
        for (int j = 0; j < At::COUNT; ++j) {
            const bool inside = j * K::ROWS < own_end - t0;
            const float step = step_of<K, Delta>(delta[j], delta_bias, inside);
            float dy = K::OUTPUT && inside ? widen<Number>(dout[j]) : 0.0f;
            if constexpr (K::GATE) dy *= widen<Number>(z[j]) * sigmoid(widen<Number>(z[j]));
            float* const at = tile + p.row * K::SPAN + p.c + j * K::ROWS * K::SPAN;
            at[At::STEP] = step;
            at[At::INPUT] = dy;
            decay.steps += step;
        }
        put_matrix<K, K::TOKENS, Matrix>(tile + At::MATRIX, p, C);
        __syncthreads();
        t0 -= K::TOKENS;
        load_tile();
        decay.multiply(tile, p, A);
        advance<K, true>(tile, p, A, dh);
    }
    store_states<K>(dinitial_state_out, p.segment_row, p, dh);
    decay.store(decay_out, p);
}

}  // namespace gamba::scan
