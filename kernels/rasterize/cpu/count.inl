// Finds the windows of a task's Gaussians and counts its intersections with each tile.
#include "footprints.h"

int* const counts = work.counts.data + (size_t)task * work.counts.shape[1];
long long intersections = 0, in_boxes = 0;
for (int j = begin, g = image * groups + first_group; j < end; j += 16, ++g) {
    const int n = end - j < 16 ? end - j : 16;
    float part[8][16] = {};
    auto load = [&](int count, auto index) {
        for (int l = 0; l < count; ++l) {
            const int i = index(l);
            const float* const m = (const float*)splats.means2d.data + (size_t)i * 2;
            const float* const c = (const float*)splats.conics.data + (size_t)i * 3;
            const float* const r = (const float*)splats.extents.data + (size_t)i * 2;
            part[0][l] = m[0], part[1][l] = m[1];
            part[2][l] = c[0], part[3][l] = c[1], part[4][l] = c[2];
            part[5][l] = splats.opacities.data[i];
            part[6][l] = r[0], part[7][l] = r[1];
        }
    };
    // loops of constant length over adjacent numbers become loads of lanes
    if (order) load(n, [&](int l) { return order[j + l]; });
    else if (n == 16) load(16, [&](int l) { return j + l; });
    else load(n, [&](int l) { return j + l; });
    auto get = [&](int k) -> F { return *(const F*)part[k]; };
    const F rx = get(6), ry = get(7);
    const I seen = rx > 0.0f;
    I* const corner = (I*)corners_of(g);
    Word* const words = words_of(g);
    if (!any_(seen)) {
        *corner = I{};
        for (int w = 0; w < 4; ++w) words[w] = 0;
        continue;
    }
    const I top = top_(get(1), ry), count = bottom_(get(1), ry) - top + 1;
    const I box = count * (tile_(get(0) + rx, wide) - tile_(get(0) - rx, wide) + 1);
    in_boxes += __builtin_reduce_add(seen ? box : I{});  // each is at most 2^24
    const Ellipse E = ellipse_(get(0), get(1), get(2), get(3), get(4), get(5), rx);
    I few = seen & (count <= 4);
    const int most = __builtin_reduce_max(few ? count : I{});
    I firsts[4], lasts[4], left = I{} + tiles_x, right = I{} - 1;
    for (int t = 0; t < most; ++t) {
        spans_(E, top + t, firsts[t], lasts[t]);
        const I some = few & (t < count) & (firsts[t] <= lasts[t]);
        firsts[t] = some ? firsts[t] : I{} + tiles_x;
        lasts[t] = some ? lasts[t] : I{} - 1;
        left = firsts[t] < left ? firsts[t] : left;
        right = lasts[t] > right ? lasts[t] : right;
    }
    few &= right - left < 4;
    I window = I{};
    for (int t = 0; t < most; ++t) {
        const I some = few & (firsts[t] <= lasts[t]), one = I{} + 1;
        const I from = some ? firsts[t] - left : I{}, to = some ? lasts[t] - left : I{};
        window |= some ? ((one << (to + 1)) - (one << from)) << (4 * t) : I{};
    }
    const I large = seen & ~few;
    *corner = large ? I{} - 1 : (window != 0 ? top * tiles_x + left : I{});
    typedef unsigned short Short __attribute__((vector_size(32), aligned(2)));
    *(Short*)words = __builtin_convertvector(window, Short);
    const int* const tile = corners_of(g);
    for (int w = 0; w < 4; ++w) {
        Word word = words[w];
        intersections += __builtin_popcountll(word);
        for (; word; word &= word - 1) {
            const int k = __builtin_ctzll(word);
            ++counts[tile[4 * w + (k >> 4)] + within[k & 15]];
        }
    }
    if (any_(large))
        for (int l = 0; l < n; ++l)
            if (large[l])
                rows_(gaussian(j + l), [&](int ty, int first, int last) {
                    int* const row = counts + (size_t)ty * tiles_x;
                    for (int tx = first; tx <= last; ++tx) ++row[tx];
                    intersections += last - first + 1;
                });
}
work.totals.data[task] = intersections;
work.boxes.data[task] = in_boxes;
