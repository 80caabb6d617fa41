// Compositing's gradient, back to front over the pairs of a tile (README §5): a block for each
// tile, a warp for each of its parts. Each pair gets a row of sums.
#include "tile.cuh"
namespace gamba::raster {

// Columns of a row, of a launch's channels: the six moments of h (eq. 11), with ABSOLUTE the two
// sums of absolute values (eq. 14), and the colours. The first HEAD of them are in ``heads``, the
// others in ``tails``. Without GEOMETRY only the colours are summed. Without CHANNELS only the
// moments are, for all channels of the image.
template<class K>
struct Row {
    static constexpr int COLOR = K::ABSOLUTE ? 8 : 6;  // column of the first colour
    static constexpr int MOMENTS = K::GEOMETRY ? COLOR : 0;
    static constexpr int SUMS = MOMENTS + K::CHANNELS, END = COLOR + K::CHANNELS;
    // vectors of four columns that are written
    static constexpr int FIRST = K::GEOMETRY ? 0 : COLOR / 4, LAST = (END - 1) / 4;
    static constexpr int SLOTS =
        WARP / SUMS;  // pairs that are completed at once, a sum by each lane
};
// Floats from one sum to the next: the lanes' terms, aligned, and without bank conflicts.
constexpr int PITCH = WARP + 4;

// Shared memory of a warp.
template<class K>
struct Part {
    Record records[WARP];  // of 32 pairs; completed, a pair's sums are in their place
    int pairs[WARP];       // those whose sums are in the slots
    float sums[Row<K>::SLOTS][Row<K>::SUMS][PITCH];
    float* columns(int pair) { return (float*)&records[pair]; }
};

template<class K>
static void sync_tile() {
    if constexpr (K::PARTS == 1) __syncwarp();
    else __syncthreads();
}

// A lane's pixels.
template<class K>
struct Pixels {
    float T[PIXELS<K>] = {};  // as forward left it, negative until the pair where the pixel stopped
    float R[PIXELS<K>] = {};  // of eq. 10, plus the gradient of T_end, the same for all pairs
    float upstream[PIXELS<K>][K::CHANNELS > 0 ? K::CHANNELS : 1] = {};
};

// Loads them, and returns the bits of the blocks whose upstream gradient is not 0.
template<class K, class Params, class Gaussians, class Saved, class Upstream>
static int load_pixels(Pixels<K>& pixels, const Place<K>& p, const Params& params,
    const Gaussians& gaussians, const Saved& saved, const Upstream& v_pixels, int traversed) {
    const float* const transmittances = saved.transmittances.data + p.saved;
    // no Gaussian reached a pixel whose T is 1, unless fainter ones than float32 resolves count
    const float untouched = params.alpha_min > 1e-6f ? 1.0f : 0.0f;
    int some = 0;
    WP_PRAGMA_UNROLL
    for (int j = 0; j < PIXELS<K>; ++j) {
        if (traversed > 0) pixels.T[j] = transmittances[j * WARP];
        if (pixels.T[j] == 0.0f || pixels.T[j] == untouched) continue;
        float largest = 0.0f;
        if (gaussians.first == 0) {
            pixels.R[j] = v_pixels.transmittances.data[p.pixel + p.step(j, params.width)];
            largest += fabsf(pixels.R[j]);
        }
        const float* const v = channels_of(v_pixels.renders, p, j, params, gaussians);
        for (int c = 0; c < K::CHANNELS; ++c) {
            pixels.upstream[j][c] = v[c];
            largest += fabsf(v[c]);
        }
        if constexpr (K::CHANNELS == 0)
            for (int c = 0; c < gaussians.channels; ++c) largest += fabsf(v[c]);
        // NaN does not count as zero
        if (!(largest <= 0.0f)) some |= 3 << first_block(j);
    }
    return params.skip & K::ZERO_UPSTREAM ? some : (1 << 16 / K::PARTS) - 1;
}

// The bits of the whole tile, of which each part has its own.
template<class K>
static int of_tile(Part<K>* parts, int part, int bits) {
    if constexpr (K::PARTS == 1) return bits;
    parts[part].pairs[0] = bits << part * (16 / K::PARTS);
    sync_tile<K>();
    bits = 0;
    for (int i = 0; i < K::PARTS; ++i) bits |= parts[i].pairs[0];
    sync_tile<K>();
    return bits;
}

// Returns those bits of pair k that are the part's: its ``wanted`` blocks, and stops. If there are
// any, the pair's record goes to shared memory.
template<class K, class Params, class Gaussians, class Lists>
static int load_pair(Record& record, const Place<K>& p, const Params& params,
    const Gaussians& gaussians, const Lists& lists, int k, int bits, int wanted) {
    const int stops = bits >> p.part * PIXELS<K> & ((1 << PIXELS<K>)-1) << STOP;
    bits = bits >> p.part * (16 / K::PARTS) & wanted | stops;
    if (bits != 0) {
        const int g = lists.pairs.data[k];
        const float* const from = record_at(gaussians, g);
        record.shape = *(const Shape*)from;
        Level level = *(const Level*)(from + 4);
        level.limit = __int_as_float(bits);
        record.level = level;
        if constexpr (K::CHANNELS == 0) record.color = {__int_as_float(g)};  // to find its colours
        else record.color = *(const Four*)(from + 8 + gaussians.first);
    } else if (K::PARTS > 1) {  // no sums, but some of another part's
        record = {};
    }
    return bits;
}

// Adds a pixel's h to the moments (eq. 11), and to the sums of absolute values (eq. 14).
template<class K>
static void add_moments(
    float (&sums)[Row<K>::SUMS], const Sample& s, float h, const Record& record) {
    const float a = record.shape.a, k = record.shape.k, e = record.level.e;
    const float hu = h * s.u, hy = h * s.dy;
    sums[0] += h;
    sums[1] += hu;
    sums[2] += hy;
    sums[3] += hu * s.u;
    sums[4] += hu * s.dy;
    sums[5] += hy * s.dy;
    if constexpr (K::ABSOLUTE) {
        sums[6] += fabsf(hu);
        sums[7] += fabsf(a * k * hu + e * hy);
    }
}

// Adds the terms of a pair in the lane's pixels (eq. 10), whose T and R are then those in front of
// its Gaussian.
template<class K, class Params, class Gaussians, class Upstream>
static void add_pair(float (&sums)[Row<K>::SUMS], Pixels<K>& pixels, const Place<K>& p,
    const Params& params, const Gaussians& gaussians, const Upstream& v_pixels,
    const Record& record) {
    const int bits = record.bits();
    WP_PRAGMA_UNROLL
    for (int j = 0; j < PIXELS<K>; ++j) {
        if (!(bits & 3 << first_block(j))) continue;
        const Sample s(record, p.x[j % 2], p.y[j / 2]);
        const float clamped = fminf(s.alpha, params.alpha_max);
        float &T = pixels.T[j], &R = pixels.R[j];
        if (!(s.alpha >= params.alpha_min && T > 0.0f)) continue;
        T = T * reciprocal(1.0f - clamped);
        const float weight = T * clamped;
        for (int c = 0; c < K::CHANNELS; ++c)
            sums[Row<K>::MOMENTS + c] += weight * pixels.upstream[j][c];
        if constexpr (K::GEOMETRY) {
            float diff = -R;
            for (int c = 0; c < K::CHANNELS; ++c)
                diff = fmaf(record.color.of[c], pixels.upstream[j][c], diff);
            if constexpr (K::CHANNELS == 0) {
                const int g = __float_as_int(record.color.of[0]);
                const float* const colors = record_at(gaussians, g) + 8;
                const float* const v = channels_of(v_pixels.renders, p, j, params, gaussians);
                for (int c = 0; c < gaussians.channels; ++c) diff = fmaf(colors[c], v[c], diff);
            }
            R = R + clamped * diff;
            if (K::PASSES || s.alpha < params.alpha_max) {
                const float h = K::PASSES ? T * s.alpha * diff : weight * diff;
                add_moments<K>(sums, s, h, record);
            }
        }
    }
}

// Adds up the sums of ``count`` pairs over the lanes: each lane completes one.
template<class K>
static void complete(Part<K>& part, int lane, int count) {
    if (lane >= count * Row<K>::SUMS) return;
    const Four* const from = (const Four*)(part.sums[0][0] + lane * PITCH);
    Four total = from[0];
    WP_PRAGMA_UNROLL
    for (int i = 1; i < WARP / 4; ++i) total += from[i];
    int column = lane % Row<K>::SUMS;
    if (column >= Row<K>::MOMENTS) column += Row<K>::COLOR - Row<K>::MOMENTS;
    part.columns(part.pairs[lane / Row<K>::SUMS])[column] =
        (total.of[0] + total.of[1]) + (total.of[2] + total.of[3]);
}

// Pixels that stopped at pair k contribute from the next pair on.
template<class K, class Saved>
static void resume_pixels(
    Pixels<K>& pixels, const Place<K>& p, const Saved& saved, int bits, int k) {
    const int* const stops = saved.stops.data + p.saved;
    WP_PRAGMA_UNROLL
    for (int j = 0; j < PIXELS<K>; ++j)
        if (bits & 1 << (STOP + j) && pixels.T[j] < 0.0f && stops[j * WARP] == k)
            pixels.T[j] = -pixels.T[j];
}

// Each lane adds up a pair's sums over the parts; each part has some of the columns.
template<class K, class Gaussians, class Rows>
static void store_row(
    Part<K>* parts, const Place<K>& p, const Gaussians& gaussians, const Rows& rows, int row) {
    typedef Row<K> R;
    const int first = opaque(gaussians.first);  // no registers hold what follows from it
    WP_PRAGMA_UNROLL
    for (int n = R::FIRST; n <= R::LAST; ++n) {
        if (p.part != (n - R::FIRST) % K::PARTS) continue;
        Four total = ((Four*)parts[0].columns(p.lane))[n];
        for (int i = 1; i < K::PARTS; ++i) total += ((Four*)parts[i].columns(p.lane))[n];
        if (n < K::HEAD / 4) {
            float* const head = rows.heads.data + wide(row, rows.heads.shape[1]);
            ((Four*)(head + wide(first, K::HEAD / CHUNK)))[n] = total;
        } else {
            float* const tail = rows.tails.data + wide(row, rows.tails.shape[1]);
            constexpr int STEP = R::COLOR + CHUNK - K::HEAD;  // of a whole chunk
            for (int c = 0; c < R::END - K::HEAD; ++c) tail[first / CHUNK * STEP + c] = total.of[c];
        }
    }
    if (p.part == 0) atomicOr(&rows.written.data[row >> 5], 1 << (row & 31));
}

// The kernel: a block traverses the list of its tile backwards, 32 pairs at a time.
template<class K, class Params, class Gaussians, class Lists, class Saved, class Upstream,
    class Rows>
static void composite_vjp(int index, int lane, float* shared, const Params& params,
    const Gaussians& gaussians, const Lists& lists, const Saved& saved, const Upstream& v_pixels,
    const Rows& rows) {
    static_assert(K::PARTS * sizeof(Part<K>) == 4 * K::SHARED, "kernels.py computes the size");
    const Place<K> p(params, index, lane);
    Part<K>* const parts = (Part<K>*)shared;
    Part<K>& own = parts[p.part];
    Pixels<K> pixels;
    int traversed = saved.traversed.data[p.tile];
    // blocks whose upstream gradient is not 0: the part's, and the whole tile's
    const int wanted =
        any_of(load_pixels(pixels, p, params, gaussians, saved, v_pixels, traversed));
    const int of_all = of_tile(parts, p.part, wanted);
    if (of_all == 0) traversed = 0;
    if (lane == 0) atomicMax(&rows.skipped.data[p.tile], traversed > 0 ? 2 : 1);

    const int begin = lists.starts.data[p.tile];
    for (int end = begin + traversed; end > begin; end -= WARP) {
        const int k = end - WARP + lane;
        int bits = 0;
        if (k >= begin) {
            bits = saved.blocks.data[k];
            if (!(params.skip & K::UNUSED)) bits |= of_all;
            bits = load_pair(own.records[lane], p, params, gaussians, lists, k, bits, wanted);
        }
        int waiting = 0;
        int todo = __ballot_sync(ALL, bits != 0);
        __syncwarp();
        while (todo != 0) {
            const int i = highest_bit(todo);
            todo ^= 1 << i;
            const Record record = own.records[i];
            float sums[Row<K>::SUMS] = {};
            add_pair(sums, pixels, p, params, gaussians, v_pixels, record);
            for (int v = 0; v < Row<K>::SUMS; ++v) own.sums[waiting][v][lane] = sums[v];
            own.pairs[waiting] = i;
            if (++waiting == Row<K>::SLOTS) {
                __syncwarp();
                complete(own, lane, waiting);
                __syncwarp();
                waiting = 0;
            }
            const int bits = record.bits();
            if (bits >> STOP != 0) resume_pixels(pixels, p, saved, bits, end - WARP + i);
        }
        __syncwarp();
        complete(own, lane, waiting);
        sync_tile<K>();
        if (k >= begin && of_all & saved.blocks.data[k])
            store_row(parts, p, gaussians, rows, lists.rows.data[k]);
        if constexpr (K::PARTS > 1) sync_tile<K>();
    }
}

}  // namespace gamba::raster
