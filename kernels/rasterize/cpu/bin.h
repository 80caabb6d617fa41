// The tile lists of a CPU (README.md §2), four kernels: count the tiles of each Gaussian, offsets
// of the lists, scatter the intersections, sort a list.
#include "ellipse.h"
namespace gamba::raster {

typedef unsigned long long Word;

// An intersection whose list is sorted later: the bits of its depth, and its place in the rows.
struct Staged {
    int key, gaussian, number;
};

// Sorts words, whose upper halves are keys up to ``most`` and whose lower ones rise, stably by key.
// Returns where they are, of two places. Digits have at most 8 or 11 bits, of those in which keys
// differ.
static Word* sort_words(Word* now, Word* then, int n, unsigned most) {
    if (n <= 24) {
        for (int j = 1; j < n; ++j) {
            const Word word = now[j];
            int k = j;
            for (; k > 0 && now[k - 1] > word; --k) now[k] = now[k - 1];
            now[k] = word;
        }
        return now;
    }
    if (!most) return now;
    const int bits = 32 - __builtin_clz(most), longest = n < 6000 ? 8 : 11;
    const int rounds = (bits + longest - 1) / longest, digit = (bits + rounds - 1) / rounds;
    const unsigned mask = (1u << digit) - 1;
    int places[4][2048];
    for (int t = 0; t < rounds; ++t)
        for (unsigned d = 0; d <= mask; ++d) places[t][d] = 0;
    for (int j = 0; j < n; ++j)
        for (int t = 0; t < rounds; ++t) ++places[t][(now[j] >> 32) >> t * digit & mask];
    for (int t = 0; t < rounds; ++t) {
        int place = 0;
        for (unsigned d = 0; d <= mask; ++d) {
            const int many = places[t][d];
            places[t][d] = place;
            place += many;
        }
        for (int j = 0; j < n; ++j) then[places[t][(now[j] >> 32) >> t * digit & mask]++] = now[j];
        Word* const other = now;
        now = then;
        then = other;
    }
    return now;
}

// A worker sorts lists by depth, stably, one after the other: of views, whose Gaussians they put in
// order, or of tiles, whose staged intersections are in the order of the Gaussians' index. Depths
// are not negative, so their bits sort like the depths.
template<class Splats, class Lists>
static void sort(int task, int count, const Splats& splats, const wp::array_t<int>& staged,
    const wp::array_t<int>& counter, const wp::array_t<wp::int64>& workspace, const Lists& lists) {
    const bool views = !staged.data;
    const int size = splats.depths.shape[0] / count;  // Gaussians of a view
    Word* const words = (Word*)workspace.data + (size_t)task * workspace.shape[1];
    for (;;) {
        const int list = __atomic_fetch_add(counter.data, 1, __ATOMIC_RELAXED);
        if (list >= count) return;
        const int begin = views ? list * size : lists.starts.data[list];
        const int n = views ? size : lists.starts.data[list + 1] - begin;
        const unsigned* const depths = (const unsigned*)splats.depths.data + begin;
        const Staged* const items = (const Staged*)staged.data + begin;
        auto key = [&](int j) -> unsigned { return views ? depths[j] : items[j].key; };
        unsigned least = ~0u, most = 0;
        for (int j = 0; j < n; ++j) {
            least = key(j) < least ? key(j) : least;
            most = key(j) > most ? key(j) : most;
        }
        for (int j = 0; j < n; ++j) words[j] = (Word)(key(j) - least) << 32 | (unsigned)j;
        const Word* const sorted =
            sort_words(words, words + workspace.shape[1] / 2, n, most - least);
        for (int j = 0; j < n; ++j) {
            const unsigned i = sorted[j];
            if (views) lists.order.data[begin + j] = begin + i;
            else {
                lists.pairs.data[begin + j] = items[i].gaussian;
                lists.rows.data[begin + j] = items[i].number;
            }
        }
    }
}

// Running sums: the lists of all views are contiguous, a list has its parts in turn, and the counts
// of the parts become their first numbers. Too many intersections overflow here, and are refused by
// their sum, which has 64 bits.
template<class Work, class Lists>
static void offsets(int, int parts, const Work& work, const Lists& lists) {
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
}

// The numbers of Gaussian i that the lists need, each number ``stride`` after the one before.
template<class Splats>
INLINE void read(const Splats& splats, int i, float* to, int stride) {
    const float* const mean = (const float*)splats.means2d.data + (size_t)i * 2;
    const float* const conic = (const float*)splats.conics.data + (size_t)i * 3;
    const float* const extent = (const float*)splats.extents.data + (size_t)i * 2;
    for (int k = 0; k < 2; ++k) to[k * stride] = mean[k];
    for (int k = 0; k < 3; ++k) to[(2 + k) * stride] = conic[k];
    to[5 * stride] = splats.view_opacities.data[i];
    for (int k = 0; k < 2; ++k) to[(6 + k) * stride] = extent[k];
}

// Windows of 4 x 4 tiles of the ellipses ``seen``: a bit for each tile that is touched, as
// ``corner`` the first tile, or -1 where the window is too small.
template<class Config, class Grid>
static inline I windows_of(const Grid& grid, const Ellipse& ellipse, I seen, I& corner) {
    const Interval rows = rows_of<Config>(grid, ellipse);
    const I count = rows.last - rows.first + 1;
    I few = seen & (count <= 4);
    const int most = __builtin_reduce_max(few ? count : I{});
    Interval columns[4];
    I left = I{} + grid.tiles_x, right = I{} - 1;
    for (int t = 0; t < most; ++t) {
        auto& [first, last] = columns[t] = columns_of<Config>(grid, ellipse, rows.first + t);
        const I some = few & (t < count) & (first <= last);
        first = some ? first : I{} + grid.tiles_x;
        last = some ? last : I{} - 1;
        left = first < left ? first : left;
        right = last > right ? last : right;
    }
    few &= right - left < 4;
    I bits = I{};
    for (int t = 0; t < most; ++t) {
        const auto [first, last] = columns[t];
        const I some = few & (first <= last), one = I{} + 1;
        const I from = some ? first - left : I{}, to = some ? last - left : I{};
        bits |= some ? ((one << (to + 1)) - (one << from)) << (4 * t) : I{};
    }
    const I large = seen & ~few;
    corner = large ? I{} - 1 : (bits != 0 ? rows.first * grid.tiles_x + left : I{});
    return bits;
}

// visit(row, first, last) for each row of tiles that Gaussian i touches.
template<class Config, class Grid, class Splats, class Visit>
static inline void visit_rows(const Grid& grid, const Splats& splats, int i, Visit visit) {
    float numbers[8];
    F v[8];
    read(splats, i, numbers, 1);
    for (int k = 0; k < 8; ++k) v[k] = splat(numbers[k]);
    const Ellipse ellipse = ellipse_of<Config>(v, grid.alpha_min);
    const Interval rows = rows_of<Config>(grid, ellipse);
    const int top = rows.first[0], bottom = rows.last[0];
    for (int t = top; t <= bottom; t += 16) {
        const auto [first, last] = columns_of<Config>(grid, ellipse, lane + t);
        for (int k = 0; k < 16 && t + k <= bottom; ++k)
            if (first[k] <= last[k]) visit(t + k, first[k], last[k]);
    }
}

// A task's Gaussians [begin, end), whole groups of 16 of a view, in the order of ``lists.order``,
// or else of their index, and the windows of each group. A word holds the bits of four Gaussians,
// so that a loop over them seldom exits.
struct Part {
    const int* order;
    int group, begin, end;
    int within[16];  // the tiles of a window, from its first

