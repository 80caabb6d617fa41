// States while they are walked, and the loop over them.
#include "../discretize.h"

// f of a slow decay is so near to 1 that float32 rounds most of what it says away. So a channel
// that is slow for all tokens of a walk takes f - 1 as well, which float32 holds to its last bit.
// ``Plain`` is one number. ``Slow`` has lanes like it, and in those of ``quiet`` a base and the
// change since then, which is small, so that a step rounds away no more than a last bit of the
// change. In memory a state is two numbers, the second of which is what the first has rounded away:
// otherwise changes by less than a last bit would be lost at the end of every chunk. The base of a
// lane that is not slow is 0, which leaves the arithmetic of ``Plain``: such a lane has the same
// bits in both.
struct Plain {
    F h;
    Plain() {}
    Plain(F high, F low, I) : h(high + low) {}
    static F one_of(F f, F, I) { return f; }
    static F decay_of(F m, I) { return m; }
    F value() const { return h; }
    void add(F a, F b) { h = __builtin_elementwise_fma(a, b, h); }
    void decay(F m) { h *= m; }
    void step(F f, F, F w) { h = __builtin_elementwise_fma(f, h, w); }
    void keep(F& high, F& low) const { high = h, low = F{}; }
};
struct Slow {
    F base, change, h;
    I quiet;
    Slow() {}
    Slow(F high, F low, I slow)
        : base((F)((I)high & slow)), change(slow ? low : high + low), h(high + low), quiet(slow) {}
    // what is kept of a decay: its rise where it is slow
    static F one_of(F f, F rise, I slow) { return (F)((I)f & ~slow | (I)rise & slow); }
    static F decay_of(F m, I slow) { return m + (F)((I)(F{} + 1.0f) & slow); }
    F value() const { return h; }
    void add(F a, F b) { change = __builtin_elementwise_fma(a, b, change), h = base + change; }
    void decay(F m) {
        change = __builtin_elementwise_fma(m, h, (F)((I)change & quiet)), h = base + change;
    }
    void step(F f, F rise, F w) {
        change = __builtin_elementwise_fma(f, change, __builtin_elementwise_fma(rise, base, w));
        h = base + change;
    }
    void keep(F& high, F& low) const { high = h, low = change - (h - base); }
};
// Whether largest x of each lane are worth a slow walk; without branches, which would be guessed.
auto worth_ = [&](F x) -> int {
    return (int)(__builtin_reduce_or(within_(x, SLOWEST)) != 0)
        | (int)(__builtin_reduce_or(~within_(x, MODERATE)) == 0);
};
auto quiet_ = [&](F x) -> I { return within_(x, MODERATE) & -worth_(x); };  // the slow lanes

// B or C from entry n on, token by token
struct Column {
    const char* at;
    const size_t step;
    const float* row(int t) const { return (const float*)(at + t * step); }
};
auto column_ = [&](auto& array, int n) -> Column {
    return {(const char*)array.data + (size_t)p.b * array.strides[0]
            + (size_t)p.t0 * array.strides[1] + (size_t)p.group * array.strides[2] + (size_t)n * 4,
        (size_t)array.strides[1]};
};

// Several states from n on, or one: their A, and the lanes in which they are slow.
struct Several {
    int n;
    F a[AT_ONCE];
    I quiet[AT_ONCE];
};
struct One {
    int n;
    F a[1];
    I quiet[1];
};
// Walks all states: several at once, so that what does not depend on them is read and written once,
// where that is asked for and none of their exponentials needs a clamp. The order of all sums is
// that of state by state, to the last bit. ``walk`` gets the kind of state, the range of x, and
// them.
auto visit_ = [&](bool several, auto walk) __attribute__((always_inline)) {
    auto visit = [&](auto at) __attribute__((always_inline)) {
        constexpr int K = sizeof(at.a) / sizeof(F);
        if constexpr (K == 1)
            if (!tame) {
                at.a[0] = channel[at.n];
                return walk(Plain(), Wild(), at);
            }
        F least = splat(125.0f);
#pragma unroll
        for (int k = 0; k < K; ++k) {
            at.a[k] = channel[at.n + k];
            least = __builtin_elementwise_min(least, __builtin_elementwise_abs(top * at.a[k]));
        }
        const bool look = worth_(least);  // if no state is worth it, this is all that is looked at
        I any = I{};
        for (int k = 0; look && k < K; ++k) any |= at.quiet[k] = quiet_(top * at.a[k]);
        if (look && __builtin_reduce_or(any)) walk(Slow(), Tame(), at);
        else walk(Plain(), Tame(), at);
    };
    for (int n = 0; n < states;)
        if (several && tame && n + AT_ONCE <= states) {
            visit(Several{n});
            n += AT_ONCE;
        } else visit(One{n++});
    while (fetched < asked) {
        Fetch fetch = fetch_();
        for (int t = 0; t < count; ++t) fetch.next();
    }
};
