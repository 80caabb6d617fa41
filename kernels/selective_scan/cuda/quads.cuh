// The gradient's tiles: a thread's elements are adjacent tokens of its channel, and in shared
// memory four of them are one vector, which a thread loads and stores at once.
#include "block.cuh"
namespace gamba::scan {

// Tokens of a vector, [token / QUAD, channel, QUAD]; the state before each is kept.
constexpr int QUAD = 4;
constexpr int RECOMPUTED = 16;  // tokens of a tile whose states are recomputed

// A tile in shared memory: after the operands dy, C, sums over a lane's states for each channel
// ([LANES, token / QUAD, channel of a slot, slot, QUAD]), and the products for dB and dC.
template<class K>
struct BackTile : Operands<K, K::TOKENS> {
    static constexpr int SLOT_STEP = K::SLOTS + 8 / K::CHANNELS;  // against bank conflicts
    static constexpr int LANE = K::TOKENS * K::CHANNELS * SLOT_STEP + (K::LANES > 1 ? 8 : 0);
    static constexpr int SUMS = K::LANES * LANE;
    static constexpr int TOKEN = (K::SLOTS + 1) * K::WIDTH;  // of products: half the banks
    static constexpr int PRODUCTS = K::TOKENS * TOKEN;
    static constexpr int DY = Operands<K, K::TOKENS>::SIZE;
    static constexpr int C = DY + K::OUTPUT * K::TOKENS * K::SPAN;
    static constexpr int Y = C + K::OUTPUT * K::TOKENS * K::PADDED;
    static constexpr int S = Y + K::NEED_DZ * SUMS;  // of equation 9, then Σ A q of equation 11
    static constexpr int AQ = S + K::NEED_DH * SUMS;
    static constexpr int DB = AQ + K::NEED_DH * SUMS;
    static constexpr int DC = DB + K::NEED_DB * PRODUCTS;
    static constexpr int FLOATS = DC + K::NEED_DC * PRODUCTS;
    static constexpr int RECOMPUTING = 2 * Operands<K, RECOMPUTED>::SIZE;
    static_assert((FLOATS > RECOMPUTING ? FLOATS : RECOMPUTING) == K::SHARED,
        "kernels.py computes the size of shared memory");
    // sums for dB and dC that a thread takes at a time
    static constexpr int EVERY = (K::NEED_DB + K::NEED_DC) * K::TOKENS * K::WIDTH;
    static constexpr int TAKEN = K::WIDTH % 4 == 0 && EVERY / 4 >= K::BLOCK ? 4
        : K::WIDTH % 2 == 0 && EVERY / 2 >= K::BLOCK                        ? 2
                                                                            : 1;
};

// A thread's elements of a tile: ADJACENT tokens of its channel, from every ROWS-th.
template<class K>
constexpr int ADJACENT = K::TOKENS / K::ROWS < QUAD ? K::TOKENS / K::ROWS : QUAD;
// The token of element i, after the thread's first.
template<class K>
static constexpr int token_of(int i) {
    return i / ADJACENT<K> * K::ROWS * ADJACENT<K> + i % ADJACENT<K>;
}

// Memory of a thread: the states before each quad of a chunk, and of its own tokens δ and the slope
// of softplus. Up to 1 KB per channel: too much for registers, and left to the cache where shared
// memory would limit the number of blocks.
template<class K>
struct Memory {
    static constexpr int STEPS = K::CHUNK / QUAD * K::OWN, SLOPES = STEPS + K::CHUNK / K::ROWS;
    static constexpr int FLOATS = SLOPES + K::CHUNK / K::ROWS;
    static int state(int pass, int quad) { return (pass * (K::CHUNK / QUAD) + quad) * K::HELD; }
};

// An address as one number that the compiler cannot take apart: it would otherwise recompute it at
// each access, from the tensor's address and two strides.
static inline unsigned long long origin(const void* at, long long offset) {
    unsigned long long r;
    asm("add.s64 %0, %1, %2;" : "=l"(r) : "l"(at), "l"(offset));
    return r;
}
template<class Number>
static Number* in_tensor(unsigned long long from, long long offset) {
    char* const at = (char*)from;
    __builtin_assume(__isGlobal(at));
    return (Number*)(at + offset);
}

// The thread's channel of a tensor [B, L, D].
template<class Number>
struct Channel {
    const Array<Number>& x;
    unsigned long long from;
    Channel(const Array<Number>& x, const Position& p)
        : x(x), from(origin(x.data + p.d, wide(p.b, x.strides[0]))) {}
    // The bits of the thread's elements from its token t on. In place of tokens after ``last`` that
    // one is loaded: this costs less than conditions, and the results are masked.
    template<class K, int N>
    void load(int t, int last, unsigned (&bits)[N]) const {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < N; ++i) {
            const int token = t + token_of<K>(i);
            const long long offset = wide(token < last ? token : last, x.strides[1]);
            bits[i] = bits_of(in_tensor<const Number>(from, offset));
        }
    }
    void store(int t, bool inside, float value) const {
        Number* const at = in_tensor<Number>(from, wide(t, x.strides[1]));
        const Number rounded = (Number)value;
        if (inside) *at = rounded;
    }
};

