// needs: composite.py: SUM_ROWS, absolute, lists, rows, task, RUN, splats, TILE, workers, picture,
//     GRADIENT, ABSOLUTE, PASSES, saved, pixels, ZERO_UPSTREAM, UNUSED, SLACK, SLACK_ABS,
//     EMPTY_TILES, BLOCK_TEST, STOPPED, v
// gives: the bodies of composite, composite_vjp and sum_rows
// Compositing on the CPU (README.md §3, §5), three kernels: the pictures, with GRADIENT the sums of
// each intersection, with SUM_ROWS the sums of each Gaussian.
#include "../../runtime/sixteen.inl"

#if SUM_ROWS
// Sums the rows of the Gaussians [begin, end) of the order: a row as lanes where it has at most 16
// numbers. Numbers past the end of a row are read, but not of the last row, which is read one by
// one.
const int moments = absolute.data ? 8 : 6, count = lists.order.shape[0];
const int width = rows.sums.shape[1], channels = width - moments;
const int begin = task * RUN, end = begin + RUN < count ? begin + RUN : count;
const long long all = (long long)rows.sums.shape[0] * width;
for (int j = begin; j < end; ++j) {
    const int i = lists.order.data[j], from = lists.offsets.data[j], to = lists.offsets.data[j + 1];
    float sums[16] = {};
    float* const colors = v.colors.data + (size_t)i * channels;
    if (width <= 16) {
        F sum = F{};
        for (int p = from; p < to; ++p) {
            if (!rows.written.data[p]) continue;
            const float* const row = rows.sums.data + (size_t)p * width;
            if ((long long)p * width + 16 <= all) sum += *(const F*)row;
            else {
                F part = F{};
                for (int c = 0; c < width; ++c) part[c] = row[c];
                sum += part;
            }
        }
        *(F*)sums = sum;
        for (int c = 0; c < channels; ++c) colors[c] = sums[moments + c];
    } else {
        for (int c = 0; c < channels; ++c) colors[c] = 0.0f;
        for (int p = from; p < to; ++p) {
            if (!rows.written.data[p]) continue;
            const float* const row = rows.sums.data + (size_t)p * width;
            for (int c = 0; c < moments; ++c) sums[c] += row[c];
            for (int c = 0; c < channels; ++c) colors[c] += row[moments + c];
        }
    }
    if (!rows.geometry) continue;
    // README eq. 11: moments of h to the gradients; products are stored before they are added
    const float* const conic = (const float*)(splats.conics.data + i);
    const float a = conic[0], k = conic[1], e = conic[2], ak = a * k;
    const float across = ak * sums[1], along = e * sums[2];
    float* const mean = (float*)(v.means2d.data + i);
    mean[0] = a * sums[1];
    mean[1] = across + along;
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

#else
// A tile of a picture and its blocks of 4 x 4 pixels. Lane l of a block is pixel (l % 4, l / 4).
constexpr int COLUMNS = TILE / 4, BLOCKS = COLUMNS * COLUMNS, AHEAD = 8;
const F X = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
const F Y = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
const int channels = splats.colors.shape[1], tiles = lists.starts.shape[0] - 1;

auto next_tile = [&]() -> int { return __atomic_fetch_add(workers.counter.data, 1, 0); };

struct Tile {
    int image, x, y;  // of its first pixel
    int first;        // of its blocks
    int inside;       // a bit for each block that has a pixel in the picture
};
auto tile_at = [&](int index) -> Tile {
    const int per_image = picture.tiles_x * picture.tiles_y;
    Tile tile = {index / per_image, index % picture.tiles_x * TILE,
        index / picture.tiles_x % picture.tiles_y * TILE, index * BLOCKS, 0};
    for (int b = 0; b < BLOCKS; ++b)
        if (tile.x + b % COLUMNS * 4 < picture.width && tile.y + b / COLUMNS * 4 < picture.height)
            tile.inside |= 1 << b;
    return tile;
};
// `visit(l, pixel)` for each pixel of a block inside the picture
auto pixels_of = [&](const Tile& tile, int b, auto visit) {
    const int x = tile.x + b % COLUMNS * 4, y = tile.y + b / COLUMNS * 4;
    const int nx = picture.width - x < 4 ? picture.width - x : 4;
    const int ny = picture.height - y < 4 ? picture.height - y : 4;
    for (int j = 0; j < ny; ++j)
        for (int i = 0; i < nx; ++i)
            visit(4 * j + i, ((size_t)tile.image * picture.height + y + j) * picture.width + x + i);
};

// shared colours have one row for each object's Gaussian
auto color_of = [&](int g) -> const float* {
    const int object = g / (picture.views * picture.num);
    const int row = picture.colors_per_view ? g : object * picture.num + g % picture.num;
    return splats.colors.data + (size_t)row * channels;
};
auto fetch = [&](int g) {
    __builtin_prefetch(splats.means2d.data + g);
    __builtin_prefetch(splats.conics.data + g);
    __builtin_prefetch(splats.view_opacities.data + g);
    __builtin_prefetch(color_of(g));
};

// A Gaussian as a tile sees it: from its centre to the tile's first pixel, its conic with
// -log2(e)/2 in a and e, its opacity and colour.
struct Splat {
    float dx, dy, a, shear, e, opacity;
    const float* color;
};
auto splat_of = [&](int g, const Tile& tile) -> Splat {
    const float* const mean = (const float*)(splats.means2d.data + g);
    const float* const conic = (const float*)(splats.conics.data + g);
    return {(float)tile.x + 0.5f - mean[0], (float)tile.y + 0.5f - mean[1],
        -0.72134752044f * conic[0], conic[1], -0.72134752044f * conic[2],
        splats.view_opacities.data[g], color_of(g)};
};
// u and v of a block's pixels from the centre (README.md §3)
auto v_of = [&](const Splat& s, int b) -> F { return Y + (s.dy + (float)(b / COLUMNS * 4)); };
auto u_of = [&](const Splat& s, int b) -> F {
    const float y = s.dy + (float)(b / COLUMNS * 4), x = s.dx + (float)(b % COLUMNS * 4);
    return X + Y * s.shear + (x + s.shear * y);
};
// Their unclamped alpha. The exponent is rounded to an integer n by adding 1.5 * 2^23 (+127, the
// bias), 2^rest is a minimax polynomial p of f, whose relative error is at most 3e-7.
auto alpha_of = [&](const Splat& s, F U, F V) -> F {
    const F shifter = F{} + 12583039.0f;
    F x = fma_(U * s.a, U, V * V * s.e);
    x = max_(x, F{} - 126.0f);
    const F n = x + shifter;
    const F f = x - (n - shifter);
    const F high = fma_(splat(0.00132764715f), f, splat(0.00967554133f));
    const F middle = fma_(splat(0.0555071327f), f, splat(0.240221197f));
    const F low = fma_(splat(0.693146967f), f, splat(1.00000007f));
    const F f2 = f * f;  // pairs of terms make a shorter chain than Horner's
    const F p = fma_(fma_(high, f2, middle), f2, low);
    return p * (F)((I)n << 23) * s.opacity;
};

#if GRADIENT
// The gradient of the blending: a worker walks the lists of tile after tile back to front, and
// writes a row of sums for each intersection: six moments of h (README eq. 11), if ABSOLUTE the two
// sums of eq. 14, then the colours.
constexpr int MOMENTS = ABSOLUTE ? 8 : 6;
const int row_length = rows.sums.shape[1];
F* const v_colors =
    (F*)workers.workspace.data + (size_t)task * (channels + BLOCKS * (channels + 1));
F* const v_pixels = v_colors + channels;  // of each block: of its channels, and of alpha
// pairwise, in a fixed order
auto total_ = [](F x) -> float {
    float s[16];
    *(F*)s = x;
    for (int w = 8; w > 0; w >>= 1)
        for (int l = 0; l < w; ++l) s[l] += s[l + w];
    return s[0];
};

for (int index = next_tile(); index < tiles; index = next_tile()) {
    const Tile tile = tile_at(index);
    const int begin = lists.starts.data[index], end = begin + saved.walked.data[index];
    const int every = begin < end ? tile.inside : 0;
    I nonzero = I{};
    for (int bits = every; bits; bits &= bits - 1) {
        const int b = __builtin_ctz(bits);
        F* const v = v_pixels + b * (channels + 1);
        for (int c = 0; c <= channels; ++c) v[c] = F{};
        pixels_of(tile, b, [&](int l, size_t pixel) {
            for (int c = 0; c < channels; ++c) v[c][l] = pixels.renders.data[pixel * channels + c];
            v[channels][l] = -pixels.transmittances.data[pixel];
        });
        for (int c = 0; c <= channels; ++c) nonzero |= v[c] != 0.0f;
    }
    const bool wanted = any_(nonzero) || (every && !(picture.skip & ZERO_UPSTREAM));
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
            fetch(lists.pairs.data[later]);
        }
        int bits = picture.skip & UNUSED ? saved.blocks.data[k] : every;
        if (!bits) continue;
        const Splat s = splat_of(lists.pairs.data[k], tile);
        F h0 = {}, hu = {}, hy = {}, huu = {}, huy = {}, hyy = {}, across = {}, along = {};
        const float* const conic = (const float*)(splats.conics.data + lists.pairs.data[k]);
        const F ak = splat(conic[0] * conic[1]), e = splat(conic[2]);
        for (int c = 0; c < channels; ++c) v_colors[c] = F{};
        for (; bits; bits &= bits - 1) {
            const int b = __builtin_ctz(bits);
            const F U = u_of(s, b), V = v_of(s, b);
            const F free = alpha_of(s, U, V);
            const F alpha = ((free >= picture.alpha_min) & (stops[b] > k))
                ? min_(free, F{} + picture.alpha_max)
                : F{};
            const F T = Ts[b] / (1.0f - alpha);
            Ts[b] = T;
            const F weight = T * alpha;
            const F* const v = v_pixels + b * (channels + 1);
            F sum = v[channels];
            for (int c = 0; c < channels; ++c) {
                sum = fma_(v[c], F{} + s.color[c], sum);
                v_colors[c] = fma_(weight, v[c], v_colors[c]);
            }
            if (rows.geometry) {
                const F diff = sum - Rs[b];
                Rs[b] = fma_(alpha, diff, Rs[b]);
                // past the clamp it is the gradient of the unclamped alpha
                const F over = PASSES ? T * free * diff : F{};
                const F h = alpha < picture.alpha_max ? weight * diff : over;
                const F u = h * U, w = h * V;
                h0 += h;
                hu += u;
                hy += w;
                huu = fma_(u, U, huu);
                huy = fma_(u, V, huy);
                hyy = fma_(w, V, hyy);
                if (ABSOLUTE) {
                    across += abs_(u);
                    along += abs_(fma_(ak, u, e * w));
                }
            }
        }
        const int row = lists.rows.data[k];
        float* const out = rows.sums.data + (size_t)row * row_length;
        out[0] = total_(h0);
        out[1] = total_(hu);
        out[2] = total_(hy);
        out[3] = total_(huu);
        out[4] = total_(huy);
        out[5] = total_(hyy);
        if (ABSOLUTE) {
            out[6] = total_(across);
            out[7] = total_(along);
        }
        for (int c = 0; c < channels; ++c) out[MOMENTS + c] = total_(v_colors[c]);
        rows.written.data[row] = 1;
    }
}

