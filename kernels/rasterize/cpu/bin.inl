// needs: bin.py: SORT, staged, splats, counter, lists, workspace, OFFSETS, work, parts, grid,
//     SLACK, SLACK_ABS, TILE_TEST, SQUARES, COUNT, task, count
// gives: the bodies of sort, count, offsets and scatter
// The tile lists of the CPU (README.md §2), four kernels, of which a macro of its name chooses one:
// COUNT the tiles of each Gaussian, OFFSETS of the lists, SCATTER the intersections, SORT a list.
#include "../../runtime/sixteen.inl"
typedef unsigned long long Word;
struct Staged {
    int key, gaussian, number;
};

#if SORT
// A worker sorts lists by depth, stably, one after the other: of views, whose Gaussians they put in
// order, or of tiles, whose staged intersections are in the order of the Gaussians' index. Sorted
// are words of the key and the place; digits of at most 11 bits from those bits in which the keys
// of a list differ. Depths are not negative, so their bits sort like the depths.
const bool views = !staged.data;
const int size = splats.depths.shape[0] / count;  // Gaussians of a view
for (;;) {
    const int list = __atomic_fetch_add(counter.data, 1, __ATOMIC_RELAXED);
    if (list >= count) return;
    const int begin = views ? list * size : lists.starts.data[list];
    const int n = views ? size : lists.starts.data[list + 1] - begin;
    const unsigned* const depths = (const unsigned*)splats.depths.data + begin;
    const Staged* const items = (const Staged*)staged.data + begin;
    Word* now = (Word*)workspace.data + (size_t)task * workspace.shape[1];
    Word* then = now + workspace.shape[1] / 2;
    auto key = [&](int j) -> unsigned { return views ? depths[j] : items[j].key; };
    unsigned least = ~0u, most = 0;
    for (int j = 0; j < n; ++j) {
        least = key(j) < least ? key(j) : least;
        most = key(j) > most ? key(j) : most;
    }
    for (int j = 0; j < n; ++j) now[j] = (Word)(key(j) - least) << 32 | (unsigned)j;
    if (n <= 24) {
        for (int j = 1; j < n; ++j) {
            const Word word = now[j];
            int k = j;
            for (; k > 0 && now[k - 1] > word; --k) now[k] = now[k - 1];
            now[k] = word;
        }
    } else if (most > least) {
        const int bits = 32 - __builtin_clz(most - least), longest = n < 6000 ? 8 : 11;
        const int turns = (bits + longest - 1) / longest, digit = (bits + turns - 1) / turns;
        const unsigned mask = (1u << digit) - 1;
        int counts[4][2048];
        for (int t = 0; t < turns; ++t)
            for (unsigned d = 0; d <= mask; ++d) counts[t][d] = 0;
        for (int j = 0; j < n; ++j)
            for (int t = 0; t < turns; ++t) ++counts[t][(now[j] >> 32) >> t * digit & mask];
        for (int t = 0; t < turns; ++t) {
            int place = 0;
            for (unsigned d = 0; d <= mask; ++d) {
                const int many = counts[t][d];
                counts[t][d] = place;
                place += many;
            }
            for (int j = 0; j < n; ++j)
                then[counts[t][(now[j] >> 32) >> t * digit & mask]++] = now[j];
            Word* const other = now;
            now = then;
            then = other;
        }
    }
    for (int j = 0; j < n; ++j) {
        const unsigned i = now[j];
        if (views) lists.order.data[begin + j] = begin + i;
        else {
            lists.pairs.data[begin + j] = items[i].gaussian;
            lists.rows.data[begin + j] = items[i].number;
        }
    }
}

#elif OFFSETS
// Running sums: the lists of all views are contiguous, a list has its parts in turn, and
// the counts of the parts become their first numbers. Too many intersections overflow here, and are
// refused by their sum, which has 64 bits.
long long intersections = 0;
for (int task = 0; task < work.totals.shape[0]; ++task) {
    work.numbers.data[task] = (int)intersections;
    intersections += work.totals.data[task];
}
lists.count.data[0] = intersections;
lists.offsets.data[lists.offsets.shape[0] - 1] = (int)intersections;
const int tiles = work.counts.shape[1], views = work.counts.shape[0] / parts;
unsigned place = 0;
int* start = lists.starts.data;
for (int view = 0; view < views; ++view)
    for (int tile = 0; tile < tiles; ++tile) {
        *start++ = (int)place;
        for (int part = 0; part < parts; ++part) {
            const int row = view * parts + part;
            int& count = work.counts.data[(size_t)row * tiles + tile];
            const int size = count;
            count = (int)place;
            place += size;
        }
    }