// The group's B or C, [B, L, G, N]; states past the last are 0.
template<class Number>
struct Matrix {
    const Array<Number>& x;
    unsigned long long from;
    Matrix(const Array<Number>& x, const Position& p)
        : x(x), from(origin((char*)x.data + wide(p.group, x.strides[2]), wide(p.b, x.strides[0]))) {
    }
    template<class K, int TOKENS, int N>
    void load(const Position& p, int t0, int last, unsigned (&bits)[N]) const {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < N; ++i) {
            const int e = K::BLOCK * i + p.lane, n = e % K::PADDED;
            int t = t0 + e / K::PADDED;
            t = t < last ? t : last;
            const long long offset = wide(n, x.strides[3]) + wide(t, x.strides[1]);
            bits[i] = 0;
            if (n < p.states && e < TOKENS * K::PADDED)
                bits[i] = bits_of(in_tensor<const Number>(from, offset));
        }
    }
};

// The tensors as a thread reads and writes them.
template<class Number, class Delta, class Of>
struct Tensors {
    Channel<Number> u, z, dout, du, dz;
    Channel<Delta> delta, ddelta;
    Matrix<Of> B, C;
    float D, delta_bias;
    const Array<float>&dB_out, &dC_out;
};

// A thread's quad k of a tile in shared memory, with ``step`` floats between two quads.
template<class K>
static int quad_of(const Position& p, int k, int step) {
    return (k * K::ROWS + p.row) * ADJACENT<K> / QUAD * step + p.row * ADJACENT<K> % QUAD;
}
template<class K, int N>
static void put_quads(float* to, const Position& p, const float (&x)[N]) {
    WP_PRAGMA_UNROLL
    for (int k = 0; k < N / ADJACENT<K>; ++k) {
        float v[ADJACENT<K>];
        WP_PRAGMA_UNROLL
        for (int m = 0; m < ADJACENT<K>; ++m) v[m] = x[k * ADJACENT<K> + m];
        store(to + quad_of<K>(p, k, QUAD * K::SPAN) + p.c * QUAD, v);
    }
}
template<class K, int N>
static void get_quads(const float* from, const Position& p, float (&x)[N]) {
    WP_PRAGMA_UNROLL
    for (int k = 0; k < N / ADJACENT<K>; ++k) {
        float v[ADJACENT<K>];
        load(from + quad_of<K>(p, k, QUAD * K::SPAN) + p.c * QUAD, v);
        WP_PRAGMA_UNROLL
        for (int m = 0; m < ADJACENT<K>; ++m) x[k * ADJACENT<K> + m] = v[m];
    }
}
// The lanes' sums, added.
template<class K, int N>
static void sum_lanes(const float* sums, const Position& p, float (&x)[N]) {
    constexpr int STEP = BackTile<K>::SLOT_STEP;
    WP_PRAGMA_UNROLL
    for (int k = 0; k < N / ADJACENT<K>; ++k) {
        const float* from = sums + quad_of<K>(p, k, QUAD * K::CHANNELS * STEP);
        from += (p.c % K::CHANNELS * STEP + p.c / K::CHANNELS) * QUAD;
        WP_PRAGMA_UNROLL
        for (int q = 0; q < K::LANES; ++q) {
            float v[ADJACENT<K>];
            load(from + q * BackTile<K>::LANE, v);
            WP_PRAGMA_UNROLL
            for (int m = 0; m < ADJACENT<K>; ++m) {
                float& sum = x[k * ADJACENT<K> + m];
                sum = q > 0 ? sum + v[m] : v[m];
            }
        }
    }
}

}  // namespace gamba::scan
