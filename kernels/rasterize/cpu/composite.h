// Compositing on a CPU and its gradient (README.md §3, §5): composite makes the images,
// composite_vjp the sums of each intersection, sum_rows those of each Gaussian.
#include "../rows.h"
namespace gamba::raster {

constexpr int AHEAD = 8;  // intersections between a prefetch and its use
// Lane l of a block is pixel (l % 4, l / 4), and block l of a tile is at (l % 4, l / 4), too.
static const F COLUMN = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
static const F ROW = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// A tile of an image and its blocks of 4 x 4 pixels.
struct Tile {
    static constexpr int SIDE = 16, COLUMNS = SIDE / 4, BLOCKS = COLUMNS * COLUMNS;
    int image, x, y;  // of its first pixel
    int first;        // of its blocks
    int inside;       // a bit for each block that has a pixel in the image
};

template<class RasterParams>
static Tile tile_at(const RasterParams& params, int index) {
    const int per_image = params.tiles_x * params.tiles_y;
    Tile tile = {index / per_image, index % params.tiles_x * Tile::SIDE,
        index / params.tiles_x % params.tiles_y * Tile::SIDE, index * Tile::BLOCKS, 0};
    for (int b = 0; b < Tile::BLOCKS; ++b) {
        const int x = tile.x + b % Tile::COLUMNS * 4, y = tile.y + b / Tile::COLUMNS * 4;
        if (x < params.width && y < params.height) tile.inside |= 1 << b;
    }
    return tile;
}

template<class Workers>
static inline int next_tile(const Workers& workers) {
    return __atomic_fetch_add(workers.counter.data, 1, 0);
}

// visit(l, pixel) for each pixel of a block inside the image.
template<class RasterParams, class Visit>
static inline void pixels_of(const RasterParams& params, const Tile& tile, int b, Visit visit) {
    const int x = tile.x + b % Tile::COLUMNS * 4, y = tile.y + b / Tile::COLUMNS * 4;
    const int nx = params.width - x < 4 ? params.width - x : 4;
    const int ny = params.height - y < 4 ? params.height - y : 4;
    for (int j = 0; j < ny; ++j)
        for (int i = 0; i < nx; ++i)
            visit(4 * j + i, ((size_t)tile.image * params.height + y + j) * params.width + x + i);
}

// Shared colours have one row for each object's Gaussian.
template<class RasterParams, class Splats>
static inline const float* color_of(const RasterParams& params, const Splats& splats, int g) {
    const int object = g / (params.views * params.num);
    const int row = params.colors_per_view ? g : object * params.num + g % params.num;
    return splats.colors.data + (size_t)row * splats.colors.shape[1];
}

template<class RasterParams, class Splats>
static inline void prefetch(const RasterParams& params, const Splats& splats, int g) {
    __builtin_prefetch(splats.means2d.data + g);
    __builtin_prefetch(splats.conics.data + g);
    __builtin_prefetch(splats.view_opacities.data + g);
    __builtin_prefetch(color_of(params, splats, g));
}

// A Gaussian as a tile sees it: from its centre to the tile's first pixel, its conic with
// -log2(e)/2 in a and e, its opacity and colour.
struct Splat {
    float dx, dy, a, k, e, opacity;
    const float* color;

    // README eq. 4's u = dx + k dy, and dy, of a block's pixels
    F u_of(int b) const {
        const float y = dy + (float)(b / Tile::COLUMNS * 4);
        const float x = dx + (float)(b % Tile::COLUMNS * 4);
        return COLUMN + ROW * k + (x + k * y);
    }
    F dy_of(int b) const { return ROW + (dy + (float)(b / Tile::COLUMNS * 4)); }

