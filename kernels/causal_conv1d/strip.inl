// Equation 1 for ``count`` tokens and sixteen channels.
const auto xs = rows_(x_in, b, t0, d, width), ys = rows_(y_out, b, t0, d, width);
const F v0 = *(const F*)&w0, v1 = *(const F*)&w1, v2 = *(const F*)&w2, v3 = *(const F*)&w3;
const F v = *(const F*)&bias;
F x0 = *(const F*)&first, x1 = *(const F*)&second, x2 = *(const F*)&third;
for (int t = 0; t < count; ++t) {
    const F x3 = read_(xs, t);
    F y = fma_(v0, x0, fma_(v1, x1, fma_(v2, x2, fma_(v3, x3, v))));
    if (use_silu) y = y * sigmoid_(y);
    put_(ys, t, y, stream);
    x0 = x1, x1 = x2, x2 = x3;
}
#if defined(__x86_64__)  // the last channels of a row of tasks
if (stream && d + 16 >= x_in.shape[2]) __builtin_ia32_sfence();
#endif
