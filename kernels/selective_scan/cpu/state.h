// States of a lane group while its tokens are traversed, and the loop over them.
#include "discretize.h"
#include "task.h"
namespace gamba::scan {

// A slow decay f is so near to 1 that float32 rounds most of 1 - f away. A channel that is slow at
// all tokens of a strip therefore also takes f - 1, which float32 holds to the last bit. ``Plain``
// is one number. ``Slow`` is the same in lanes outside of ``mask``; in those inside it has a base
// and the change since then, which is small, so that a step rounds no more than a last bit of the
// change. In memory a state is two numbers, the second of which is the rounding error of the first:
// otherwise changes by less than a last bit would be lost at the end of every chunk. Outside of the
// mask the base is 0, which leaves the arithmetic of ``Plain``: such a lane has the same bits in
// both.
struct Plain {
    F h;
    Plain() {}
    Plain(F high, F low, I) : h(high + low) {}
    static F saved_of(F f, F, I) { return f; }
    static F decay_of(F m, I) { return m; }
    F value() const { return h; }
    void add(F a, F b) { h = fma(a, b, h); }
    void decay(F m) { h *= m; }
    void step(F f, F, F w) { h = fma(f, h, w); }
    void store(F& high, F& low) const { high = h, low = F{}; }
};
struct Slow {
    F base, change, h;
    I mask;
    Slow() {}
    Slow(F high, F low, I slow)
        : base((F)((I)high & slow)), change(slow ? low : high + low), h(high + low), mask(slow) {}
    // the number to save of a decay: f - 1 where it is slow
    static F saved_of(F f, F fm1, I slow) { return (F)((I)f & ~slow | (I)fm1 & slow); }
    static F decay_of(F m, I slow) { return m + (F)((I)(F{} + 1.0f) & slow); }
    F value() const { return h; }
    void add(F a, F b) { change = fma(a, b, change), h = base + change; }
    void decay(F m) { change = fma(m, h, (F)((I)change & mask)), h = base + change; }
    void step(F f, F fm1, F w) {
        change = fma(f, change, fma(fm1, base, w));
        h = base + change;
    }
    void store(F& high, F& low) const { high = h, low = change - (h - base); }
};
// True if the largest x of the lanes justify ``Slow``; without branches, which would mispredict.
template<class Config>
static inline int worth_slow(F x) {
    return (int)(__builtin_reduce_or(within(x, Config::SLOWEST)) != 0)
        | (int)(__builtin_reduce_or(~within(x, Config::MODERATE)) == 0);
}
template<class Config>
static inline I slow_lanes(F x) {
    return within(x, Config::MODERATE) & -worth_slow<Config>(x);
}

// COUNT states from n on: their A, and the lanes in which they are slow.
template<int COUNT>
struct States {
    static constexpr int K = COUNT;
    int n;
    F A[COUNT];
    I slow[COUNT];
};
// The kind of their computation: with ``State``, and for |x| <= 125 in all lanes or for any x.
template<class StateOf, bool RANGE>
struct Kind {
    typedef StateOf State;
    static constexpr bool IN_RANGE = RANGE;
};
template<class Config, int COUNT, class Visit>
INLINE void visit_states(const Group& group, F max_rate, int n, bool in_range, Visit visit) {
    States<COUNT> at = {n};
    if constexpr (COUNT == 1)
        if (!in_range) {
            at.A[0] = group.A[n];
            return visit(Kind<Plain, false>(), at);
        }
    F least = splat(125.0f);
#pragma unroll
    for (int k = 0; k < COUNT; ++k) {
        at.A[k] = group.A[n + k];
        least = __builtin_elementwise_min(least, abs(max_rate * at.A[k]));
    }
    const bool look = worth_slow<Config>(least);  // false for most strips
    I some = I{};
    for (int k = 0; look && k < COUNT; ++k)
        some |= at.slow[k] = slow_lanes<Config>(max_rate * at.A[k]);
    if (look && __builtin_reduce_or(some)) visit(Kind<Slow, true>(), at);
    else visit(Kind<Plain, true>(), at);
}
// Visits all states, AT_ONCE together if ``several``, so that values that do not depend on them are
// read and written once, unless an exponential needs a clamp. The order of all sums is as for one
// state after the other, to the last bit. ``max_rate`` is the largest |rate| of each lane.
template<class Config, class Visit>
INLINE void each_state(const Group& group, F max_rate, bool several, Visit visit) {
    const bool in_range = gamba::in_range(max_rate * group.max_A);
    for (int n = 0; n < group.states;)
        if (several && in_range && n + Config::AT_ONCE <= group.states) {
            visit_states<Config, Config::AT_ONCE>(group, max_rate, n, in_range, visit);
            n += Config::AT_ONCE;
        } else visit_states<Config, 1>(group, max_rate, n++, in_range, visit);
}

// B or C from entry n on, token by token
struct Column {
    const char* first;
    size_t step;
    const float* row(int t) const { return (const float*)(first + t * step); }
};
static inline Column column_of(const Array<float>& array, const Position& p, int n) {
    return {(const char*)array.data + (size_t)p.b * array.strides[0]
            + (size_t)p.t0 * array.strides[1] + (size_t)p.group * array.strides[2] + (size_t)n * 4,
        (size_t)array.strides[1]};
}

}  // namespace gamba::scan
