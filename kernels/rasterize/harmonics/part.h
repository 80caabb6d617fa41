// Parts of rows of coefficients [K, D] in a CUDA thread's registers: what a row has for CHANNELS
// channels from ``first`` on, k by k. All channels of a row (WHOLE) are adjacent numbers, and four
// of them one access where they are aligned.
namespace gamba::harmonics {

struct alignas(16) Four {
    float v[4];
};
static inline float* part_of(const wp::array_t<float>& coefficients, int row, int first) {
    const size_t size = (size_t)coefficients.shape[1] * coefficients.shape[2];
    return coefficients.data + (size_t)row * size + first;
}
template<int COUNT, int CHANNELS, bool WHOLE>
static void load(const wp::array_t<float>& coefficients, int row, int first, float* part) {
    constexpr int SIZE = COUNT * CHANNELS;
    const float* const at = part_of(coefficients, row, first);
    if (WHOLE && SIZE % 4 == 0 && ((size_t)at & 15) == 0) {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIZE / 4; ++i) {
            const Four four = ((const Four*)at)[i];
            WP_PRAGMA_UNROLL
            for (int j = 0; j < 4; ++j) part[4 * i + j] = four.v[j];
        }
    } else {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIZE; ++i)
            part[i] = at[i / CHANNELS * coefficients.shape[2] + i % CHANNELS];
    }
}
template<int COUNT, int CHANNELS, bool WHOLE>
static void store(const wp::array_t<float>& coefficients, int row, int first, const float* part) {
    constexpr int SIZE = COUNT * CHANNELS;
    float* const at = part_of(coefficients, row, first);
    if (WHOLE && SIZE % 4 == 0 && ((size_t)at & 15) == 0) {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIZE / 4; ++i) {
            Four four;
            WP_PRAGMA_UNROLL
            for (int j = 0; j < 4; ++j) four.v[j] = part[4 * i + j];
            ((Four*)at)[i] = four;
        }
    } else {
        WP_PRAGMA_UNROLL
        for (int i = 0; i < SIZE; ++i)
            at[i / CHANNELS * coefficients.shape[2] + i % CHANNELS] = part[i];
    }
}

}  // namespace gamba::harmonics
