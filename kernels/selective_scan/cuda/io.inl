// needs: blocks.py: READ_STATES, WRITE_STATES, WALKS, HELD, states, p, CHANNELS, STATES, WIDTH,
//     LOAD_CHANNEL, x_in, COUNT, ROWS, left, LOAD_MATRIX, BLOCK, PADDED, TOKENS, t0, STORE_CHANNEL,
//     x_out, d, b, FROM, ADJACENT, last, inside, PUT, GET, arena, SPAN, STEP, LANES, i; scalars.py:
//     ELEMENT, wide_, WORD; groups.py: ORIGIN, FETCH_CHANNEL, origin, FETCH_MATRIX,
//     STORE_FROM_ORIGIN, SUM_LANES, LANE_STRIDE
// gives: load_, store_; the body of the function that a macro chooses
// Access to memory: vectors of adjacent floats in shared memory, and the bodies of the functions of
// blocks.py and groups.py, of which a macro of the function's name chooses one.
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

#if READ_STATES || WRITE_STATES  // (states, i, p, h)
// A thread's states of a row of [*, D, N], walk by walk; those past the last are 0.
#if READ_STATES
wp::vec_t<WALKS * HELD, float> h;
#endif
float* row = states.data + (size_t)i * (states.strides[0] / 4);
WP_PRAGMA_UNROLL
for (int k = 0; k < WALKS * HELD; ++k) {
    const int c = p.slot * CHANNELS + k % HELD / STATES;
    const int n = k / HELD * WIDTH + p.q * STATES + k % STATES;
    float* at = row + (size_t)(p.d0 + c) * p.states + n;
#if READ_STATES
    h.c[k] = c < p.count && n < p.states ? *at : 0.0f;
#else
    if (c < p.count && n < p.states) *at = h.c[k];
#endif
}
#if READ_STATES
return h;
#endif

#elif LOAD_CHANNEL  // (x_in, p, t, left)
// The bits of a thread's elements of a tile of [B, L, D], every ROWS-th token of its channel; 0
// from ``left`` on. Bits: loads are in flight while the tile before is processed, and converting
// would wait for them.
const char* at = (char*)((ELEMENT*)x_in.data + p.d) + wide_(p.b, x_in.strides[0]);
at += wide_(t, x_in.strides[1]);
wp::vec_t<COUNT, unsigned> r;
const long long step = wide_(ROWS, x_in.strides[1]);
WP_PRAGMA_UNROLL
for (int i = 0; i < COUNT; ++i, at += step) {
    r.c[i] = 0;
    if (ROWS * i < left) r.c[i] = *(const WORD*)at;
}
return r;

#elif LOAD_MATRIX  // (x_in, p, t0, left)
// As LOAD_CHANNEL for a block's tile of B or C, [B, L, G, N].
const char* from = (const char*)x_in.data + wide_(p.b, x_in.strides[0]);
from += wide_(p.group, x_in.strides[2]);
wp::vec_t<COUNT, unsigned> r;
WP_PRAGMA_UNROLL
for (int i = 0; i < COUNT; ++i) {
    const int e = BLOCK * i + p.lane, t = e / PADDED, n = e % PADDED;
    r.c[i] = 0;
    if (t < left && n < p.states && e < TOKENS * PADDED)
        r.c[i] = *(const WORD*)(from + wide_(n, x_in.strides[3]) + wide_(t0 + t, x_in.strides[1]));
}
return r;

#elif STORE_CHANNEL  // (x_out, b, d, t, v)
// One element of a tensor [B, L, D].
char* at = (char*)((ELEMENT*)x_out.data + d) + wide_(b, x_out.strides[0]);
at += wide_(t, x_out.strides[1]);
*(ELEMENT*)at = (ELEMENT)v;

#elif ORIGIN  // (x_in, b, d) or (x_in, b, g)
// An address in device memory as one number: the compiler would otherwise recompute it at each
// access, from the tensor's address and two strides.
const char* at = (const char*)FROM;
unsigned long long r;
asm("add.s64 %0, %1, %2;" : "=l"(r) : "l"(at), "l"(wide_(b, x_in.strides[0])));
return r;

