// needs: kernels.py: y_out, use_silu, stream, AHEAD, WIDTH, x_in
// gives: the body of conv_forward
// Equation 1 for a strip of tokens.
#include "window.h"
const auto ys = rows_(y_out, b, 0, d, width);
auto step = [&](int t, F x3) {
    F y = fma_(w0, x0, fma_(w1, x1, fma_(w2, x2, fma_(w3, x3, bias))));
    if (use_silu) y = y * sigmoid_(y);
    put_(ys, t, y, stream);
    x0 = x1, x1 = x2, x2 = x3;
};
int t = t0;
#if defined(__CUDA_ARCH__)
// No load can pass a store, which might write its address: so the loads of some tokens come first.
for (; xs.whole && ys.whole && t + AHEAD <= end; t += AHEAD) {
    F ahead[AHEAD];
#pragma unroll
    for (int i = 0; i < AHEAD; ++i) ahead[i] = read_(xs, t + i);
#pragma unroll
    for (int i = 0; i < AHEAD; ++i) step(t + i, ahead[i]);
}
#endif
for (; t < end; ++t) {
    const F x3 = read_(xs, t);
    next_(xs, t);
    step(t, x3);
}
#if defined(__x86_64__) && !defined(__CUDA_ARCH__)  // the last channels of a row of tasks
if (stream && d + WIDTH >= x_in.shape[2]) __builtin_ia32_sfence();
#endif
