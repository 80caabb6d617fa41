// needs: kernels.py: y_out, use_silu, stream, AHEAD, WIDTH, x_in, TRANSPOSED
// gives: the body of conv_forward
// Equation 1 for a strip of tokens.
#include "window.h"
const auto ys = rows_(y_out, b, 0, d, width);
#if TRANSPOSED  // lanes are the tokens of a channel
for (int i = 0; i < width; ++i) {
    auto tap = [&](const F* row) { return splat(((const float*)row)[i]); };
    const F w0 = tap(w), w1 = tap(w + taps), w2 = tap(w + 2 * taps), w3 = tap(w + 3 * taps);
    const F bias = tap((const F*)bias_in.data + k);
    F last = F{};
    for (int t = t0 - 3; t < t0; ++t) {
        float& x = ((float*)&last)[16 - t0 + t];
        if (t >= begin) x = read_(rows.channels(t, t + 1), i)[0];
        else if (state_in.shape[1] > 0) x = read_(before, t - begin + 3)[i];
    }
    for (int t = t0; t < end; t += 16) {
        const auto channels = rows.channels(t, end);
        const F x3 = read_(channels, i);
        __builtin_prefetch(channels.row(i + 1));
        const F x2 = __builtin_shufflevector(
            last, x3, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30);
        const F x1 = __builtin_shufflevector(
            last, x3, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29);
        const F x0 = __builtin_shufflevector(
            last, x3, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28);
        F y = fma_(w0, x0, fma_(w1, x1, fma_(w2, x2, fma_(w3, x3, bias))));
        if (use_silu) y = y * sigmoid_(y);
        put_(ys.channels(t, end), i, y, stream);
        last = x3;
    }
}
#else
start(rows);
auto step = [&](int t, F x3) {
    F y = fma_(w0, x0, fma_(w1, x1, fma_(w2, x2, fma_(w3, x3, bias))));
    if (use_silu) y = y * sigmoid_(y);
    put_(ys, t, y, stream);
    x0 = x1, x1 = x2, x2 = x3;
};
int t = t0;
#if defined(__CUDA_ARCH__)
// No load can pass a store, which might write its address: so the loads of some tokens come first.
for (; rows.whole && ys.whole && t + AHEAD <= end; t += AHEAD) {
    F ahead[AHEAD];
#pragma unroll
    for (int i = 0; i < AHEAD; ++i) ahead[i] = read_(rows, t + i);
#pragma unroll
    for (int i = 0; i < AHEAD; ++i) step(t + i, ahead[i]);
}
#endif
for (; t < end; ++t) {
    const F x3 = read_(rows, t);
    next_(rows, t);
    step(t, x3);
}
#endif
#if defined(__x86_64__) && !defined(__CUDA_ARCH__)  // the last channels of a row of tasks
if (stream && d + WIDTH >= x_in.shape[2]) __builtin_ia32_sfence();
#endif