#elif FETCH_CHANNEL  // (x_in, origin, t, last)
// As LOAD_CHANNEL for the gradient, ADJACENT tokens at a time, from an origin. In place of
// tokens after ``last`` that one is loaded: this costs less than conditions, and the results are
// masked.
const char* at = (const char*)origin;
__builtin_assume(__isGlobal(at));
wp::vec_t<COUNT, unsigned> r;
WP_PRAGMA_UNROLL
for (int i = 0; i < COUNT; ++i) {
    const int token = t + (i / ADJACENT * ROWS * ADJACENT + i % ADJACENT);
    r.c[i] = *(const WORD*)(at + wide_(token < last ? token : last, x_in.strides[1]));
}
return r;

#elif FETCH_MATRIX  // (x_in, origin, p, t0, last)
// As LOAD_MATRIX for the gradient, from an origin.
const char* at = (const char*)origin;
__builtin_assume(__isGlobal(at));
wp::vec_t<COUNT, unsigned> r;
WP_PRAGMA_UNROLL
for (int i = 0; i < COUNT; ++i) {
    const int e = BLOCK * i + p.lane, n = e % PADDED;
    int t = t0 + e / PADDED;
    t = t < last ? t : last;
    const char* from = at + wide_(n, x_in.strides[3]);
    if (n < p.states && e < TOKENS * PADDED)
        r.c[i] = *(const WORD*)(from + wide_(t, x_in.strides[1]));
}
return r;

#elif STORE_FROM_ORIGIN  // (x_out, origin, t, inside, v)
// One element of a tensor [B, L, D] from its channel's origin.
char* at = (char*)origin;
__builtin_assume(__isGlobal(at));
at += wide_(t, x_out.strides[1]);
const ELEMENT rounded = (ELEMENT)v;
if (inside) *(ELEMENT*)at = rounded;

#elif KEEP  // (own, at, x)
// A thread's elements of a tile in its own memory.
float v[COUNT];
WP_PRAGMA_UNROLL
for (int k = 0; k < COUNT; ++k) v[k] = x.c[k];
store_((float*)own + at, v);

#elif KEPT  // (own, at)
float v[COUNT];
load_((const float*)own + at, v);
wp::vec_t<COUNT, float> x;
WP_PRAGMA_UNROLL
for (int k = 0; k < COUNT; ++k) x.c[k] = v[k];
return x;

#elif PUT || GET || SUM_LANES  // (arena, base, p, x)
// A thread's elements of a tile in shared memory, ADJACENT tokens at a time, with ``jump`` floats
// between four tokens.
auto group_ = [&](int k, int jump) -> float* {
    return arena.data.ptr + base + ((k * ROWS + p.row) * ADJACENT) / 4 * jump
        + p.row * ADJACENT % 4;
};
float v[ADJACENT];
#if PUT
WP_PRAGMA_UNROLL
for (int k = 0; k < COUNT / ADJACENT; ++k) {
    WP_PRAGMA_UNROLL
    for (int m = 0; m < ADJACENT; ++m) v[m] = x.c[k * ADJACENT + m];
    store_(group_(k, 4 * SPAN) + p.c * 4, v);
}
#elif GET
wp::vec_t<COUNT, float> x;
WP_PRAGMA_UNROLL
for (int k = 0; k < COUNT / ADJACENT; ++k) {
    load_(group_(k, 4 * SPAN) + p.c * 4, v);
    WP_PRAGMA_UNROLL
    for (int m = 0; m < ADJACENT; ++m) x.c[k * ADJACENT + m] = v[m];
}
return x;
#else
// The lanes' sums, in the layout ``[token / 4, channel of a slot, slot, 4]``.
wp::vec_t<COUNT, float> x;
WP_PRAGMA_UNROLL
for (int k = 0; k < COUNT / ADJACENT; ++k) {
    const float* from =
        group_(k, 4 * CHANNELS * STEP) + (p.c % CHANNELS * STEP + p.c / CHANNELS) * 4;
    WP_PRAGMA_UNROLL
    for (int q = 0; q < LANES; ++q) {
        load_(from + q * LANE_STRIDE, v);
        WP_PRAGMA_UNROLL
        for (int m = 0; m < ADJACENT; ++m)
            x.c[k * ADJACENT + m] = q > 0 ? x.c[k * ADJACENT + m] + v[m] : v[m];
    }
}
return x;
#endif
#endif
