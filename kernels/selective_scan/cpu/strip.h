// needs: kernels.py: GRADIENT, TOKENS, AT_ONCE, TRANSPOSED, SLOWEST, MODERATE; lanes.h: rows_,
//     gather_, in_range_, max_abs_; sixteen.inl: F, I, splat; problem.py: WEIGHTED; task.h: Position,
//     fill_
// gives: Token, PerToken, Saved, Group, load_group_, here_, lanes_, Fetch, Fetches, lines_,
//     read_soon_, write_soon_, Plain, Slow, worth_slow_, slow_lanes_, Column, column_, Several,
//     One, visit_
// A strip: TOKENS tokens of a lane group, or fewer at the end. Its memory, its rows, and the loop
// over the states.
// The values of a token are adjacent, because arrays of 4 KiB would evict one another from the
// cache; values that the states do not need are separate. A rate is δ times SCALE.
#if GRADIENT
struct Token {
    F rate, du, dy, y, s, p;
};
struct PerToken {
    F u, slope, gate;
};
// Of a token and state: f or f - 1, the state before, and g where it is slow to compute again.
struct Saved {
    F m, h;
#if WEIGHTED
    F g;
#endif
};
#else
struct Token {
    F rate, du, y, gate;
};
#endif
// A lane group: N rates A, the largest |A|, D and the bias, which follow one another in memory.
struct Group {
    const F* a;
    int states;
    F max_a, skip, bias;
    Group(const F* a, int states)
        : a(a), states(states), max_a(a[states]), skip(a[states + 1]), bias(a[states + 2]) {}
};
// Loads them; arrays without elements are zeros.
auto load_group_ = [&](const auto& rates, const auto& skips, const auto& biases, const Position& p,
                       F* a) {
    const int states = rates.shape[1];
    fill_(a, states + 3, 0.0f);
    for (int i = 0; i < p.width; ++i)
        for (int n = 0; n < states; ++n)
            ((float*)(a + n))[i] = rates.data[(size_t)(p.d + i) * states + n];
    for (int n = 0; n < states; ++n) a[states] = max_abs_(a[states], a[n]);
    for (int i = 0; i < p.width; ++i) {
        if (skips.shape[0] > 0) ((float*)(a + states + 1))[i] = skips.data[p.d + i];
        if (biases.shape[0] > 0) ((float*)(a + states + 2))[i] = biases.data[p.d + i];
    }
};

// The rows of a strip in their own layout.
auto here_ = [&](auto& array, const Position& p, int width)
                 __attribute__((always_inline)) { return rows_(array, p.b, p.t0, p.d, width); };
// The same to be read, a token's lanes together: transposed rows are first copied to a field of the
// tokens, unless they are not ``used``.
auto lanes_ = [&](auto& array, const Position& p, int width, F& field, bool used = true) {
    const auto rows = here_(array, p, width);
    if constexpr (TRANSPOSED) return gather_(rows, 0, used ? p.count : 0, &field, sizeof(Token));
    else return rows;
};

// A row's cache lines are adjacent, but a lane group reads one line of each row. So the rows of the
// next strip are prefetched in their order, each lane group its share, while the states are walked:
// those loops leave the memory idle. The lines that this lane group will write are prefetched too.
struct Fetch {
    const char* at;
    int64_t step, jump;
    int line, lines;
    void next() {
        __builtin_prefetch(at);
        const bool last = ++line == lines;
        at += last ? jump : step;
        line = last ? 0 : line;
    }
};
struct Fetches {
    Fetch all[8];
    int asked = 0, fetched = 0;
    Fetch next() {  // or one that repeats a line
        if (fetched < asked) return all[fetched++];
        return {(const char*)this, 0, 0, 0, 1};
    }
    void rest(int count) {
        while (fetched < asked) {
            Fetch fetch = next();
            for (int t = 0; t < count; ++t) fetch.next();
        }
    }
};
// In transposed rows a channel's lines are adjacent. A strip may begin or end within one; the strip
// before has fetched that, so they are met at their ends, or in the gradient at their begins.
auto lines_ = [](const auto& rows, int64_t ahead) -> Fetch {
    const int lines = TOKENS * sizeof(*rows.first) / 64;
    const int64_t jump = (int64_t)rows.across - (lines - 1) * 64;
    return {(const char*)rows.first + ahead + (GRADIENT ? 0 : 63), 64, jump, 0, lines};
};
auto read_soon_ = [&](Fetches& fetches, auto& array, const Position& p) {
    const int next = GRADIENT ? -TOKENS : TOKENS;
    const bool more = p.t0 + next >= 0 && p.t0 + next < array.shape[1];
    const auto rows = here_(array, p, 16);
    const int64_t step = rows.step, bytes = 16 * sizeof(*rows.first);
    Fetch& fetch = fetches.all[fetches.asked++];
    if (TRANSPOSED && rows.transposed()) {
        fetch = lines_(rows, more ? next * step : 0);
        return;
    }
    const int row = p.j * p.count / p.blocks, line = p.j * p.count % p.blocks;
    fetch = {(const char*)rows.first + (more ? (next + row) * step : 0) + (line - p.j) * bytes,
        bytes, (more ? step : 0) - (p.blocks - 1) * bytes, line, p.blocks};
};
auto write_soon_ = [&](Fetches& fetches, auto& array, const Position& p, bool stream) {
    if (array.shape[1] == 0 || stream) return;
    const auto rows = here_(array, p, 16);
    const int64_t step = rows.step;
    fetches.all[fetches.asked++] = TRANSPOSED && rows.transposed()
        ? lines_(rows, 0)
        : Fetch{(const char*)rows.first, step, step, 0, 1};
};

