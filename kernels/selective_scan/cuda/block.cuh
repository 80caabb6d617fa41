// A block of threads: which channels, states and tokens are a thread's, and its loads and stores.
// A block holds adjacent channels of one group. In the recurrence a thread has CHANNELS times
// STATES of them (an outer product, so that values from shared memory are used more than once), and
// LANES threads share a channel; for loads, stores and values of a channel, a thread has one
// channel and every ROWS-th token, so that a warp touches adjacent addresses.
// K is the struct of a kernel's constants (kernels.py).
#include "../../runtime/scalars.cuh"
#include "discretize.cuh"
namespace gamba::scan {

template<class Number>
using Array = wp::array_t<Number>;

template<int N>
struct alignas(4 * N) Vector {
    float of[N];
};
// N adjacent floats, of which up to four at a time.
template<int N>
static void load(const float* from, float (&to)[N]) {
    constexpr int V = N < 4 ? N : 4;
    WP_PRAGMA_UNROLL
    for (int k = 0; k < N / V; ++k) {
        const auto vector = ((const Vector<V>*)from)[k];
        WP_PRAGMA_UNROLL
        for (int m = 0; m < V; ++m) to[k * V + m] = vector.of[m];
    }
}
template<int N>
static void store(float* to, const float (&from)[N]) {
    constexpr int V = N < 4 ? N : 4;
    WP_PRAGMA_UNROLL
    for (int k = 0; k < N / V; ++k) {
        Vector<V> vector;
        WP_PRAGMA_UNROLL
        for (int m = 0; m < V; ++m) vector.of[m] = from[k * V + m];
        ((Vector<V>*)to)[k] = vector;
    }
}

// Position of a thread in the problem.
struct Position {
    int b, group;
    int part;  // of the group, a block's channels
    int sequence, segment;
    int last;         // segment of the sequence
    int segment_row;  // of arrays [B * segments, ...]
    int saved_row;    // of the saved states, of the first token
    int run;          // row of the gradient's sums, of the first token
    int begin, end;   // tokens
    int lane;         // of the block
    int d0;           // the block's first channel
    int count;        // its channels inside the group
    int d;  // the thread's own channel; threads past the last share that one and are not active
    int c;  // the same channel, counted from d0
    bool active;
    int row;     // the thread's first token of a tile
    int slot;    // the thread's channels in the recurrence, of SLOTS
    int q;       // the thread's states in the recurrence, of LANES
    int states;  // N
};

template<class K, class Sizes>
static Position position(int index, int lane, const Sizes& sizes, const Array<int>& packed_in) {
    Position p;
    p.part = index % sizes.parts;
    int rest = index / sizes.parts;
    p.group = rest % sizes.groups;
    rest = rest / sizes.groups;
    p.segment = rest % sizes.segments;
    p.sequence = rest / sizes.segments;
    p.segment_row = rest;
    if (packed_in.shape[0] > 0) {  // cut as alone; rows as ``packed.slots`` has them
        const int* of = (int*)((char*)packed_in.data + wide(p.sequence, packed_in.strides[0]));
        p.b = of[0];
        const int begin = of[1], end = of[2];
        const int chunks = max((end - begin + K::CHUNK - 1) / K::CHUNK, 1);
        const int segment = (chunks + sizes.segments - 1) / sizes.segments * K::CHUNK;
        p.last = (chunks * K::CHUNK - 1) / segment;
        p.begin = min(begin + p.segment * segment, end);  // after the last: no token
        p.end = min(p.begin + segment, end);
        const int t = p.b * sizes.length;
        p.saved_row = (t + begin) / K::CHUNK + p.sequence + (p.begin - begin) / K::CHUNK;
        p.run = (t + p.begin) / (K::RUN * K::CHUNK) + p.segment_row;
    } else {
        p.last = sizes.segments - 1;
        p.b = p.sequence;
        p.begin = p.segment * sizes.segment;
        p.end = min(p.begin + sizes.segment, sizes.length);
        p.saved_row = p.b * ((sizes.length + K::CHUNK - 1) / K::CHUNK) + p.begin / K::CHUNK;
        p.run = p.segment_row * ((sizes.segment / K::CHUNK + K::RUN - 1) / K::RUN);
    }
    p.lane = lane;
    p.d0 = p.group * sizes.group_width + p.part * K::SPAN;
    p.count = min(K::SPAN, sizes.group_width - p.part * K::SPAN);
    p.c = lane % K::SPAN;
    p.row = lane / K::SPAN;
    p.active = p.c < p.count;
    p.d = p.d0 + min(p.c, p.count - 1);
    p.slot = lane / K::LANES;
    p.q = lane % K::LANES;
    p.states = sizes.states;
    return p;
}

// A thread's states, pass by pass: HELD of each. ``each`` is called with the number of a state, its
// place in row i of [*, D, N], and whether there is such a state.
template<class K, class Each>
static void for_states(const Array<float>& states, int i, const Position& p, Each each) {
    float* const row = states.data + (size_t)i * (states.strides[0] / 4);
    WP_PRAGMA_UNROLL
    for (int k = 0; k < K::OWN; ++k) {
        const int c = p.slot * K::CHANNELS + k % K::HELD / K::STATES;
        const int n = k / K::HELD * K::WIDTH + p.q * K::STATES + k % K::STATES;
        each(k, row + (size_t)(p.d0 + c) * p.states + n, c < p.count && n < p.states);
    }
}
template<class K>
static void load_states(
    const Array<float>& states_in, int i, const Position& p, float (&h)[K::OWN]) {
    for_states<K>(
        states_in, i, p, [&](int k, const float* at, bool inside) { h[k] = inside ? *at : 0.0f; });
}
template<class K>
static void store_states(
    const Array<float>& states_out, int i, const Position& p, const float (&h)[K::OWN]) {
    for_states<K>(states_out, i, p, [&](int k, float* at, bool inside) {
        if (inside) *at = h[k];
    });
}
// A of equation 1; exponentials are computed as powers of two.
template<class K>
static void load_A(const Array<float>& A_in, const Position& p, float (&A)[K::OWN]) {
    load_states<K>(A_in, 0, p, A);
    WP_PRAGMA_UNROLL
    for (int k = 0; k < K::OWN; ++k) A[k] *= K::MODE == BILINEAR ? 1.0f : LOG2E;
}

// A tile in shared memory begins with the operands of the recurrence: δ and δu, or in reverse dy,
// [TOKENS, SPAN] each, then B or C, [TOKENS, PADDED].
template<class K, int TOKENS>
struct Operands {
    static constexpr int STEP = 0, INPUT = TOKENS * K::SPAN, MATRIX = 2 * TOKENS * K::SPAN;
    static constexpr int SIZE = MATRIX + TOKENS * K::PADDED;
    static constexpr int COUNT = TOKENS / K::ROWS;  // a thread's elements of [B, L, D]
    static constexpr int OF_MATRIX = (TOKENS * K::PADDED + K::BLOCK - 1) / K::BLOCK;
};

// The floats of a block's tile of B or C to shared memory.
template<class K, int TOKENS, class Number, int N>
static void put_matrix(float* to, const Position& p, const unsigned (&bits)[N]) {
    constexpr int SIZE = TOKENS * K::PADDED;
    WP_PRAGMA_UNROLL
    for (int i = 0; i < N; ++i)
        if (SIZE % K::BLOCK == 0 || p.lane < SIZE - i * K::BLOCK)
            to[i * K::BLOCK + p.lane] = widen<Number>(bits[i]);
}

}  // namespace gamba::scan
