// The gradient of the blending: a worker walks the lists of tile after tile back to front, and
// writes a row of sums for each intersection: six moments of h (README eq. 11), if ABSOLUTE the two
// sums of eq. 14, then the colours.
#include "tile.h"

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
    const int begin = lists.starts.data[index], end = begin + walk.walked.data[index];
    const int every = begin < end ? tile.inside : 0;
    I nonzero = I{};
    for (int bits = every; bits; bits &= bits - 1) {
        const int b = __builtin_ctz(bits);
        F* const v = v_pixels + b * (channels + 1);
        for (int c = 0; c <= channels; ++c) v[c] = F{};
        pixels_of(tile, b, [&](int l, size_t pixel) {
            for (int c = 0; c < channels; ++c) v[c][l] = pixels.renders.data[pixel * channels + c];
            v[channels][l] = pixels.alphas.data[pixel];
        });
        for (int c = 0; c <= channels; ++c) nonzero |= v[c] != 0.0f;
    }
    const bool wanted = any_(nonzero) || (every && !(picture.skip & ZERO_UPSTREAM));
    int& skipped = rows.skipped.data[index];
    skipped = wanted ? 2 : skipped > 1 ? skipped : 1;
    if (!wanted) continue;
    F Ts[BLOCKS], Rs[BLOCKS];  // transmittance, and what lies behind
    const I* const stops = (const I*)walk.stops.data + tile.first;
    for (int b = 0; b < BLOCKS; ++b) {
        const F T = ((const F*)walk.transmittances.data)[tile.first + b];
        Ts[b] = T < 0.0f ? -T : T;
        Rs[b] = F{};
    }
    for (int k = end - 1; k >= begin; --k) {
        const int later = k - AHEAD > begin ? k - AHEAD : begin;
        if (walk.blocks.data[later]) {  // rows are in the order of the Gaussians
            const int row = lists.rows.data[later];
            const char* const sums = (const char*)(rows.sums.data + (size_t)row * row_length);
            __builtin_prefetch(sums, 1);
            __builtin_prefetch(sums + row_length * 4 - 1, 1);
            __builtin_prefetch(rows.written.data + row, 1);
            fetch(lists.pairs.data[later]);
        }
        int bits = picture.skip & UNUSED ? walk.blocks.data[k] : every;
        if (!bits) continue;
        const Splat s = splat_of(lists.pairs.data[k], tile);
        F h0 = {}, hu = {}, hy = {}, huu = {}, huy = {}, hyy = {}, across = {}, along = {};
        const float* const conic = (const float*)(splats.conics.data + lists.pairs.data[k]);
        const F ak = splat(conic[0] * conic[1]), e = splat(conic[2]);
        for (int c = 0; c < channels; ++c) v_colors[c] = F{};
        for (; bits; bits &= bits - 1) {
            const int b = __builtin_ctz(bits);
            const F U = u_of(s, b), V = v_of(s, b);
            F alpha = alpha_of(s, U, V);
            alpha = ((alpha >= picture.alpha_min) & (stops[b] > k))
                ? min_(alpha, F{} + picture.alpha_max)
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
                const F h = alpha < picture.alpha_max ? weight * diff : F{};
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
