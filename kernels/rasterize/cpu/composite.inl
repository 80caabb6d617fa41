// A worker blends tile after tile, front to back. Of each Gaussian the blocks are tested at once
// (lanes = blocks), and those that its ellipse touches are evaluated (lanes = pixels).
#include "tile.h"

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
    const float widened = 2.0f * wp::log(splats.opacities.data[g] / picture.alpha_min) * SLACK;
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
    walk.walked.data[index] = 0;
    walk.blocks_walked.data[index] = 0;
    if (begin == end && picture.skip & EMPTY_TILES) continue;
    const Tile tile = tile_at(index);
    // A pixel that has stopped keeps its transmittance, above t_min, with a minus sign. T itself is
    // not chosen by a mask: that would become a masked store, for which the next load had to wait.
    F* const Ts = (F*)walk.transmittances.data + tile.first;
    I* const stops = (I*)walk.stops.data + tile.first;
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
        walk.blocks.data[k] = used;
    }
    walk.walked.data[index] = k - begin;
    walk.blocks_walked.data[index] = evaluated;
    for (int b = 0; b < BLOCKS; ++b)
        pixels_of(tile, b, [&](int l, size_t pixel) {
            const float T = Ts[b][l];
            pixels.alphas.data[pixel] = 1.0f - (T < 0.0f ? -T : T);
            for (int c = 0; c < channels; ++c)
                pixels.renders.data[pixel * channels + c] = sums[b * channels + c][l];
        });
}