#else
// A worker blends tile after tile, front to back. Of each Gaussian the blocks are tested at once
// (lanes = blocks), and those that its ellipse touches are evaluated (lanes = pixels).
const F corner_x = X * 4.0f, corner_y = Y * 4.0f;  // a block's first pixel, in the tile
const I bit = 1 << lane;
// The blocks in which some pixel centre may have q <= limit: the least q on the rectangle of a
// block's pixel centres (README.md §2, the last paragraph).
auto touched = [&](const Tile& tile, int g) -> int {
    const float* const mean = (const float*)(splats.means2d.data + g);
    const float* const conic = (const float*)(splats.conics.data + g);
    const float a = conic[0], k = conic[1], e = conic[2];
    const float across = a * k * k;  // products are rounded before they are added
    const float slope = -a * k / (across + e);
    const float widened = 2.0f * wp::log(splats.view_opacities.data[g] / picture.alpha_min) * SLACK;
    const float limit = widened + SLACK_ABS;
    const F zero = F{};
    const F x0 = corner_x + ((float)tile.x + 0.5f) - mean[0], x1 = x0 + 3.0f;
    const F y0 = corner_y + ((float)tile.y + 0.5f) - mean[1], y1 = y0 + 3.0f;
    const F ny = max_(y0, min_(zero, y1)), nx = max_(x0, min_(zero, x1));
    const F kny = k * ny;
    F u = max_(x0, min_(-kny, x1)) + kny;
    F q = a * u * u + e * ny * ny;
    const F y = max_(y0, min_(nx * slope, y1));
    u = nx + k * y;
    q = min_(q, a * u * u + e * y * y);
    return __builtin_reduce_or((I)(q <= limit) & bit);
};

