"""Native leaves of the lists of many Gaussians: which tiles they touch, and the sort of a list.

The loops around them are the kernels of ``bin_many.py``. README.md §2 holds the maths.
"""

import warp as wp

from ..skip import TILE_TEST
from ..tiles import SLACK, SLACK_ABS, Grid
from .lanes import TYPES

# Lanes are Gaussians, or rows of tiles of one Gaussian.
_SPANS = (
    TYPES
    + """
auto splat = [](float x) -> F { return F{} + x; };
auto ints_ = [](F x) -> I { return __builtin_convertvector(x, I); };
auto floats_ = [](I x) -> F { return __builtin_convertvector(x, F); };
auto root_ = [](F x) -> F { return __builtin_elementwise_sqrt(x); };
const int width = grid.width, height = grid.height, shift = grid.shift, tiles_x = grid.tiles_x;
const bool test = grid.skip & TILE_TEST;
const float wide = (float)(width - 1), high = (float)(height - 1);
// clamped before the cast: a footprint may be larger than an int32
auto tile_ = [&](F x, float most) -> I {
    return ints_(min_(max_(x, F{}), splat(most))) >> shift;
};
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
struct Ellipse { F x, y, k, e, limit, over_a, reach, top, extent; };
auto ellipse_ = [&](F x, F y, F a, F k, F e, F opacity, F extent) -> Ellipse {
    const F limit = log_(opacity / grid.alpha_min) * (2.0f * SLACK) + SLACK_ABS;
    const F top = -k * a * root_(limit / (a * (a * k * k + e) * e));
    return {x, y, k, e, limit, splat(1.0f) / a, root_(limit / e), top, extent};
};
// README eq. 6: first and last column of rows ``ty``; first > last: none
auto spans_ = [&](const Ellipse& E, I ty, I& first, I& last) {
    if (!test) {
        first = tile_(E.x - E.extent, wide);
        last = tile_(E.x + E.extent, wide);
        return;
    }
    // exact numbers first, the mean once: rounding must not turn one row of pixels into none
    const F y0 = max_(floats_(ty << shift) + 0.5f - E.y, -E.reach);
    const I below = (ty + 1) << shift;
    const F end = floats_(below < height ? below : I{} + height) - 0.5f;
    const F y1 = min_(end - E.y, E.reach);
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
};
const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
// first and last row with a pixel centre (at +0.5) in reach, with a pixel to spare
auto top_ = [&](F y, F reach) -> I { return tile_(y - reach - 1.0f, high); };
auto bottom_ = [&](F y, F reach) -> I { return tile_(y + reach + 1.0f, high); };
// ``visit(row, first, last)`` for each row of tiles that Gaussian i touches: lanes are its rows
auto rows_ = [&](int i, auto visit) {
    const float* const m = (const float*)means2d.data + (size_t)i * 2;
    const float* const c = (const float*)conics.data + (size_t)i * 3;
    const float* const r = (const float*)extents.data + (size_t)i * 2;
    const Ellipse E = ellipse_(splat(m[0]), splat(m[1]), splat(c[0]), splat(c[1]), splat(c[2]),
        splat(opacities.data[i]), splat(r[0]));
    const int top = top_(E.y, splat(r[1]))[0], bottom = bottom_(E.y, splat(r[1]))[0];
    for (int t = top; t <= bottom; t += 16) {
        I first, last;
        spans_(E, lane + t, first, last);
        for (int k = 0; k < 16 && t + k <= bottom; ++k)
            if (first[k] <= last[k]) visit(t + k, first[k], last[k]);
    }
};
// A window of 4 x 4 tiles of a Gaussian: its first tile, and a bit for each tile that is touched.
// Words hold the bits of four Gaussians, so that a loop over them seldom ends.
const int within[16] = {0, 1, 2, 3, tiles_x, tiles_x + 1, tiles_x + 2, tiles_x + 3, 2 * tiles_x,
    2 * tiles_x + 1, 2 * tiles_x + 2, 2 * tiles_x + 3, 3 * tiles_x, 3 * tiles_x + 1,
    3 * tiles_x + 2, 3 * tiles_x + 3};
typedef unsigned long long Word;
""".replace("SLACK_ABS", f"{SLACK_ABS}f")
    .replace("SLACK", f"{SLACK}f")
    .replace("TILE_TEST", str(TILE_TEST))
)