*start = (int)place;

#else  // COUNT and SCATTER
// Which tiles Gaussians touch: lanes are Gaussians, or rows of tiles of one Gaussian. A task has
// whole groups of 16 Gaussians of a view, in the order of `lists.order`, or else of their index.
const int width = grid.width, height = grid.height, tiles_x = grid.tiles_x;
const int groups = (grid.num + 15) / 16, image = task / parts, part = task % parts;
const int first_group = (long long)groups * part / parts;
const int end_group = (long long)groups * (part + 1) / parts;
const int begin = image * grid.num + first_group * 16;
const int end = image * grid.num + (end_group * 16 < grid.num ? end_group * 16 : grid.num);
const int* const order = lists.order.data;
auto gaussian = [&](int j) -> int { return order ? order[j] : j; };

auto ints_ = [](F x) -> I { return __builtin_convertvector(x, I); };
auto floats_ = [](I x) -> F { return __builtin_convertvector(x, F); };
const float wide = (float)(width - 1), high = (float)(height - 1);
// clamped before the cast: a footprint may be larger than an int32
auto tile_ = [&](F x, float most) -> I {
    return ints_(min_(max_(x, F{}), splat(most))) >> grid.shift;
};
// first and last row with a pixel centre (at +0.5) in reach, with a pixel to spare; or of README
// eq. 16's square, whose half side is the reach
const bool squares = grid.skip & SQUARES;
const float above = squares ? 0.5f : 1.0f, below = squares ? -1.5f : 1.0f;
auto top_ = [&](F y, F reach) -> I { return tile_(y - reach - above, high); };
auto bottom_ = [&](F y, F reach) -> I { return tile_(y + reach + below, high); };
// log(x) for x >= 1 to 2e-7 of itself or 1e-7: the limit has a slack of 1e-4
auto log_ = [&](F x) -> F {
    const I bits = (I)x;
    const I n = (bits - 0x3f3504f3) >> 23;
    const F m = (F)(bits - (n << 23));
    const F s = (m - 1.0f) / (m + 1.0f), w = s * s;
    F p = fma_(w, splat(0.2222222f), splat(0.2857143f));
    p = fma_(p, w, splat(0.4f));
    p = fma_(p, w, splat(0.6666667f));
    p = fma_(p, w, splat(2.0f));
    return fma_(floats_(n), splat(0.69314718f), p * s);
};
struct Ellipse {
    F x, y, k, e, limit, over_a, reach, top, extent;
};
auto ellipse_ = [&](F x, F y, F a, F k, F e, F opacity, F extent) -> Ellipse {
    const F limit = log_(opacity / grid.alpha_min) * (2.0f * SLACK) + SLACK_ABS;
    const F top = -k * a * root_(limit / (a * (a * k * k + e) * e));
    return {x, y, k, e, limit, splat(1.0f) / a, root_(limit / e), top, extent};
};
// README eq. 6: first and last column of rows `ty`; first > last: none
auto spans_ = [&](const Ellipse& E, I ty, I& first, I& last) {
    if (!(grid.skip & TILE_TEST)) {
        first = tile_(E.x - E.extent, wide);
        last = tile_(E.x + E.extent, wide);
        return;
    }
    // exact numbers first, the mean once: rounding must not turn one row of pixels into none
    const F y0 = max_(floats_(ty << grid.shift) + 0.5f - E.y, -E.reach);
    const I below = (ty + 1) << grid.shift;
    const F bound = floats_(below < height ? below : I{} + height) - 0.5f;
    const F y1 = min_(bound - E.y, E.reach);
    // convex, so clamping finds the extremes
    const F right = min_(max_(E.top, y0), y1), left = min_(max_(-E.top, y0), y1);
    F x1 = root_(max_(E.limit - E.e * right * right, F{}) * E.over_a);
    F x0 = root_(max_(E.limit - E.e * left * left, F{}) * E.over_a);
    x1 = E.x - E.k * right + x1;
    x0 = E.x - E.k * left - x0;
    const I none = (y0 > y1) | (x1 < 0.5f) | (x0 > (float)width - 0.5f);
    // a tile spans pixel centres 0.5 to 15.5; a gap between two tiles belongs to neither
    first = none ? I{} : tile_(x0 + 0.5f, wide);
    last = none ? I{} - 1 : tile_(x1 - 0.5f, wide);
    if (!squares) return;
    const I begin = tile_(E.x - E.extent - 0.5f, wide), end = tile_(E.x + E.extent - 1.5f, wide);
    first = first > begin ? first : begin;
    last = last < end ? last : end;
};
// `visit(row, first, last)` for each row of tiles that Gaussian i touches: lanes are its rows
auto rows_ = [&](int i, auto visit) {
    const float* const m = (const float*)splats.means2d.data + (size_t)i * 2;
    const float* const c = (const float*)splats.conics.data + (size_t)i * 3;
    const float* const r = (const float*)splats.extents.data + (size_t)i * 2;
    const Ellipse E = ellipse_(splat(m[0]), splat(m[1]), splat(c[0]), splat(c[1]), splat(c[2]),
        splat(splats.view_opacities.data[i]), splat(r[0]));
    const int top = top_(E.y, splat(r[1]))[0], bottom = bottom_(E.y, splat(r[1]))[0];
    for (int t = top; t <= bottom; t += 16) {
        I first, last;
        spans_(E, lane + t, first, last);
        for (int k = 0; k < 16 && t + k <= bottom; ++k)
            if (first[k] <= last[k]) visit(t + k, first[k], last[k]);
    }
};

