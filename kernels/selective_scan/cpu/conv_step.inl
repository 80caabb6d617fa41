// needs: native.py: task; step.py: blocks, x_in, weight_in, taps, state_out, bias_in, y_out,
//     use_silu; lanes.h: F, sigmoid_
// gives: the body of conv_step
// Sixteen channels of one token: each is convolved with the tokens seen, which are then shifted.
const int b = task / blocks, d = task % blocks * 16, channels = blocks * 16;
const float* x = (const float*)((const char*)x_in.data + (size_t)b * x_in.strides[0]) + d;
const float* w = weight_in.data + (size_t)d * taps;
float* seen = state_out.data + ((size_t)b * channels + d) * taps;
F sum = bias_in.shape[0] ? *(const F*)(bias_in.data + d) : F{};
for (int c = 0; c < 16; ++c, seen += taps, w += taps) {
    float old = 0.0f;
    for (int k = 0; k < taps - 1; ++k) {
        seen[k] = seen[k + 1];
        old += seen[k] * w[k];
    }
    seen[taps - 1] = x[c];
    sum[c] += old + x[c] * w[taps - 1];
}
*(F*)(y_out.data + (size_t)b * channels + d) = use_silu ? sum * sigmoid_(sum) : sum;