#include "../discretize.h"

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
    void add(F a, F b) { h = __builtin_elementwise_fma(a, b, h); }
    void decay(F m) { h *= m; }
    void step(F f, F, F w) { h = __builtin_elementwise_fma(f, h, w); }
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
    void add(F a, F b) { change = __builtin_elementwise_fma(a, b, change), h = base + change; }
    void decay(F m) {
        change = __builtin_elementwise_fma(m, h, (F)((I)change & mask)), h = base + change;
    }
    void step(F f, F fm1, F w) {
        change = __builtin_elementwise_fma(f, change, __builtin_elementwise_fma(fm1, base, w));
        h = base + change;
    }
    void store(F& high, F& low) const { high = h, low = change - (h - base); }
};
// True if the largest x of the lanes justify ``Slow``; without branches, which would mispredict.
auto worth_slow_ = [&](F x) -> int {
    return (int)(__builtin_reduce_or(within_(x, SLOWEST)) != 0)
        | (int)(__builtin_reduce_or(~within_(x, MODERATE)) == 0);
};
auto slow_lanes_ = [&](F x) -> I { return within_(x, MODERATE) & -worth_slow_(x); };

// B or C from entry n on, token by token
struct Column {
    const char* at;
    const size_t step;
    const float* row(int t) const { return (const float*)(at + t * step); }
};
auto column_ = [](const auto& array, const Position& p, int n) -> Column {
    return {(const char*)array.data + (size_t)p.b * array.strides[0]
            + (size_t)p.t0 * array.strides[1] + (size_t)p.group * array.strides[2] + (size_t)n * 4,
        (size_t)array.strides[1]};
};

// Several states from n on, or one: their A, and the lanes in which they are slow.
struct Several {
    int n;
    F a[AT_ONCE];
    I slow[AT_ONCE];
};
struct One {
    int n;
    F a[1];
    I slow[1];
};
// Walks all states: ``several`` at once, so that values that do not depend on them are read and
// written once, unless an exponential needs a clamp. The order of all sums is as for one state
// after the other, to the last bit. ``walk`` gets the kind of state, the range of x, and the
// states; ``max_rate`` is the largest |rate| of each lane.
auto visit_ = [&](const Group& group, F max_rate, bool several,
                  auto walk) __attribute__((always_inline)) {
    const bool in_range = in_range_(max_rate * group.max_a);
    auto visit = [&](auto at) __attribute__((always_inline)) {
        constexpr int K = sizeof(at.a) / sizeof(F);
        if constexpr (K == 1)
            if (!in_range) {
                at.a[0] = group.a[at.n];
                return walk(Plain(), AnyRange(), at);
            }
        F least = splat(125.0f);
#pragma unroll
        for (int k = 0; k < K; ++k) {
            at.a[k] = group.a[at.n + k];
            least = __builtin_elementwise_min(least, __builtin_elementwise_abs(max_rate * at.a[k]));
        }
        const bool look = worth_slow_(least);  // false for most strips
        I any = I{};
        for (int k = 0; look && k < K; ++k) any |= at.slow[k] = slow_lanes_(max_rate * at.a[k]);
        if (look && __builtin_reduce_or(any)) walk(Slow(), InRange(), at);
        else walk(Plain(), InRange(), at);
    };
    for (int n = 0; n < group.states;)
        if (several && in_range && n + AT_ONCE <= group.states) {
            visit(Several{n});
            n += AT_ONCE;
        } else visit(One{n++});
};