// A window of 4 x 4 tiles of a Gaussian: its first tile, and a bit for each tile that is touched.
// A Gaussian that does not fit its window has the first tile -1, one that is culled has no bits.
// A word holds the bits of four Gaussians, so that a loop over them seldom exits.
const int within[16] = {0, 1, 2, 3, tiles_x, tiles_x + 1, tiles_x + 2, tiles_x + 3, 2 * tiles_x,
    2 * tiles_x + 1, 2 * tiles_x + 2, 2 * tiles_x + 3, 3 * tiles_x, 3 * tiles_x + 1,
    3 * tiles_x + 2, 3 * tiles_x + 3};
auto corners_of = [&](int g) -> int* { return work.corners.data + (size_t)g * 16; };
auto words_of = [&](int g) -> Word* { return (Word*)(work.windows.data + (size_t)g * 16); };

#if COUNT
// Finds the windows of a task's Gaussians and counts its intersections with each tile.
int* const counts = work.counts.data + (size_t)task * work.counts.shape[1];
long long intersections = 0;
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
            part[5][l] = splats.view_opacities.data[i];
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

#else
// Writes the intersections of a task's windows, each to the next place of its tile. Where the
// Gaussians come front to back the lists are done; else SORT takes them from ``staged``.
int* const cursors = work.counts.data + (size_t)task * work.counts.shape[1];
const int* const keys = (const int*)splats.depths.data;
Staged* const items = (Staged*)staged.data;
int p = work.numbers.data[task];
auto emit = [&](int& cursor, int i) {
    const int place = cursor++;
    if (order) {
        lists.pairs.data[place] = i;
        lists.rows.data[place] = p;
    } else items[place] = {keys[i], i, p};
    ++p;
};
for (int j = begin, g = image * groups + first_group; j < end; j += 16, ++g) {
    const int n = end - j < 16 ? end - j : 16;
    const int* const corner = corners_of(g);
    const Word* const words = words_of(g);
    auto bits_of = [&](int l) -> int { return words[l >> 2] >> 16 * (l & 3) & 0xffff; };
    if (any_(*(const I*)corner < 0)) {  // some are large
        for (int l = 0; l < n; ++l) {
            const int i = gaussian(j + l);
            lists.offsets.data[j + l] = p;
            if (corner[l] < 0)
                rows_(i, [&](int ty, int first, int last) {
                    int* const row = cursors + (size_t)ty * tiles_x;
                    for (int tx = first; tx <= last; ++tx) emit(row[tx], i);
                });
            else
                for (int bits = bits_of(l); bits; bits &= bits - 1)
                    emit(cursors[corner[l] + within[__builtin_ctz(bits)]], i);
        }
        continue;
    }
    int number = p;
    for (int l = 0; l < n; ++l) {
        lists.offsets.data[j + l] = number;
        number += __builtin_popcount(bits_of(l));
    }
    for (int w = 0; w < 4; ++w)
        for (Word word = words[w]; word; word &= word - 1) {
            const int k = __builtin_ctzll(word), l = 4 * w + (k >> 4);
            emit(cursors[corner[l] + within[k & 15]], gaussian(j + l));
        }
}
#endif
#endif
