// Which tiles Gaussians touch: lanes are Gaussians, or rows of tiles of one Gaussian. A task has
// whole groups of 16 Gaussians of a view, in the order of `lists.order`, or else of their index.
#include "lanes.h"

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
// first and last row with a pixel centre (at +0.5) in reach, with a pixel to spare
auto top_ = [&](F y, F reach) -> I { return tile_(y - reach - 1.0f, high); };
auto bottom_ = [&](F y, F reach) -> I { return tile_(y + reach + 1.0f, high); };
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
};
// `visit(row, first, last)` for each row of tiles that Gaussian i touches: lanes are its rows
auto rows_ = [&](int i, auto visit) {
    const float* const m = (const float*)splats.means2d.data + (size_t)i * 2;
    const float* const c = (const float*)splats.conics.data + (size_t)i * 3;
    const float* const r = (const float*)splats.extents.data + (size_t)i * 2;
    const Ellipse E = ellipse_(splat(m[0]), splat(m[1]), splat(c[0]), splat(c[1]), splat(c[2]),
        splat(splats.opacities.data[i]), splat(r[0]));
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
// Words hold the bits of four Gaussians, so that a loop over them seldom ends.
typedef unsigned long long Word;
const int within[16] = {0, 1, 2, 3, tiles_x, tiles_x + 1, tiles_x + 2, tiles_x + 3, 2 * tiles_x,
    2 * tiles_x + 1, 2 * tiles_x + 2, 2 * tiles_x + 3, 3 * tiles_x, 3 * tiles_x + 1,
    3 * tiles_x + 2, 3 * tiles_x + 3};
auto corners_of = [&](int g) -> int* { return work.corners.data + (size_t)g * 16; };
auto words_of = [&](int g) -> Word* { return (Word*)(work.windows.data + (size_t)g * 16); };
