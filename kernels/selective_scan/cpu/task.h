// needs: kernels.py: BLOCKS, CHUNK, TOKENS; sixteen.inl: F, splat
// gives: Position, position_, row_, states_, fill_, pairs_, load_, store_, piece_, each_
// A task: a segment of the tokens of one sequence, and lane groups of one channel group. Tasks that
// follow one another have the same lane groups and adjacent tokens, also in the backward order: the
// rows that one prefetches beyond its tokens belong to the next.
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
// ``ranges``: of packed rows, for each segment its b, begin, end and chunk; or none
auto position_ = [](const auto& sizes, const auto& ranges, int task, bool backwards) -> Position {
    const int spans = (sizes.group_blocks + sizes.span - 1) / sizes.span;
    const int parts = (sizes.group_blocks + BLOCKS - 1) / BLOCKS;
    const int rows = sizes.segments * sizes.batch, share = task / rows;
    const int row = backwards ? rows - 1 - task % rows : task % rows;
    Position p = {};
    p.first = share % spans * sizes.span, p.group = share / spans;
    p.row = row;
    if (ranges.shape[0] > 0) {
        const int* const own = (const int*)ranges.data + (size_t)row * 4;
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
};
// the part of a dense array of lanes at these first indices
auto row_ = [](auto& array, auto... indices) -> F* {
    size_t at = 0;
    int dim = 0;
    ((at = at * array.shape[dim++] + indices), ...);
    for (; dim < array.ndim; ++dim) at *= array.shape[dim];
    return (F*)array.data + at;
};
// States, gradients of states and products of decays are in the caller's order, [rows, D, N]; an
// array without rows is zeros, or not needed. While a task walks its tokens they are lanes in the
// workspace of the launch's piece: pairs, N values, then the rounding error of each (strip.h).
auto states_ = [](const auto& array, const Position& p) -> float* {
    return (float*)array.data + ((size_t)p.row * array.shape[1] + p.d) * array.shape[2];
};
auto fill_ = [&](F* values, int states, float value) {
    for (int n = 0; n < states; ++n) values[n] = splat(value);
};
auto pairs_ = [&](F* pairs, int states, float value) {
    fill_(pairs, states, value), fill_(pairs + states, states, 0.0f);
};
auto load_ = [&](const auto& array, const Position& p, int states, F* pairs) {
    pairs_(pairs, states, 0.0f);
    if (array.shape[0] == 0) return;
    const float* const from = states_(array, p);
    for (int n = 0; n < states; ++n)
        for (int i = 0; i < p.width; ++i) ((float*)(pairs + n))[i] = from[i * states + n];
};
auto store_ = [&](auto& array, const Position& p, const F* values) {
    if (array.shape[0] == 0) return;
    float* const to = states_(array, p);
    const int states = array.shape[2];
    for (int i = 0; i < p.width; ++i)
        for (int n = 0; n < states; ++n) to[i * states + n] = ((const float*)(values + n))[i];
};
// The row of a workspace that has one for each piece of the launch.
auto piece_ = [&](auto& array, const auto& sizes, int task) -> F* {
    const long long tasks = (long long)sizes.segments * sizes.batch * sizes.groups
        * ((sizes.group_blocks + sizes.span - 1) / sizes.span);
    return row_(array, (int)(((task + 1ll) * array.shape[0] - 1) / tasks));
};
// Calls ``walk`` with the lane groups of every TOKENS tokens, in the tokens' order or backwards;
// before it ``enter``, and after it ``leave`` with each lane group.
auto each_ = [](const auto& sizes, Position p, bool backwards, auto enter, auto walk,
                 auto leave) __attribute__((always_inline)) {
#include "../../runtime/denormals.h"
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
        groups(walk);
    }
    groups(leave);
#if defined(__x86_64__)
    __builtin_ia32_sfence();  // other threads see writes past the caches
#endif
};
