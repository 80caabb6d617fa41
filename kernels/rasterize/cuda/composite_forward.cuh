// Compositing front to back over the pairs of a tile (README §3), a warp for each part of a tile.
#include "tile.cuh"
namespace gamba::raster {

// Shared memory of a warp: of the next 32 Gaussians of a list, those that touch a sub-tile.
struct Batch {
    Record records[WARP];
    int bits[WARP];   // of the pairs that were evaluated: blocks and stops
    int masks[WARP];  // by lanes: the sub-tiles that the lane's Gaussian touches
};

// A lane's pixels.
template<class K>
struct Blend {
    float T[PIXELS<K>] = {};  // positive where one continues, negative where it stopped, 0 outside
    float sums[PIXELS<K>][K::CHANNELS] = {};
    int live;  // bits of the sub-tiles where a pixel of some lane continues

    template<class Params>
    Blend(const Place<K>& p, const Params& params) {
        int inside = 0;
        WP_PRAGMA_UNROLL
        for (int j = 0; j < PIXELS<K>; ++j) {
            const int x = p.px + j % 2 * WIDTH, y = p.py + j / 2 * HEIGHT;
            if (x >= params.width || y >= params.height) continue;
            T[j] = 1.0f;
            inside |= 1 << j;
        }
        live = any_of(inside);
    }
};

// Each lane tests Gaussian k0 + lane of the list, and copies its record to shared memory if it
// touches a living sub-tile: ``count`` of them do. Returns the place of the lane's own, or -1.
template<class K, class Params, class Gaussians, class Lists>
static int load_batch(Batch& batch, const Place<K>& p, const Params& params,
    const Gaussians& gaussians, const Lists& lists, int k0, int end, int live, int& count) {
    const int k = min(k0 + p.lane, end - 1);  // past the end, the last one
    const float* const from = record_at(gaussians, lists.pairs.data[k]);
    const Shape shape = *(const Shape*)from;
    Level level = *(const Level*)(from + 4);
    int mask = live;
    if (params.skip & K::BLOCK_TEST) mask &= touched(p, shape, level);
    if (k != k0 + p.lane) mask = 0;
    batch.masks[p.lane] = mask;
    const int some = __ballot_sync(ALL, mask != 0);
    count = __popc(some);
    if (mask == 0) return -1;
    const int slot = __popc(some & ((1 << p.lane) - 1));
    level.limit = __int_as_float(mask);
    batch.records[slot] = {shape, level, *(const Four*)(from + 8 + gaussians.first)};
    return slot;
}

// Blends a Gaussian into the lane's pixels (eq. 7) in the sub-tiles that it touches. Returns the
// bits of blocks that it changed, of all lanes, and of pixels that stop at it, which are not
// changed yet: ``stopped`` are the lane's own.
template<class K, class Params>
static int blend_pair(
    Blend<K>& blend, const Place<K>& p, const Params& params, const Record& record, int& stopped) {
    const int mask = blend.live & record.bits();
    int used = 0;
    stopped = 0;
    WP_PRAGMA_UNROLL
    for (int j = 0; j < PIXELS<K>; ++j) {
        if (!(mask & 1 << j)) continue;
        const Sample s(record, p.x[j % 2], p.y[j / 2]);
        float& T = blend.T[j];
        const float weight = T * fminf(s.alpha, params.alpha_max), after = T - weight;
        if (!(s.alpha >= params.alpha_min && T > 0.0f)) continue;
        if (after > params.t_min) {
            used += 1 << first_block(j);
            T = after;
            for (int c = 0; c < K::CHANNELS; ++c) blend.sums[j][c] += weight * record.color.of[c];
        } else {
            stopped += 1 << (STOP + j);
        }
    }
    const int half = p.lane / 4 % 2;  // which of a sub-tile's two blocks of 4 x 4 pixels
    return any_of(used << half | stopped);
}

// Stops pixels at pair k, where ``bits`` are those of all lanes.
template<class K, class Params, class Saved>
static void stop_pixels(Blend<K>& blend, const Place<K>& p, const Params& params,
    const Saved& saved, int bits, int stopped, int k) {
    int* const stops = saved.stops.data + p.saved;
    WP_PRAGMA_UNROLL
    for (int j = 0; j < PIXELS<K>; ++j) {
        if (!(bits & 1 << (STOP + j))) continue;
        if (stopped & 1 << (STOP + j)) {
            blend.T[j] = -blend.T[j];
            stops[j * WARP] = k;
        }
        const bool over = __ballot_sync(ALL, blend.T[j] > 0.0f) == 0;
        if (over && params.skip & K::STOPPED) blend.live &= ~(1 << j);
    }
}

// Stores the bits of a pair, or combines them over the parts that share it.
template<class K>
static void save_bits(int* at, int bits, int part) {
    if constexpr (K::PARTS == 1) {
        *at = bits;
    } else {
        const int used = (bits & BLOCKS) << part * (16 / K::PARTS);
        atomicOr(at, used | (bits & ~BLOCKS) << part * PIXELS<K>);
    }
}

template<class K, class Params, class Gaussians, class Saved, class Pixels>
static void store_pixels(const Blend<K>& blend, const Place<K>& p, const Params& params,
    const Gaussians& gaussians, const Saved& saved, const Pixels& pixels) {
    float* const transmittances = saved.transmittances.data + p.saved;
    WP_PRAGMA_UNROLL
    for (int j = 0; j < PIXELS<K>; ++j) {
        const float T = blend.T[j];
        transmittances[j * WARP] = T;
        if (T == 0.0f) continue;
        pixels.transmittances.data[p.pixel + p.step(j, params.width)] = fabsf(T);
        float* const render = channels_of(pixels.renders, p, j, params, gaussians);
        for (int c = 0; c < K::CHANNELS; ++c) render[c] = blend.sums[j][c];
    }
}

// The kernel: a warp traverses the list of its tile, 32 Gaussians at a time.
template<class K, class Params, class Gaussians, class Lists, class Saved, class Pixels>
static void composite(int index, int lane, float* shared, const Params& params,
    const Gaussians& gaussians, const Lists& lists, const Saved& saved, const Pixels& pixels) {
    static_assert(sizeof(Batch) == 4 * K::SHARED, "kernels.py computes the size");
    Batch& batch = *(Batch*)shared;
    const Place<K> p(params, index, lane);
    Blend<K> blend(p, params);
    int k0 = lists.starts.data[p.tile], end = lists.starts.data[p.tile + 1];
    if (blend.live == 0) end = k0;
    int evaluated = 0;
    for (; k0 < end; k0 += WARP) {
        int count;
        const int slot = load_batch(batch, p, params, gaussians, lists, k0, end, blend.live, count);
        __syncwarp();
        for (int i = 0; i < count; ++i) {
            int stopped;
            const Record record = batch.records[i];
            const int bits = blend_pair(blend, p, params, record, stopped);
            batch.bits[i] = bits;
            if (bits >> STOP == 0) continue;
            const int k = k0 + highest_bit(__ballot_sync(ALL, slot == i));
            stop_pixels(blend, p, params, saved, bits, stopped, k);
            if (slot > i) batch.masks[lane] &= blend.live;
            if (blend.live == 0) end = k + 1, count = i + 1;
        }
        __syncwarp();
        evaluated += __popc(batch.masks[lane]);
        const int bits = slot >= 0 && slot < count ? batch.bits[slot] : 0;
        if (bits) save_bits<K>(saved.blocks.data + k0 + lane, bits, p.part);
    }
    if (lane == 0) atomicMax(&saved.traversed.data[p.tile], end - lists.starts.data[p.tile]);
    if (evaluated != 0 && gaussians.first == 0)
        wp::atomic_add(&saved.blocks_traversed.data[p.tile], (wp::int64)evaluated);
    store_pixels(blend, p, params, gaussians, saved, pixels);
}

}  // namespace gamba::raster