# Finds the windows and counts the pairs of each tile. A Gaussian that does not fit its window has
# the first tile -1, one that is culled has no bits.
_COUNT = (
    _SPANS
    + """
int* const many = counts.data + (size_t)task * counts.shape[1];
long long pairs = 0, in_boxes = 0;
for (int i = begin, g = group; i < end; i += 16, ++g) {
    const int n = end - i < 16 ? end - i : 16;
    const float* const m = (const float*)means2d.data + (size_t)i * 2;
    const float* const c = (const float*)conics.data + (size_t)i * 3;
    const float* const r = (const float*)extents.data + (size_t)i * 2;
    float part[8][16] = {};
    auto load = [&](int count) {
        for (int l = 0; l < count; ++l) {
            part[0][l] = m[2 * l];
            part[1][l] = m[2 * l + 1];
            part[2][l] = c[3 * l];
            part[3][l] = c[3 * l + 1];
            part[4][l] = c[3 * l + 2];
            part[5][l] = opacities.data[i + l];
            part[6][l] = r[2 * l];
            part[7][l] = r[2 * l + 1];
        }
    };
    if (n == 16) load(16); else load(n);
    auto get = [&](int k) -> F { return *(const F*)part[k]; };
    I* const corner = (I*)(corners.data + (size_t)g * 16);
    Word* const words = (Word*)(windows.data + (size_t)g * 16);
    const F rx = get(6), ry = get(7);
    const I seen = rx > 0.0f;
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
    const int* const tile = corners.data + (size_t)g * 16;
    for (int w = 0; w < 4; ++w) {
        Word word = words[w];
        pairs += __builtin_popcountll(word);
        for (; word; word &= word - 1) {
            const int k = __builtin_ctzll(word);
            ++many[tile[4 * w + (k >> 4)] + within[k & 15]];
        }
    }
    if (any_(large))
        for (int l = 0; l < n; ++l)
            if (large[l])
                rows_(i + l, [&](int ty, int first, int last) {
                    int* const row = many + (size_t)ty * tiles_x;
                    for (int tx = first; tx <= last; ++tx) ++row[tx];
                    pairs += last - first + 1;
                });
}
totals.data[task] = pairs;
boxes.data[task] = in_boxes;
"""
)

# Writes the pairs of the windows. ``cursor`` is where the next pair of a tile goes.
_SCATTER = (
    _SPANS
    + """
int* const cursor = cursors.data + (size_t)task * cursors.shape[1];
const int* const keys = (const int*)depths.data;
struct Pair { int key, gaussian, number; };
Pair* const pairs = (Pair*)staged.data;
int p = number;
for (int i = begin, g = group; i < end; i += 16, ++g) {
    const int n = end - i < 16 ? end - i : 16;
    const int* const corner = corners.data + (size_t)g * 16;
    const Word* const words = (const Word*)(windows.data + (size_t)g * 16);
    if (any_(*(const I*)corner < 0)) {  // some are large
        for (int l = 0; l < n; ++l) {
            const int key = keys[i + l];
            offsets.data[i + l] = p;
            if (corner[l] < 0)
                rows_(i + l, [&](int ty, int first, int last) {
                    int* const row = cursor + (size_t)ty * tiles_x;
                    for (int tx = first; tx <= last; ++tx) pairs[row[tx]++] = {key, i + l, p++};
                });
            else
                for (int bits = words[l >> 2] >> 16 * (l & 3) & 0xffff; bits; bits &= bits - 1)
                    pairs[cursor[corner[l] + within[__builtin_ctz(bits)]]++] = {key, i + l, p++};
        }
        continue;
    }
    int place = p;
    for (int l = 0; l < n; ++l) {
        offsets.data[i + l] = place;
        place += __builtin_popcount(words[l >> 2] >> 16 * (l & 3) & 0xffff);
    }
    for (int w = 0; w < 4; ++w)
        for (Word word = words[w]; word; word &= word - 1) {
            const int k = __builtin_ctzll(word), l = 4 * w + (k >> 4);
            pairs[cursor[corner[l] + within[k & 15]]++] = {keys[i + l], i + l, p++};
        }
}
"""
)

