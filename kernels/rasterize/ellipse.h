// The ellipse alpha >= alpha_min of a Gaussian, and the tiles that it touches: an interval of
// columns for each row of tiles (README.md §2), for both devices. A value F is sixteen ellipses, or
// sixteen rows of one, on a CPU (cpu/ellipse.h), and one on CUDA (cuda/ellipse.h). Config, from the
// lists' bin.py: bits of ``skip``, and the slack of the limit.
namespace gamba::raster {

// Rows or columns of tiles; none where last < first, which it is by one at the most.
struct Interval {
    I first, last;
};

// The set q <= limit around (x, y), in the form of README eq. 4.
struct Ellipse {
    F x, y, k, e, limit;
    F over_a;  // 1/a
    F reach;   // it has y - reach to y + reach
    F top;     // it is rightmost at y + top, leftmost at y - top
    F rx, ry;  // half sides of the box around it, or of README eq. 16's square
};

// The tile of a pixel, clamped before the cast: a footprint may be larger than an int32.
template<class Grid>
static inline I tile_of(const Grid& grid, F pixel, int size) {
    return ints(min(max(pixel, F{}), splat((float)(size - 1)))) >> grid.shift;
}

// Tiles of an interval that README eq. 16's square has as well.
template<class Config, class Grid>
static inline Interval in_square(const Grid& grid, Interval tiles, F center, F radius, int size) {
    if (!(grid.skip & Config::SQUARES)) return tiles;
    const I first = tile_of(grid, center - radius - 0.5f, size);
    const I last = tile_of(grid, center + radius - 1.5f, size);
    tiles.first = tiles.first > first ? tiles.first : first;
    tiles.last = tiles.last < last ? tiles.last : last;
    tiles.last = tiles.last < tiles.first - 1 ? tiles.first - 1 : tiles.last;
    return tiles;
}

// Rows that may have columns.
template<class Config, class Grid>
static inline Interval rows_of(const Grid& grid, const Ellipse& ellipse) {
    // of the box, those with a pixel centre (at +0.5), with a pixel to spare
    const F y = ellipse.y, ry = ellipse.ry;
    if (!(grid.skip & Config::TILE_TEST))
        return {
            tile_of(grid, y - ry - 1.0f, grid.height), tile_of(grid, y + ry + 1.0f, grid.height)};
    // from an end of the ellipse to the last pixel centre in it, with a quarter of a pixel to spare
    const I first = tile_of(grid, y - ellipse.reach + 0.25f, grid.height);
    const I last = tile_of(grid, y + ellipse.reach - 0.25f, grid.height);
    return in_square<Config>(grid, {first, last}, y, ry, grid.height);
}

// README eq. 6: columns of row ty that the ellipse touches.
template<class Config, class Grid>
static inline Interval columns_of(const Grid& grid, const Ellipse& ellipse, I ty) {
    const int width = grid.width, height = grid.height;
    const F x = ellipse.x, y = ellipse.y, k = ellipse.k, e = ellipse.e, rx = ellipse.rx;
    if (!(grid.skip & Config::TILE_TEST))
        return {tile_of(grid, x - rx, width), tile_of(grid, x + rx, width)};
    // exact numbers first, the mean once: rounding must not turn one row of pixels into none
    const F y0 = max(floats(ty << grid.shift) + 0.5f - y, -ellipse.reach);
    const I below = (ty + 1) << grid.shift;
    const F end = floats(below < height ? below : I{} + height) - 0.5f;
    const F y1 = min(end - y, ellipse.reach);
    // convex, so clamping finds the extremes
    const F right = min(max(ellipse.top, y0), y1), left = min(max(-ellipse.top, y0), y1);
    F x1 = sqrt(max(ellipse.limit - e * right * right, F{}) * ellipse.over_a);
    F x0 = sqrt(max(ellipse.limit - e * left * left, F{}) * ellipse.over_a);
    x1 = x - k * right + x1;
    x0 = x - k * left - x0;
    const I none = (y0 > y1) | (x1 < 0.5f) | (x0 > (float)width - 0.5f);
    // a tile spans pixel centres 0.5 to 15.5; a gap between two tiles belongs to neither
    const I first = none ? I{} : tile_of(grid, x0 + 0.5f, width);
    const I last = none ? I{} - 1 : tile_of(grid, x1 - 0.5f, width);
    return in_square<Config>(grid, {first, last}, x, rx, width);
}

}  // namespace gamba::raster