F* const sums = (F*)workers.workspace.data + (size_t)task * BLOCKS * channels;  // of colours
for (int index = next_tile(); index < tiles; index = next_tile()) {
    const int begin = lists.starts.data[index], end = lists.starts.data[index + 1];
    saved.walked.data[index] = 0;
    saved.blocks_walked.data[index] = 0;
    if (begin == end && picture.skip & EMPTY_TILES) continue;
    const Tile tile = tile_at(index);
    // A pixel that has stopped keeps its transmittance, above t_min, with a minus sign. T itself is
    // not chosen by a mask: that would become a masked store, for which the next load had to wait.
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
        fetch(lists.pairs.data[k + AHEAD < end ? k + AHEAD : end - 1]);
        const int todo = picture.skip & BLOCK_TEST ? alive & touched(tile, g) : alive;
        const Splat s = splat_of(g, tile);
        int used = 0, dead = 0;
        for (int bits = todo; bits; bits &= bits - 1) {
            const int b = __builtin_ctz(bits);
            const F T = Ts[b];
            F alpha = alpha_of(s, u_of(s, b), v_of(s, b));
            alpha = ((alpha >= picture.alpha_min) & (T > 0.0f))
                ? min_(alpha, F{} + picture.alpha_max)
                : F{};
            const F next = T - T * alpha;
            const I stays = max_(next, -next) > picture.t_min;
            const F weight = stays ? T * alpha : F{};
            Ts[b] = stays ? next : -T;
            // no branch on a weight above 0: the processor would often predict it wrongly
            used |= any_(weight > 0.0f) << b;
            F* const sum = sums + b * channels;
            if (channels == 3)
                for (int c = 0; c < 3; ++c) sum[c] = fma_(weight, F{} + s.color[c], sum[c]);
            else
                for (int c = 0; c < channels; ++c) sum[c] = fma_(weight, F{} + s.color[c], sum[c]);
            if (!all_(stays)) {
                stops[b] = stays ? stops[b] : I{} + k;
                if (!any_(Ts[b] > 0.0f)) dead |= 1 << b;
            }
        }
        evaluated += __builtin_popcount(todo);
        if (picture.skip & STOPPED) alive &= ~dead;
        saved.blocks.data[k] = used;
    }
    saved.walked.data[index] = k - begin;
    saved.blocks_walked.data[index] = evaluated;
    for (int b = 0; b < BLOCKS; ++b)
        pixels_of(tile, b, [&](int l, size_t pixel) {
            const float T = Ts[b][l];
            pixels.transmittances.data[pixel] = T < 0.0f ? -T : T;
            for (int c = 0; c < channels; ++c)
                pixels.renders.data[pixel * channels + c] = sums[b * channels + c][l];
        });
}
#endif
#endif
