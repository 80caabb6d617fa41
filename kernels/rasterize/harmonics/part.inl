// needs: cuda.py: coefficients, row, first, COUNT, CHANNELS, WHOLE, LOAD, part
// gives: the body of load or store
// Copies what a row of coefficients [K, D] has for CHANNELS channels from ``first`` on, k by k. All
// channels of a row are adjacent numbers, and four of them one access where they are aligned.
const int stride = coefficients.shape[2], size = COUNT * CHANNELS;
float* const at = coefficients.data + (size_t)row * coefficients.shape[1] * stride + first;
struct alignas(16) Four {
    float v[4];
};
auto copy = [](float& there, float& here) {
    if constexpr (LOAD) here = there;
    else there = here;
};
#if LOAD
wp::vec_t<COUNT * CHANNELS, float> part;
#endif
if (WHOLE && size % 4 == 0 && ((size_t)at & 15) == 0) {
    WP_PRAGMA_UNROLL
    for (int i = 0; i < size / 4; ++i) {
        Four four = {};
        if constexpr (LOAD) four = ((Four*)at)[i];
        WP_PRAGMA_UNROLL
        for (int j = 0; j < 4; ++j) copy(four.v[j], part.c[4 * i + j]);
        if constexpr (!LOAD) ((Four*)at)[i] = four;
    }
} else {
    WP_PRAGMA_UNROLL
    for (int i = 0; i < size; ++i) copy(at[i / CHANNELS * stride + i % CHANNELS], part.c[i]);
}
#if LOAD
return part;
#endif
