// The convolution on a CPU: sixteen channels as lanes, or of transposed rows sixteen tokens.
#include "../runtime/lanes.h"
namespace gamba::conv {

constexpr int WIDTH = 16;
// Each row is in another page, so no processor prefetches what the next task reads: the next lanes.
template<class T>
INLINE void prefetch_right(const Rows<T>& rows, int t) {
    __builtin_prefetch((char*)(rows.row(t) + WIDTH));
}
// Makes writes past the caches visible to other threads.
static inline void finish_stores() {
#if defined(__x86_64__)
    __builtin_ia32_sfence();
#endif
}

}  // namespace gamba::conv
#include "conv.h"
namespace gamba::conv {

// Of transposed rows the next task has the next tokens, whose lines these tokens share.
template<int TOKENS, class T>
INLINE void prefetch_down(const Rows<T>& rows, int t0, int t) {
    const int own = t - t0, lines = TOKENS * sizeof(T) / 64;
    __builtin_prefetch(
        (char*)rows.row(t0 + TOKENS) + own / lines * rows.across + own % lines * 64 + 63);
}

// Equation 1 where lanes are the tokens of a channel.
template<class Config, class In, class Out>
static void forward_transposed(int k, int task, const In& in, const Out& out) {
    const Piece p = piece_of<Config::TOKENS>(task, in.pieces, in.x.shape[1]);
    if (p.sequence < 0) return;
    const int d = k * WIDTH, width = in.x.shape[2] - d < WIDTH ? in.x.shape[2] - d : WIDTH;
    const auto x = rows_from(in.x, p.b, 0, d, width), y = rows_from(out.y, p.b, 0, d, width);
    const auto state = rows_from(in.state, p.sequence, 0, d, width);
    const Filter filters = filter_of(k, in.weight, in.bias);
    for (int i = 0; i < width; ++i) {
        const Filter filter = {splat(filters.w0[i]), splat(filters.w1[i]), splat(filters.w2[i]),
            splat(filters.w3[i]), splat(filters.bias[i])};
        F last = F{};
        for (int t = p.t0 - 3; t < p.t0; ++t) {
            float& before = ((float*)&last)[16 - p.t0 + t];
            if (t >= p.begin) before = read(x.channels(t, t + 1), i)[0];
            else if (in.state.shape[1] > 0) before = read(state, t - p.begin + 3)[i];
        }
        for (int t = p.t0; t < p.end; t += 16) {
            const auto channels = x.channels(t, p.end);
            const F x3 = read(channels, i);
            __builtin_prefetch(channels.row(i + 1));
            const F x2 = __builtin_shufflevector(
                last, x3, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30);
            const F x1 = __builtin_shufflevector(
                last, x3, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29);
            const F x0 = __builtin_shufflevector(
                last, x3, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28);
            F v = filter(x0, x1, x2, x3);
            if (in.use_silu) v = v * sigmoid(v);
            put(y.channels(t, p.end), i, v, in.stream);
            last = x3;
        }
    }
    if (in.stream && d + WIDTH >= in.x.shape[2]) finish_stores();
}

// Equation 2 of transposed rows, which are transposed again as they are read and written. Whole
// tiles are read before and behind for three tokens.
template<class Config, class In, class Out>
static void backward_transposed(int k, int task, const In& in, const Out& out) {
    constexpr int TOKENS = Config::TOKENS;
    const Piece p = piece_of<TOKENS>(task, in.pieces, in.x.shape[1]);
    if (p.sequence < 0) return;
    const int d = k * WIDTH, width = in.x.shape[2] - d < WIDTH ? in.x.shape[2] - d : WIDTH;
    const auto x_rows = rows_from(in.x, p.b, 0, d, width);
    const auto dout_rows = rows_from(in.dout, p.b, 0, d, width);
    const auto state = rows_from(in.state, p.sequence, 0, d, width);
    const auto dstate = rows_from(out.dstate, p.sequence, 0, d, width);
    F x_lanes[TOKENS + 32], dout_lanes[TOKENS + 16], dx_lanes[TOKENS];
    const int first = p.t0 == p.begin ? p.t0 : p.t0 - 16;
    const int last = p.end + 16 < p.stop ? p.end + 16 : p.stop;
    const Lanes x = gather(x_rows, first, last, x_lanes, sizeof(F));
    const Lanes dout = gather(dout_rows, p.t0, last, dout_lanes, sizeof(F));
    const Lanes dx = {(float*)dx_lanes, sizeof(F), p.t0, 16};
    const bool need_dx = out.dx.shape[1] > 0;
    auto prefetch = [&](int t) {
        prefetch_down<TOKENS>(x_rows, p.t0, t), prefetch_down<TOKENS>(dout_rows, p.t0, t);
    };
    F sums[5] = {};
    gradient<Config>(p, filter_of(k, in.weight, in.bias),
        window_before(p, x, state, in.state.shape[1] > 0), in.use_silu, x, dout, need_dx, dx,
        out.dstate.shape[1] > 0, dstate, prefetch, sums);
    auto dx_of = [&](int t) { return dx_lanes[t - p.t0]; };
    if (need_dx) scatter(rows_from(out.dx, p.b, 0, d, width), p.t0, p.end, dx_of, false);
    store_sums(task, k, in.weight.shape[1], sums, out.dweight);
}

}  // namespace gamba::conv
