// Equation 1 for a strip of tokens.
#include "window.h"
const auto ys = rows_(y_out, b, 0, d, width);
auto step = [&](int t, F x3) {
    F y = fma_(w0, x0, fma_(w1, x1, fma_(w2, x2, fma_(w3, x3, bias))));
    if (use_silu) y = y * sigmoid_(y);
    put_(ys, t, y, stream);
    x0 = x1, x1 = x2, x2 = x3;
};
#if WIDTH == 1
// No load can pass a store, which might write what it reads: so all loads come first.
F ahead[PIECE];
#pragma unroll
for (int i = 0; i < PIECE; ++i) ahead[i] = read_(xs, t0 + i < end ? t0 + i : end - 1);
#pragma unroll
for (int i = 0; i < PIECE; ++i)
    if (t0 + i < end) step(t0 + i, ahead[i]);
#else
for (int t = t0; t < end; ++t) {
    const F x3 = read_(xs, t);
    next_(xs, t);
    step(t, x3);
}
#endif
#if defined(__x86_64__) && WIDTH > 1  // the last channels of a row of tasks
if (stream && d + WIDTH >= x_in.shape[2]) __builtin_ia32_sfence();
#endif
