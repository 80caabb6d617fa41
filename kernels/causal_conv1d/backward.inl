// needs: kernels.py: dout_in, dx_out, dstate_out, use_silu, RUN, AHEAD, dweight_out, task, k
// gives: the body of conv_backward
// Equation 2 for a chunk of tokens. dx of token t needs the gradients g of t to t + 3: the loop
// runs three tokens behind.
#include "window.h"
const auto dout_rows = rows_(dout_in, b, 0, d, width);
#if TRANSPOSED
// Turned as they are read and written. Whole tiles are read before and behind for three tokens.
F x_lanes[PIECE + 32], dout_lanes[PIECE + 16], dx_lanes[PIECE];
const int first = t0 == begin ? t0 : t0 - 16, last = end + 16 < stop ? end + 16 : stop;
const auto xs = gather_(rows, first, last, x_lanes, sizeof(F));
const auto douts = gather_(dout_rows, t0, last, dout_lanes, sizeof(F));
const Lanes dxs = {(float*)dx_lanes, sizeof(F), t0, 16};
#else
const auto &xs = rows, &douts = dout_rows;
const auto dxs = rows_(dx_out, b, 0, d, width);
#endif
start(xs);
const auto dstates = rows_(dstate_out, own, 0, d, width);
F g0 = F{}, g1 = F{}, g2 = F{}, sums[5] = {}, run[5] = {};
auto complete = [&] {
    for (int i = 0; i < 5; ++i) sums[i] = sums[i] + run[i], run[i] = F{};
};
auto step = [&](int t, F x3, F g3, bool inside, bool own) {
    if (inside) {
        if (use_silu) {
            const F y = fma_(w0, x0, fma_(w1, x1, fma_(w2, x2, fma_(w3, x3, bias))));
            const F s = sigmoid_(y);
            g3 = g3 * fma_(y * s, one - s, s);
        }
        if (own) {
            run[0] = fma_(g3, x0, run[0]), run[1] = fma_(g3, x1, run[1]);
            run[2] = fma_(g3, x2, run[2]), run[3] = fma_(g3, x3, run[3]);
            run[4] = run[4] + g3;
        }
    }
    const F dx = fma_(w3, g0, fma_(w2, g1, fma_(w1, g2, w0 * g3)));
    if (t - 3 >= t0) {
        if (dx_out.shape[1] > 0) write_(dxs, t - 3, dx);
    } else if (t - begin < 3 && dstate_out.shape[1] > 0) write_(dstates, t - begin, dx);
    x0 = x1, x1 = x2, x2 = x3;
    g0 = g1, g1 = g2, g2 = g3;
    if (RUN > 0 && (t - t0) % RUN == RUN - 1) complete();
};
int t = t0;
#if defined(__CUDA_ARCH__)  // as in the forward
for (; xs.whole && douts.whole && dxs.whole && t + AHEAD <= end; t += AHEAD) {
    F xs_ahead[AHEAD], gs_ahead[AHEAD];
#pragma unroll
    for (int i = 0; i < AHEAD; ++i)
        xs_ahead[i] = read_(xs, t + i), gs_ahead[i] = read_(douts, t + i);
#pragma unroll
    for (int i = 0; i < AHEAD; ++i) step(t + i, xs_ahead[i], gs_ahead[i], true, true);
}
#endif
for (; t < end + 3; ++t) {
    F x3 = x2, g3 = F{};
    if (t < stop) {
        x3 = read_(xs, t), g3 = read_(douts, t);
        next_(rows, t), next_(dout_rows, t);
    }
    step(t, x3, g3, t < stop, t < end);
}
complete();
#if TRANSPOSED
auto dx_of = [&](int t) { return dx_lanes[t - t0]; };
if (dx_out.shape[1] > 0) scatter_(rows_(dx_out, b, 0, d, width), t0, end, dx_of, false);
#endif
F* const dweight = (F*)dweight_out.data + (size_t)task * 5 * taps + k;
if (dweight_out.shape[1] > 0)
    for (int i = 0; i < 5; ++i) dweight[i * taps] = sums[i];