# A list holds its pairs in order of index; a stable sort by depth. Sorted are words of the key and
# the place; digits of at most 8 bits from the bits in which the keys of the list differ.
_SORT = """
typedef unsigned long long Word;
struct Pair { int key, gaussian, number; };
const Pair* const from = (const Pair*)staged.data + begin;
Word* now = (Word*)room.data + (size_t)worker * room.shape[1];
Word* then = now + room.shape[1] / 2;
const int n = end - begin;
unsigned least = ~0u, most = 0;
for (int j = 0; j < n; ++j) {
    const unsigned key = from[j].key;
    least = key < least ? key : least;
    most = key > most ? key : most;
}
for (int j = 0; j < n; ++j) now[j] = (Word)(from[j].key - least) << 32 | (unsigned)j;
if (n <= 24) {
    for (int j = 1; j < n; ++j) {
        const Word word = now[j];
        int k = j;
        for (; k > 0 && now[k - 1] > word; --k) now[k] = now[k - 1];
        now[k] = word;
    }
} else if (most > least) {
    const int bits = 32 - __builtin_clz(most - least);
    const int longest = n < 6000 ? 8 : 11;
    const int turns = (bits + longest - 1) / longest, size = (bits + turns - 1) / turns;
    const unsigned mask = (1u << size) - 1;
    int counts[4][2048];
    for (int t = 0; t < turns; ++t)
        for (unsigned d = 0; d <= mask; ++d) counts[t][d] = 0;
    for (int j = 0; j < n; ++j) {
        const unsigned key = now[j] >> 32;
        for (int t = 0; t < turns; ++t) ++counts[t][key >> t * size & mask];
    }
    for (int t = 0; t < turns; ++t) {
        int place = 0;
        for (unsigned d = 0; d <= mask; ++d) {
            const int count = counts[t][d];
            counts[t][d] = place;
            place += count;
        }
        for (int j = 0; j < n; ++j) {
            const Word word = now[j];
            then[counts[t][(unsigned)(word >> 32) >> t * size & mask]++] = word;
        }
        Word* const other = now;
        now = then;
        then = other;
    }
}
for (int j = 0; j < n; ++j) {
    const Pair& pair = from[(unsigned)now[j]];
    pairs.data[begin + j] = pair.gaussian;
    rows.data[begin + j] = pair.number;
}
"""


@wp.func_native(_COUNT)
def count_part(
    task: int,
    begin: int,
    end: int,
    group: int,
    grid: Grid,
    means2d: wp.array[wp.vec2],
    conics: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    extents: wp.array[wp.vec2],
    corners: wp.array2d[wp.int32],
    windows: wp.array2d[wp.int16],
    counts: wp.array2d[wp.int32],
    totals: wp.array[wp.int64],
    boxes: wp.array[wp.int64],
):
    """Windows of the Gaussians [begin, end), the first of that group, their pairs, and two sums."""
    ...


@wp.func_native(_SCATTER)
def scatter_part(
    task: int,
    begin: int,
    end: int,
    group: int,
    number: int,
    grid: Grid,
    means2d: wp.array[wp.vec2],
    conics: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    extents: wp.array[wp.vec2],
    depths: wp.array[wp.float32],
    corners: wp.array2d[wp.int32],
    windows: wp.array2d[wp.int16],
    cursors: wp.array2d[wp.int32],
    offsets: wp.array[wp.int32],
    staged: wp.array2d[wp.int32],
):
    """Writes the pairs of the Gaussians [begin, end), the first one with that number."""
    ...


@wp.func_native(_SORT)
def sort_list(
    worker: int,
    begin: int,
    end: int,
    staged: wp.array2d[wp.int32],
    room: wp.array2d[wp.int64],
    pairs: wp.array[wp.int32],
    rows: wp.array[wp.int32],
):
    """Writes the list [begin, end) front to back; ``room[worker]`` holds it twice."""
    ...