    // Their unclamped alpha. The exponent is rounded to an integer n by adding 1.5 · 2^23 (+127,
    // the bias); p is the minimax polynomial of 2^f on [-½, ½], with a relative error of 3e-7 at
    // most.
    F alpha_of(F u, F dy) const {
        const F shifter = splat(12583039.0f);
        F x = fma(u * a, u, dy * dy * e);
        x = max(x, splat(-126.0f));
        const F n = x + shifter;
        const F f = x - (n - shifter);
        const F high = fma(splat(0.00132764715f), f, splat(0.00967554133f));
        const F middle = fma(splat(0.0555071327f), f, splat(0.240221197f));
        const F low = fma(splat(0.693146967f), f, splat(1.00000007f));
        const F f2 = f * f;  // pairs of terms make a shorter chain than Horner's
        const F p = fma(fma(high, f2, middle), f2, low);
        return p * (F)((I)n << 23) * opacity;
    }
};

template<class RasterParams, class Splats>
static inline Splat splat_of(
    const RasterParams& params, const Splats& splats, int g, const Tile& tile) {
    const float* const mean = (const float*)(splats.means2d.data + g);
    const float* const conic = (const float*)(splats.conics.data + g);
    return {(float)tile.x + 0.5f - mean[0], (float)tile.y + 0.5f - mean[1],
        -0.72134752044f * conic[0], conic[1], -0.72134752044f * conic[2],
        splats.view_opacities.data[g], color_of(params, splats, g)};
}

// The blocks (lanes) in which some pixel centre may have q <= limit: the least q on the rectangle
// of a block's pixel centres (README.md §2, the last paragraph).
template<class Config, class Splats>
static inline int touched(const Splats& splats, int g, const Tile& tile, float alpha_min) {
    const float* const mean = (const float*)(splats.means2d.data + g);
    const float* const conic = (const float*)(splats.conics.data + g);
    const float a = conic[0], k = conic[1], e = conic[2];
    const float across = a * k * k;  // products are rounded before they are added
    const float slope = -a * k / (across + e);
    const float L = 2.0f * wp::log(splats.view_opacities.data[g] / alpha_min) * Config::SLACK;
    const float limit = L + Config::SLACK_ABS;
    const F zero = F{}, corner_x = COLUMN * 4.0f, corner_y = ROW * 4.0f;
    const F x0 = corner_x + ((float)tile.x + 0.5f) - mean[0], x1 = x0 + 3.0f;
    const F y0 = corner_y + ((float)tile.y + 0.5f) - mean[1], y1 = y0 + 3.0f;
    const F ny = max(y0, min(zero, y1)), nx = max(x0, min(zero, x1));
    const F kny = k * ny;
    F u = max(x0, min(-kny, x1)) + kny;
    F q = a * u * u + e * ny * ny;
    const F y = max(y0, min(nx * slope, y1));
    u = nx + k * y;
    q = min(q, a * u * u + e * y * y);
    return __builtin_reduce_or((I)(q <= limit) & (1 << lane));
}

// A worker blends tile after tile, front to back. Of each Gaussian the blocks are tested at once
// (lanes = blocks), and those that its ellipse touches are evaluated (lanes = pixels).
template<class Config, class RasterParams, class Splats, class Lists, class Saved, class Pixels,
    class Workers>
static void composite(int task, const RasterParams& params, const Splats& splats,
    const Lists& lists, const Saved& saved, const Pixels& pixels, const Workers& workers) {
    static_assert(Config::TILE == Tile::SIDE, "lanes are the 16 blocks of a tile");
    constexpr int BLOCKS = Tile::BLOCKS;
    const int channels = splats.colors.shape[1], tiles = lists.starts.shape[0] - 1;
    F* const sums = (F*)workers.workspace.data + (size_t)task * BLOCKS * channels;  // of colours
    for (int index = next_tile(workers); index < tiles; index = next_tile(workers)) {
        const int begin = lists.starts.data[index], end = lists.starts.data[index + 1];
        saved.traversed.data[index] = 0;
        saved.blocks_traversed.data[index] = 0;
        if (begin == end && params.skip & Config::EMPTY_TILES) continue;
        const Tile tile = tile_at(params, index);
        // A pixel that has stopped keeps its transmittance, above t_min, with a minus sign. T is
        // not chosen by a mask: that would become a masked store, for which the next load waits.
        F* const Ts = (F*)saved.transmittances.data + tile.first;
        I* const stops = (I*)saved.stops.data + tile.first;
        for (int b = 0; b < BLOCKS; ++b) {
            Ts[b] = splat(1.0f);
            stops[b] = I{} + 0x7fffffff;
        }
        for (int i = 0; i < BLOCKS * channels; ++i) sums[i] = F{};
        int alive = tile.inside, k = begin;
        long long evaluated = 0;
        for (; k < end && alive; ++k) {
            const int g = lists.pairs.data[k];
            prefetch(params, splats, lists.pairs.data[k + AHEAD < end ? k + AHEAD : end - 1]);
            const int todo = params.skip & Config::BLOCK_TEST
                ? alive & touched<Config>(splats, g, tile, params.alpha_min)
                : alive;
            const Splat s = splat_of(params, splats, g, tile);
            int used = 0, dead = 0;
            for (int bits = todo; bits; bits &= bits - 1) {
                const int b = __builtin_ctz(bits);
                const F T = Ts[b];
                F alpha = s.alpha_of(s.u_of(b), s.dy_of(b));
                alpha = ((alpha >= params.alpha_min) & (T > 0.0f))
                    ? min(alpha, splat(params.alpha_max))
                    : F{};
                const F next = T - T * alpha;
                const I stays = max(next, -next) > params.t_min;
                const F weight = stays ? T * alpha : F{};
                Ts[b] = stays ? next : -T;
                // no branch on a weight above 0: the processor would often predict it wrongly
                used |= any(weight > 0.0f) << b;
                F* const sum = sums + b * channels;
                if (channels == 3)
                    for (int c = 0; c < 3; ++c) sum[c] = fma(weight, splat(s.color[c]), sum[c]);
                else
                    for (int c = 0; c < channels; ++c)
                        sum[c] = fma(weight, splat(s.color[c]), sum[c]);
                if (!all(stays)) {
                    stops[b] = stays ? stops[b] : I{} + k;
                    if (!any(Ts[b] > 0.0f)) dead |= 1 << b;
                }
            }
            evaluated += __builtin_popcount(todo);
            if (params.skip & Config::STOPPED) alive &= ~dead;
            saved.blocks.data[k] = used;
        }
        saved.traversed.data[index] = k - begin;
        saved.blocks_traversed.data[index] = evaluated;
        for (int b = 0; b < BLOCKS; ++b)
            pixels_of(params, tile, b, [&](int l, size_t pixel) {
                const float T = Ts[b][l];
                pixels.transmittances.data[pixel] = T < 0.0f ? -T : T;
                for (int c = 0; c < channels; ++c)
                    pixels.renders.data[pixel * channels + c] = sums[b * channels + c][l];
            });
    }
}

// Fills v, of each block the gradient of its channels and of alpha; true if some is not zero.
template<class RasterParams, class Pixels>
static bool load_gradient(
    const RasterParams& params, const Pixels& pixels, const Tile& tile, int blocks, F* v_pixels) {
    const int channels = pixels.renders.shape[1];
    I nonzero = I{};
    for (int bits = blocks; bits; bits &= bits - 1) {
        const int b = __builtin_ctz(bits);
        F* const v = v_pixels + b * (channels + 1);
        for (int c = 0; c <= channels; ++c) v[c] = F{};
        pixels_of(params, tile, b, [&](int l, size_t pixel) {
            for (int c = 0; c < channels; ++c) v[c][l] = pixels.renders.data[pixel * channels + c];
            v[channels][l] = -pixels.transmittances.data[pixel];
        });
        for (int c = 0; c <= channels; ++c) nonzero |= v[c] != 0.0f;
    }
    return any(nonzero);
}

// README eq. 11: the moments of h over pixels, and with ABSOLUTE the sums of eq. 14.
template<bool ABSOLUTE>
struct Moments {
    static constexpr int COUNT = ABSOLUTE ? 8 : 6;
    F sums[COUNT] = {};

