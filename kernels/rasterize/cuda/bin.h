// The tile lists on CUDA (README.md §2), three kernels: count finds the tiles of each Gaussian in
// the order of depth, emit writes its pairs, and after a sort by tile in_tile_order gathers them.
// Config, from bin.py: KEPT, EACH, the slack of the limit and bits of ``skip``.
#include "ellipse.h"
namespace gamba::raster {

// A Gaussian's rows of tiles, or a row's columns, as a word between count and emit.
static inline int packed(Interval tiles) {
    return tiles.first | (tiles.last - tiles.first + 1) << 16;
}
static inline Interval unpacked(int word) {
    const int first = word & 0xFFFF;
    return {first, first + (word >> 16) - 1};
}
// True for few rows, and tiles whose numbers a word can hold.
template<class Config, class Grid>
static inline bool are_kept(const Grid& grid, Interval rows) {
    const int most = grid.tiles_x > grid.tiles_y ? grid.tiles_x : grid.tiles_y;
    return rows.last - rows.first < Config::KEPT && most < 1 << 15;
}

// The j-th Gaussian of all views, front to back in each: its number of pairs, and words of its rows
// and of each row's columns if they are kept, else 0.
template<class Config, class In, class Out>
static void count(int j, const In& in, const Out& out) {
    const auto& grid = in.grid;
    const int num = out.order.shape[0], i = j / grid.num * grid.num + (int)in.nearest.data[j];
    out.order.data[j] = i;
    int pairs = 0;
    const wp::vec2 box = load(in.splats.extents, i);
    if (box[0] > 0.0f) {
        const Ellipse ellipse = ellipse_of<Config>(in.splats, i, grid.alpha_min, box);
        const Interval rows = rows_of<Config>(grid, ellipse);
        const bool kept = are_kept<Config>(grid, rows);
        int* span = out.spans.data + j;
        *span = kept ? packed(rows) : 0;
        WP_PRAGMA_NO_UNROLL  // which would split warps more
        for (int ty = rows.first; ty <= rows.last; ++ty) {
            const Interval columns = columns_of<Config>(grid, ellipse, ty);
            pairs += columns.last - columns.first + 1;
            span += num;
            if (kept) *span = packed(columns);
        }
    }
    if (j == 0) out.counts.data[0] = 0;  // their running sum is where each begins
    out.counts.data[j + 1] = pairs;
}

// Writes the pairs [p, end) of the j-th Gaussian.
template<class Config, class In, class Out>
static inline void write_pairs(int j, int p, int end, const In& in, const Out& out) {
    const auto& grid = in.grid;
    const int i = in.order.data[j], num = in.order.shape[0];
    auto write = [&](int tile) {
        out.tiles.data[p] = tile;
        out.gaussians.data[p++] = i;
    };
    auto write_rows = [&](Interval rows, auto columns_of_row) {
        int tile = in.first + (i / grid.num * grid.tiles_y + rows.first) * grid.tiles_x;
        for (int ty = rows.first; ty <= rows.last; ++ty, tile += grid.tiles_x) {
            const Interval columns = columns_of_row(ty);
            // no more than were counted: a compiler may round otherwise here than there
            const int most = p + columns.last - columns.first + 1, last = most < end ? most : end;
            for (int tx = tile + columns.first; p < last; ++tx) write(tx);
        }
    };
    const int* span = in.spans.data + j;
    if (*span) write_rows(unpacked(*span), [&](int) { return unpacked(*(span += num)); });
    else {
        const wp::vec2 box = load(in.splats.extents, i);
        const Ellipse ellipse = ellipse_of<Config>(in.splats, i, grid.alpha_min, box);
        write_rows(rows_of<Config>(grid, ellipse),
            [&](int ty) { return columns_of<Config>(grid, ellipse, ty); });
    }
    while (p < end) write(in.behind);  // where rounding found fewer
}

// Writes the pairs of the j-th Gaussian, and gives free places the tile ``behind`` all others. If
// the lists are too short, all places are free.
template<class Config, class In, class Out>
static void emit(int j, const In& in, const Out& out) {
    const int num = in.order.shape[0], size = out.tiles.shape[0];
    const long long total = in.sums.data[num];
    const int begin = (int)in.sums.data[j], end = (int)in.sums.data[j + 1];
    if (j == 0) {
        out.count.data[0] = total;
        out.offsets.data[0] = 0;
    }
    out.offsets.data[j + 1] = end;
    const bool fits = total <= size;
    if (fits && begin < end) write_pairs<Config>(j, begin, end, in, out);
    // of 64 bits, as the last step may pass 2^31
    for (long long place = (fits ? total : 0) + j; place < size; place += num)
        out.tiles.data[place] = in.behind;
}

// Gathers the pairs k, k + threads, .., EACH of them, and finds where the list of tile k starts.
template<class Config, class In, class Out>
static void in_tile_order(int k, const In& in, const Out& out) {
    const int threads = in.threads, size = in.tiles.shape[0];
    const int count = in.count.data[0] <= size ? in.count.data[0] : 0;
    // all loads before the stores, so that they are in flight together
    const int left = count - k;
    int row[Config::EACH], gaussian[Config::EACH];
    auto each = [&](auto visit) {
        WP_PRAGMA_UNROLL
        for (int n = 0; n < Config::EACH; ++n)
            if (n * threads < left) visit(n, k + n * threads);
    };
    each([&](int n, int at) { row[n] = (int)in.emitted.data[at]; });
    each([&](int n, int at) { gaussian[n] = in.gaussians.data[row[n]]; });
    each([&](int n, int at) {
        out.rows.data[at] = row[n];
        out.pairs.data[at] = gaussian[n];
    });
    if (k >= out.starts.shape[0]) return;
    int low = 0, high = size;  // the first pair whose tile is k or later is between them
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (in.tiles.data[middle] < in.first + k) low = middle + 1;
        else high = middle;
    }
    out.starts.data[k] = low;
}

}  // namespace gamba::raster
