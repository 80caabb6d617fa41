// The static shape of a block; ``BlockShape`` of blocks.py says what each number is.
constexpr int WIDTH = LANES * STATES, PADDED = WIDTH * WALKS, HELD = CHANNELS * STATES;
constexpr int SLOTS = BLOCK / LANES, SPAN = SLOTS * CHANNELS, ROWS = BLOCK / SPAN;
constexpr int PAD = LANES > 1 ? 32 / LANES : 0;

auto load_ = [](const float* from, auto& to) {
    constexpr int N = sizeof(to) / sizeof(float), V = N < 4 ? N : 4;
    struct alignas(4 * V) Vector {
        float v[V];
    };
    WP_PRAGMA_UNROLL
    for (int k = 0; k < N / V; ++k) {
        const Vector v = ((const Vector*)from)[k];
        WP_PRAGMA_UNROLL
        for (int m = 0; m < V; ++m) to[k * V + m] = v.v[m];
    }
};
auto store_ = [](float* to, const auto& from) {
    constexpr int N = sizeof(from) / sizeof(float), V = N < 4 ? N : 4;
    struct alignas(4 * V) Vector {
        float v[V];
    };
    WP_PRAGMA_UNROLL
    for (int k = 0; k < N / V; ++k) {
        Vector v;
        WP_PRAGMA_UNROLL
        for (int m = 0; m < V; ++m) v.v[m] = from[k * V + m];
        ((Vector*)to)[k] = v;
    }
};
