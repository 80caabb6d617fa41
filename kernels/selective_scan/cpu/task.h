// A task: a segment of the tokens of one sequence, and lane groups of one channel group.
// States, gradients of states and products of decays are pairs: N values, then for each what it has
// rounded away (states.h). They are ordered by segment, then sequence.
struct Place {
    int b, state, group;  // ``state``: row of the state arrays
    int begin, end;       // tokens
    int chunk;            // row of what is kept of chunks, of the segment's first
    int first, blocks;    // first lane group, and how many
    int part;             // row of the partial sums of dB and dC
    // then of a lane group and TOKENS tokens, or fewer at the end
    int t0, count;
    int j, k;      // lane group of the task, and of all
    int d, width;  // channels
};
auto place_of = [&](int task) -> Place {
    const int spans = (sizes.group_blocks + sizes.span - 1) / sizes.span;
    const int parts = (sizes.group_blocks + BLOCKS - 1) / BLOCKS;
    const int row = task / spans / sizes.groups;
    Place p = {};
    p.first = task % spans * sizes.span, p.group = task / spans % sizes.groups;
    p.state = row;
    if (rows_in.shape[0] > 0) {
        const int* const own = (const int*)rows_in.data + (size_t)row * 4;
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
// what a dense array of lanes has below these first indices
auto row_ = [](auto& array, auto... indices) -> F* {
    size_t at = 0;
    int dim = 0;
    ((at = at * array.shape[dim++] + indices), ...);
    for (; dim < array.ndim; ++dim) at *= array.shape[dim];
    return (F*)array.data + at;
};
// Calls ``walk`` with the lane groups of every TOKENS tokens, in the tokens' order or backwards.
auto each_ = [&](bool backwards, auto walk) __attribute__((always_inline)) {
#include "../../runtime/denormals.h"
    Place p = place_of(task);
    const int strips = (p.end - p.begin + TOKENS - 1) / TOKENS;
    for (int strip = 0; strip < strips; ++strip) {
        p.t0 = p.begin + (backwards ? strips - 1 - strip : strip) * TOKENS;
        p.count = p.end - p.t0 < TOKENS ? p.end - p.t0 : TOKENS;
        for (p.j = 0; p.j < p.blocks; ++p.j) {
            const int own = p.first + p.j, left = sizes.group_width - own * 16;
            p.k = p.group * sizes.group_blocks + own;
            p.d = p.group * sizes.group_width + own * 16, p.width = left < 16 ? left : 16;
            walk(p);
        }
    }
#if defined(__x86_64__)
    __builtin_ia32_sfence();  // what was written past the caches is seen by other threads
#endif
};