    void add(F h, F u, F dy, float ak, float e) {
        const F hu = h * u, hy = h * dy;
        sums[0] += h;
        sums[1] += hu;
        sums[2] += hy;
        sums[3] = fma(hu, u, sums[3]);
        sums[4] = fma(hu, dy, sums[4]);
        sums[5] = fma(hy, dy, sums[5]);
        if constexpr (ABSOLUTE) {
            sums[6] += abs(hu);
            sums[7] += abs(fma(splat(ak), hu, e * hy));
        }
    }
};

// The gradient of the blending: a worker traverses the lists of tile after tile back to front, and
// writes a row for each intersection: its moments, then the sums of its colours.
template<class Config, bool ABSOLUTE, bool PASSES, class RasterParams, class Splats, class Lists,
    class Saved, class Pixels, class Workers, class Rows>
static void composite_vjp(int task, const RasterParams& params, const Splats& splats,
    const Lists& lists, const Saved& saved, const Pixels& pixels, const Workers& workers,
    const Rows& rows) {
    constexpr int BLOCKS = Tile::BLOCKS, COUNT = Moments<ABSOLUTE>::COUNT;
    const int channels = splats.colors.shape[1], tiles = lists.starts.shape[0] - 1;
    const int row_length = rows.sums.shape[1];
    F* const v_colors =
        (F*)workers.workspace.data + (size_t)task * (channels + BLOCKS * (channels + 1));
    F* const v_pixels = v_colors + channels;
    for (int index = next_tile(workers); index < tiles; index = next_tile(workers)) {
        const Tile tile = tile_at(params, index);
        const int begin = lists.starts.data[index], end = begin + saved.traversed.data[index];
        const int every = begin < end ? tile.inside : 0;
        const bool nonzero = load_gradient(params, pixels, tile, every, v_pixels);
        const bool wanted = nonzero || (every && !(params.skip & Config::ZERO_UPSTREAM));
        int& skipped = rows.skipped.data[index];
        skipped = wanted ? 2 : skipped > 1 ? skipped : 1;
        if (!wanted) continue;
        F Ts[BLOCKS], Rs[BLOCKS];  // transmittance, and the blend behind
        const I* const stops = (const I*)saved.stops.data + tile.first;
        for (int b = 0; b < BLOCKS; ++b) {
            const F T = ((const F*)saved.transmittances.data)[tile.first + b];
            Ts[b] = T < 0.0f ? -T : T;
            Rs[b] = F{};
        }
        for (int k = end - 1; k >= begin; --k) {
            const int later = k - AHEAD > begin ? k - AHEAD : begin;
            if (saved.blocks.data[later]) {  // rows are in the order of the Gaussians
                const int row = lists.rows.data[later];
                const char* const sums = (const char*)(rows.sums.data + (size_t)row * row_length);
                __builtin_prefetch(sums, 1);
                __builtin_prefetch(sums + row_length * 4 - 1, 1);
                __builtin_prefetch(rows.written.data + row, 1);
                prefetch(params, splats, lists.pairs.data[later]);
            }
            int bits = params.skip & Config::UNUSED ? saved.blocks.data[k] : every;
            if (!bits) continue;
            const Splat s = splat_of(params, splats, lists.pairs.data[k], tile);
            const float* const conic = (const float*)(splats.conics.data + lists.pairs.data[k]);
            const float ak = conic[0] * conic[1], e = conic[2];
            Moments<ABSOLUTE> moments;
            for (int c = 0; c < channels; ++c) v_colors[c] = F{};
            for (; bits; bits &= bits - 1) {
                const int b = __builtin_ctz(bits);
                const F u = s.u_of(b), dy = s.dy_of(b);
                const F free = s.alpha_of(u, dy);
                const F alpha = ((free >= params.alpha_min) & (stops[b] > k))
                    ? min(free, splat(params.alpha_max))
                    : F{};
                const F T = Ts[b] / (1.0f - alpha);
                Ts[b] = T;
                const F weight = T * alpha;
                const F* const v = v_pixels + b * (channels + 1);
                F sum = v[channels];
                for (int c = 0; c < channels; ++c) {
                    sum = fma(v[c], splat(s.color[c]), sum);
                    v_colors[c] = fma(weight, v[c], v_colors[c]);
                }
                if (!rows.geometry) continue;
                const F diff = sum - Rs[b];
                Rs[b] = fma(alpha, diff, Rs[b]);
                // past the clamp it is the gradient of the unclamped alpha
                const F over = PASSES ? T * free * diff : F{};
                moments.add(alpha < params.alpha_max ? weight * diff : over, u, dy, ak, e);
            }
            const int row = lists.rows.data[k];
            float* const out = rows.sums.data + (size_t)row * row_length;
            for (int m = 0; m < COUNT; ++m) out[m] = total(moments.sums[m]);
            for (int c = 0; c < channels; ++c) out[COUNT + c] = total(v_colors[c]);
            rows.written.data[row] = 1;
        }
    }
}

// Sums rows [from, to): a row as lanes where it has at most 16 numbers. Numbers past the end of a
// row are read, but not of the last row, which is read one by one.
template<class Rows>
static inline void sum_of_rows(
    const Rows& rows, int from, int to, int moments, float* sums, float* colors) {
    const int width = rows.sums.shape[1], channels = width - moments;
    const long long all = (long long)rows.sums.shape[0] * width;
    F sum = F{};
    for (int c = 0; c < channels; ++c) colors[c] = 0.0f;
    for (int p = from; p < to; ++p) {
        if (!rows.written.data[p]) continue;
        const float* const row = rows.sums.data + (size_t)p * width;
        if (width > 16) {
            for (int c = 0; c < moments; ++c) sums[c] += row[c];
            for (int c = 0; c < channels; ++c) colors[c] += row[moments + c];
        } else if ((long long)p * width + 16 <= all) {
            sum += *(const F*)row;
        } else {
            F part = F{};
            for (int c = 0; c < width; ++c) part[c] = row[c];
            sum += part;
        }
    }
    if (width > 16) return;
    *(F*)sums = sum;
    for (int c = 0; c < channels; ++c) colors[c] = sums[moments + c];
}

// The gradients of the Gaussians [begin, end) of the order: README eq. 11 of their rows' sums.
template<int LENGTH, class Splats, class Lists, class Rows, class Absolute>
static void sum_rows(int task, const Splats& splats, const Lists& lists, const Rows& rows,
    const Splats& v, const Absolute& absolute) {
    const int moments = absolute.data ? 8 : 6, channels = rows.sums.shape[1] - moments;
    const Run run(task, lists.order.shape[0], LENGTH);
    for (int j = run.begin; j < run.end; ++j) {
        const int i = lists.order.data[j];
        const int from = lists.offsets.data[j], to = lists.offsets.data[j + 1];
        float sums[16] = {};
        sum_of_rows(rows, from, to, moments, sums, v.colors.data + (size_t)i * channels);
        if (!rows.geometry) continue;
        const float* const conic = (const float*)(splats.conics.data + i);
        const float a = conic[0], k = conic[1], e = conic[2], ak = a * k;
        // products are stored before they are added
        const float across = ak * sums[1], along = e * sums[2];
        float* const v_mean = (float*)(v.means2d.data + i);
        v_mean[0] = a * sums[1];
        v_mean[1] = across + along;
        float* const v_conic = (float*)(v.conics.data + i);
        v_conic[0] = -0.5f * sums[3];
        v_conic[1] = -a * sums[4];
        v_conic[2] = -0.5f * sums[5];
        v.view_opacities.data[i] = to > from ? sums[0] / splats.view_opacities.data[i] : 0.0f;
        if (absolute.data) {  // README eq. 14
            float* const both = (float*)(absolute.data + i);
            both[0] = a * sums[6];
            both[1] = sums[7];
        }
    }
}

}  // namespace gamba::raster