    template<class Grid, class Lists>
    Part(int task, int parts, const Grid& grid, const Lists& lists) : order(lists.order.data) {
        const int groups = (grid.num + 15) / 16, image = task / parts, part = task % parts;
        const int first = (long long)groups * part / parts;
        const int last = (long long)groups * (part + 1) / parts;
        group = image * groups + first;
        begin = image * grid.num + first * 16;
        end = image * grid.num + (last * 16 < grid.num ? last * 16 : grid.num);
        for (int k = 0; k < 16; ++k) within[k] = k / 4 * grid.tiles_x + k % 4;
    }
    int gaussian(int j) const { return order ? order[j] : j; }
};

// Finds the windows of a task's Gaussians and counts its intersections with each tile.
template<class Config, class Grid, class Splats, class Lists, class Work>
static void count(int task, int parts, const Grid& grid, const Splats& splats, const Lists& lists,
    const Work& work) {
    const Part part(task, parts, grid, lists);
    int* const counts = work.counts.data + (size_t)task * work.counts.shape[1];
    long long intersections = 0;
    for (int j = part.begin, g = part.group; j < part.end; j += 16, ++g) {
        const int n = part.end - j < 16 ? part.end - j : 16;
        float numbers[8][16] = {};
        // loops of constant length over adjacent numbers become loads of lanes
        if (!part.order && n == 16)
            for (int l = 0; l < 16; ++l) read(splats, j + l, numbers[0] + l, 16);
        else
            for (int l = 0; l < n; ++l) read(splats, part.gaussian(j + l), numbers[0] + l, 16);
        const F* const v = (const F*)numbers;
        int* const corner = work.corners.data + (size_t)g * 16;
        Word* const words = (Word*)(work.windows.data + (size_t)g * 16);
        const I seen = v[6] > 0.0f;
        I corners = I{}, bits = I{};
        if (any(seen)) {
            const Ellipse ellipse = ellipse_of<Config>(v, grid.alpha_min);
            bits = windows_of<Config>(grid, ellipse, seen, corners);
        }
        *(I*)corner = corners;
        typedef unsigned short Short __attribute__((vector_size(32), aligned(2)));
        *(Short*)words = __builtin_convertvector(bits, Short);
        for (int w = 0; w < 4; ++w) {
            Word word = words[w];
            intersections += __builtin_popcountll(word);
            for (; word; word &= word - 1) {
                const int k = __builtin_ctzll(word);
                ++counts[corner[4 * w + (k >> 4)] + part.within[k & 15]];
            }
        }
        if (any(corners < 0))
            for (int l = 0; l < n; ++l)
                if (corners[l] < 0)
                    visit_rows<Config>(
                        grid, splats, part.gaussian(j + l), [&](int ty, int first, int last) {
                            int* const row = counts + (size_t)ty * grid.tiles_x;
                            for (int tx = first; tx <= last; ++tx) ++row[tx];
                            intersections += last - first + 1;
                        });
    }
    work.totals.data[task] = intersections;
}

// Writes the intersections of a task's windows, each to the next place of its tile. Where the
// Gaussians come front to back the lists are done; else they are staged for sort.
template<class Config, class Grid, class Splats, class Work, class Lists>
static void scatter(int task, int parts, const Grid& grid, const Splats& splats, const Work& work,
    const Lists& lists, const wp::array_t<int>& staged) {
    const Part part(task, parts, grid, lists);
    int* const cursors = work.counts.data + (size_t)task * work.counts.shape[1];
    const int* const keys = (const int*)splats.depths.data;
    Staged* const items = (Staged*)staged.data;
    int p = work.numbers.data[task];
    auto emit = [&](int& cursor, int i) {
        const int place = cursor++;
        if (part.order) {
            lists.pairs.data[place] = i;
            lists.rows.data[place] = p;
        } else items[place] = {keys[i], i, p};
        ++p;
    };
    for (int j = part.begin, g = part.group; j < part.end; j += 16, ++g) {
        const int n = part.end - j < 16 ? part.end - j : 16;
        const int* const corner = work.corners.data + (size_t)g * 16;
        const Word* const words = (const Word*)(work.windows.data + (size_t)g * 16);
        auto bits_of = [&](int l) -> int { return words[l >> 2] >> 16 * (l & 3) & 0xffff; };
        if (any(*(const I*)corner < 0)) {  // some are large
            for (int l = 0; l < n; ++l) {
                const int i = part.gaussian(j + l);
                lists.offsets.data[j + l] = p;
                if (corner[l] < 0)
                    visit_rows<Config>(grid, splats, i, [&](int ty, int first, int last) {
                        int* const row = cursors + (size_t)ty * grid.tiles_x;
                        for (int tx = first; tx <= last; ++tx) emit(row[tx], i);
                    });
                else
                    for (int bits = bits_of(l); bits; bits &= bits - 1)
                        emit(cursors[corner[l] + part.within[__builtin_ctz(bits)]], i);
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
                emit(cursors[corner[l] + part.within[k & 15]], part.gaussian(j + l));
            }
    }
}

}  // namespace gamba::raster
