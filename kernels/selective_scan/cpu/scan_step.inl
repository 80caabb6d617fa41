// needs: native.py: task; step.py: blocks, dt_in, bias_in, use_softplus, x_in, skip_in, states,
//     b_in, c_in, a_in, state_out, logs, z_in, y_out; lanes.h: F, softplus_, LOG2E, exp2_, fma_,
//     sigmoid_
// gives: the body of scan_step
// Sixteen channels of one token; a state of sixteen numbers is one value.
const int b = task / blocks, d = task % blocks * 16, channels = blocks * 16;
#include "../../runtime/denormals.h"
typedef float Eight __attribute__((vector_size(32)));
typedef float Four __attribute__((vector_size(16)));
auto sum_lanes_ = [](F v) -> float {
    const Eight e = __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7)
        + __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
    const Four f =
        __builtin_shufflevector(e, e, 0, 1, 2, 3) + __builtin_shufflevector(e, e, 4, 5, 6, 7);
    return (f[0] + f[1]) + (f[2] + f[3]);
};
auto row_ = [&](auto& array) -> const float* {
    return (const float*)((const char*)array.data + (size_t)b * array.strides[0]);
};
F step = *(const F*)(row_(dt_in) + d);
if (bias_in.shape[0]) step += *(const F*)(bias_in.data + d);
if (use_softplus) step = softplus_(step);
const F u = *(const F*)(row_(x_in) + d), du = step * u, rate = step * LOG2E;
F y = skip_in.shape[0] ? *(const F*)(skip_in.data + d) * u : F{};
for (int n = 0; n < states; n += 16) {
    const F b_n = *(const F*)(row_(b_in) + n), c_n = *(const F*)(row_(c_in) + n);
    const float* a = a_in.data + (size_t)d * states + n;
    float* h = state_out.data + ((size_t)b * channels + d) * states + n;
    for (int c = 0; c < 16; ++c, a += states, h += states) {
        const F log = *(const F*)a;
        const F slope = logs ? -exp2_(log * LOG2E) : log;
        const F next = fma_(*(F*)h, exp2_(slope * rate[c]), b_n * du[c]);
        *(F*)h = next;
        y[c] += sum_lanes_(next * c_n);
    }
}
if (z_in.shape[0]) {
    const F z = *(const F*)(row_(z_in) + d);
    y *= z * sigmoid_(z);
}
*(F*)(y_out.data + (size_t)b * channels + d) = y;
