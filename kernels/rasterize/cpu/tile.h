// A tile of a picture and its blocks of 4 x 4 pixels. Lane l of a block is pixel (l % 4, l / 4).
#include "lanes.h"

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
// `visit(l, pixel)` for each pixel of a block that lies in the picture
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
    __builtin_prefetch(splats.opacities.data + g);
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
        -0.72134752044f * conic[0], conic[1], -0.72134752044f * conic[2], splats.opacities.data[g],
        color_of(g)};
};
// u and v of a block's pixels from the centre (README.md §3)
auto v_of = [&](const Splat& s, int b) -> F { return Y + (s.dy + (float)(b / COLUMNS * 4)); };
auto u_of = [&](const Splat& s, int b) -> F {
    const float y = s.dy + (float)(b / COLUMNS * 4), x = s.dx + (float)(b % COLUMNS * 4);
    return X + Y * s.shear + (x + s.shear * y);
};
// Their alpha, not clamped. The exponent is rounded to an integer n by adding 1.5 * 2^23 (+127, the
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
