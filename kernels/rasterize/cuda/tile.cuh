// Common parts of the CUDA compositor: a warp and the pixels of its lanes, records of Gaussians,
// and the test of a Gaussian against sub-tiles. A tile of 16 x 16 pixels is eight sub-tiles of 8
// x 4. A warp works on a tile, or on a half or a quarter of it: on 8, 4 or 2 sub-tiles, in each of
// which a lane owns one pixel. CUDA.md has the design. K is the struct of a kernel's constants
// (kernels.py): PARTS of a tile, CHANNELS of a launch, and bits of ``skip``.
#include "../../runtime/scalars.cuh"
#include "record.h"
namespace gamba::raster {

constexpr int WARP = 32, ALL = -1;       // lanes; the mask of all of them
constexpr int WIDTH = 8, HEIGHT = 4;     // pixels of a sub-tile; two of them side by side
constexpr int TILE = 16, SUB_TILES = 8;  // pixels of a tile's side; its sub-tiles
// Bit STOP + j of a pair: a pixel of sub-tile j stopped at it. Below are the blocks of 4 x 4 pixels
// to which it contributed.
constexpr int STOP = 16, BLOCKS = (1 << STOP) - 1;
// The rounding of a position: the test of a sub-tile may keep too much, never too little.
constexpr float SLACK_PIXELS = 0.01f;

// Pixels of a lane, and sub-tiles of its warp.
template<class K>
constexpr int PIXELS = SUB_TILES / K::PARTS;
// The left one of the two blocks of 4 x 4 pixels that make up sub-tile j.
static constexpr int first_block(int j) { return j / 2 * 4 + j % 2 * 2; }

static inline void operator+=(Four& sum, Four other) {
    for (int i = 0; i < 4; ++i) sum.of[i] += other.of[i];
}
// A record in shared memory, of one chunk: the bits of a pair are in the place of the limit.
struct Record {
    Shape shape;
    Level level;
    Four color;
    int bits() const { return __float_as_int(level.limit); }
};
static_assert(sizeof(Record) == 48, "kernels.py computes the size of shared memory");

// Where the record of view-major Gaussian g begins; its colours are behind Shape and Level.
template<class Gaussians>
static const float* record_at(const Gaussians& gaussians, int g) {
    return gaussians.records.data + wide(g, gaussians.records.shape[1]);
}

// The or of all lanes' integers.
static inline int any_of(int x) {
#if __CUDA_ARCH__ < 800
    for (int i = WARP / 2; i > 0; i /= 2) x |= __shfl_xor_sync(ALL, x, i);
    return x;
#else
    return __reduce_or_sync(ALL, x);
#endif
}
// The number of the highest bit that is set; one instruction, where the lowest takes two.
static inline int highest_bit(int x) {
    int r;
    asm("bfind.u32 %0, %1;" : "=r"(r) : "r"(x));
    return r;
}

// Tile and pixels of a warp and a lane.
template<class K>
struct Place {
    int lane, tile, part;
    int px, py;       // the lane's pixel in the first sub-tile
    long long pixel;  // its number in all images
    long long saved;  // its number by tiles and sub-tiles; the next sub-tiles' are WARP apart
    float x[2];       // centres of the lane's pixels, by columns of sub-tiles
    float y[PIXELS<K> / 2];  // by rows of sub-tiles

    // ``index`` is that of the warp's part among all tiles' parts
    template<class Params>
    Place(const Params& params, int index, int lane)
        : lane(lane), tile(index / K::PARTS), part(index % K::PARTS) {
        const int row = tile / params.tiles_x;  // of tiles, among all images
        px = tile % params.tiles_x * TILE + lane % WIDTH;
        py = row % params.tiles_y * TILE + part * (TILE / K::PARTS) + lane / WIDTH;
        const int line = row / params.tiles_y * params.height + py;
        pixel = wide(line, params.width) + px;
        saved = wide(index, PIXELS<K> * WARP) + lane;
        for (int i = 0; i < 2; ++i) x[i] = float(px + i * WIDTH) + 0.5f;
        WP_PRAGMA_UNROLL
        for (int i = 0; i < PIXELS<K> / 2; ++i) y[i] = float(py + i * HEIGHT) + 0.5f;
    }
    // The pixel in sub-tile j, counted from the first one's.
    static int step(int j, int width) { return j / 2 * HEIGHT * width + j % 2 * WIDTH; }
};

// The channels of a launch, of the lane's pixel in sub-tile j.
template<class K, class Params, class Gaussians>
static float* channels_of(const wp::array_t<float>& renders, const Place<K>& p, int j,
    const Params& params, const Gaussians& gaussians) {
    const long long first = p.pixel * gaussians.channels + gaussians.first;
    return renders.data + first + wide(p.step(j, params.width), gaussians.channels);
}

// README §5's u and dy of a pixel's centre, and its alpha before the clamp.
struct Sample {
    float u, dy, alpha;
    // fmaf is named, since forward and backward must see the same alpha: the compiler has no choice
    Sample(const Record& g, float x, float y) : dy(y - g.shape.y) {
        u = fmaf(g.shape.k, dy, x - g.shape.x);
        alpha = exp2(fmaf(g.shape.a * u, u, fmaf(g.level.e * dy, dy, g.level.log2_opacity)));
    }
};

// Bit j: the ellipse alpha >= alpha_min touches sub-tile j of the warp's part (README eq. 6).
template<class K>
static int touched(const Place<K>& p, const Shape& shape, const Level& level) {
    const float a = -shape.a, k = shape.k, e = -level.e, limit = level.limit;
    const float reach = root(limit * reciprocal(e)), over_a = reciprocal(a);
    // the centre of the part's first pixel
    const float x = p.x[0] - float(p.lane % WIDTH) - shape.x;
    const float y = p.y[0] - float(p.lane / WIDTH) - shape.y;
    int bits = 0;
    WP_PRAGMA_UNROLL
    for (int row = 0; row < PIXELS<K> / 2; ++row) {
        const float y0 = fmaxf(y + float(row * HEIGHT), -reach);
        const float y1 = fminf(y + float(row * HEIGHT + HEIGHT - 1), reach);
        if (y0 > y1) continue;
        const float right = fminf(fmaxf(y0, level.top), y1);
        const float left = fminf(fmaxf(y0, -level.top), y1);
        float x1 = root(fmaxf(limit - e * right * right, 0.0f) * over_a) - k * right;
        float x0 = -root(fmaxf(limit - e * left * left, 0.0f) * over_a) - k * left;
        x1 += SLACK_PIXELS - x;
        x0 -= SLACK_PIXELS + x;
        for (int column = 0; column < 2; ++column)
            if (x1 >= float(column * WIDTH) && x0 <= float(column * WIDTH + WIDTH - 1))
                bits += 1 << (row * 2 + column);
    }
    return bits;
}

}  // namespace gamba::raster
