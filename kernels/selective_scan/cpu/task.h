// A task of the scan on a CPU: a segment of the tokens of one sequence, and lane groups (sixteen
// channels) of one channel group. Tasks that follow one another have the same lane groups and
// adjacent tokens, also in the backward order: the rows that one prefetches beyond its tokens
// belong to the next. Config is from kernels.py.
#include "../../runtime/denormals.h"
#include "../../runtime/lanes.h"
namespace gamba::scan {

template<class T>
using Array = wp::array_t<T>;

struct Position {
    int b, row, group;  // ``row``: of the segment, which are ordered by number, then sequence
    int begin, end;     // tokens
    int chunk;          // row of arrays by chunks, of the segment's first
    int first, blocks;  // first lane group, and how many
    int part;           // row of the partial sums of dB and dC
    // then of a lane group and TOKENS tokens, or fewer at the end
    int t0, count;
    int j, k;      // lane group of the task, and of all
    int d, width;  // channels
};

// ``in.ranges``: of packed rows, for each segment its b, begin, end and chunk; or none
template<class Config, class In>
static inline Position position_of(const In& in, int task, bool backwards) {
    constexpr int BLOCKS = Config::BLOCKS, CHUNK = Config::CHUNK;
    const auto& sizes = in.sizes;
    const int spans = (sizes.group_blocks + sizes.span - 1) / sizes.span;
    const int parts = (sizes.group_blocks + BLOCKS - 1) / BLOCKS;
    const int rows = sizes.segments * sizes.batch, part = task / rows;
    const int row = backwards ? rows - 1 - task % rows : task % rows;
    Position p = {};
    p.first = part % spans * sizes.span, p.group = part / spans;
    p.row = row;
    if (in.ranges.shape[0] > 0) {
        const int* const own = in.ranges.data + (size_t)row * 4;
        p.b = own[0], p.begin = own[1], p.end = own[2], p.chunk = own[3];
    } else {
        p.b = row % sizes.batch, p.begin = row / sizes.batch * sizes.segment;
        p.end = p.begin + sizes.segment < sizes.length ? p.begin + sizes.segment : sizes.length;
        p.chunk = p.b * ((sizes.length + CHUNK - 1) / CHUNK) + p.begin / CHUNK;
    }
    p.part = (p.b * sizes.groups + p.group) * parts + p.first / BLOCKS;
    const int left = sizes.group_blocks - p.first;
    p.blocks = sizes.span < left ? sizes.span : left;
    return p;
}

// the part of a dense array of lanes at these first indices
template<class T, class... Indices>
static inline F* at(const Array<T>& array, Indices... indices) {
    size_t at = 0;
    int dim = 0;
    ((at = at * array.shape[dim++] + indices), ...);
    for (; dim < array.ndim; ++dim) at *= array.shape[dim];
    return (F*)array.data + at;
}

static inline void fill(F* values, int states, float value) {
    for (int n = 0; n < states; ++n) values[n] = splat(value);
}

// States, gradients of states and products of decays are in the caller's order, [rows, D, N]; an
// array without rows is zeros, or not needed. While a task traverses its tokens they are lanes in
// the workspace of the launch's piece: pairs, N values, then the rounding error of each (state.h).
static inline float* states_of(const Array<float>& array, const Position& p) {
    return array.data + ((size_t)p.row * array.shape[1] + p.d) * array.shape[2];
}
static inline void fill_pairs(F* pairs, int states, float value) {
    fill(pairs, states, value), fill(pairs + states, states, 0.0f);
}
static inline void load_pairs(const Array<float>& array, const Position& p, int states, F* pairs) {
    fill_pairs(pairs, states, 0.0f);
    if (array.shape[0] == 0) return;
    const float* const from = states_of(array, p);
    for (int n = 0; n < states; ++n)
        for (int i = 0; i < p.width; ++i) ((float*)(pairs + n))[i] = from[i * states + n];
}
static inline void store_states(const Array<float>& array, const Position& p, const F* values) {
    if (array.shape[0] == 0) return;
    float* const to = states_of(array, p);
    const int states = array.shape[2];
    for (int i = 0; i < p.width; ++i)
        for (int n = 0; n < states; ++n) to[i * states + n] = ((const float*)(values + n))[i];
}

// The row of a workspace that has one for each piece of the launch.
template<class T, class Sizes>
static inline F* workspace(const Array<T>& array, const Sizes& sizes, int task) {
    const long long tasks = (long long)sizes.segments * sizes.batch * sizes.groups
        * ((sizes.group_blocks + sizes.span - 1) / sizes.span);
    return at(array, (int)(((task + 1ll) * array.shape[0] - 1) / tasks));
}

// A lane group: N rates A, the largest |A|, D and delta_bias, which follow one another in memory.
struct Group {
    const F* A;
    int states;
    F max_A, D, delta_bias;
    static constexpr int MORE = 3;  // values beside the rates
    Group(const F* A, int states)
        : A(A), states(states), max_A(A[states]), D(A[states + 1]), delta_bias(A[states + 2]) {}
};
// Loads them to ``A``; arrays without elements are zeros.
template<class In>
static inline void load_group(const In& in, const Position& p, F* A) {
    const int states = in.A.shape[1];
    fill(A, states + Group::MORE, 0.0f);
    for (int i = 0; i < p.width; ++i)
        for (int n = 0; n < states; ++n)
            ((float*)(A + n))[i] = in.A.data[(size_t)(p.d + i) * states + n];
    for (int n = 0; n < states; ++n) A[states] = max_abs(A[states], A[n]);
    for (int i = 0; i < p.width; ++i) {
        if (in.D.shape[0] > 0) ((float*)(A + states + 1))[i] = in.D.data[p.d + i];
        if (in.delta_bias.shape[0] > 0) ((float*)(A + states + 2))[i] = in.delta_bias.data[p.d + i];
    }
}

// Calls ``traverse`` with the lane groups of every TOKENS tokens, in the tokens' order or
// backwards; before it ``enter``, and after it ``leave`` with each lane group.
template<class Config, class Sizes, class Enter, class Traverse, class Leave>
INLINE void each_strip(
    const Sizes& sizes, Position p, bool backwards, Enter enter, Traverse traverse, Leave leave) {
    constexpr int TOKENS = Config::TOKENS;
    const FlushDenormals flushed;
    auto groups = [&](auto act) __attribute__((always_inline)) {
        for (p.j = 0; p.j < p.blocks; ++p.j) {
            const int own = p.first + p.j, left = sizes.group_width - own * 16;
            p.k = p.group * sizes.group_blocks + own;
            p.d = p.group * sizes.group_width + own * 16, p.width = left < 16 ? left : 16;
            act(p);
        }
    };
    groups(enter);
    const int strips = (p.end - p.begin + TOKENS - 1) / TOKENS;
    for (int strip = 0; strip < strips; ++strip) {
        p.t0 = p.begin + (backwards ? strips - 1 - strip : strip) * TOKENS;
        p.count = p.end - p.t0 < TOKENS ? p.end - p.t0 : TOKENS;
        groups(traverse);
    }
    groups(leave);
#if defined(__x86_64__)
    __builtin_ia32_sfence();  // other threads see writes past the caches
#endif
}

}  // namespace gamba::scan
