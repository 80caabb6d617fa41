// Sixteen numbers as one value, which becomes AVX-512, AVX2 or NEON instructions.
#pragma clang diagnostic ignored "-Wpsabi"  // all functions of them are within one module
#define INLINE static inline __attribute__((always_inline))
namespace gamba {

typedef float F __attribute__((vector_size(64), aligned(4)));
typedef int I __attribute__((vector_size(64), aligned(4)));
static const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
static inline F splat(float x) { return (F){x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }
static inline F max(F a, F b) { return a > b ? a : b; }
static inline F min(F a, F b) { return a < b ? a : b; }
static inline F fma(F a, F b, F c) { return __builtin_elementwise_fma(a, b, c); }
static inline F abs(F a) { return __builtin_elementwise_abs(a); }
static inline F sqrt(F a) { return __builtin_elementwise_sqrt(a); }
static inline bool any(I mask) { return __builtin_reduce_or(mask) != 0; }
static inline bool all(I mask) { return __builtin_reduce_and(mask) != 0; }

// The sum of the lanes, pairwise, in a fixed order.
static inline float total(F x) {
    for (int w = 8; w > 0; w >>= 1)
        for (int l = 0; l < w; ++l) x[l] += x[l + w];
    return x[0];
}

// Transposes sixteen values of sixteen lanes: lane j of value i becomes lane i of value j. A round
// exchanges a bit of i and one of j, of which the last two count within 128 bits, the first two
// count these; so no instruction moves numbers across these 128 bits one by one, which is slow.
INLINE void transpose(F* v) {
    auto place = [](int i) { return i % 4 * 4 + i / 4 % 2 * 2 + i / 8; };
    F w[16];
#pragma unroll
    for (int i = 0; i < 16; ++i) w[place(i)] = v[i];
#pragma unroll
    for (int round = 0; round < 4; ++round) {
        F x[16];
#pragma unroll
        for (int i = 0; i < 8; ++i) {
            const F a = w[i], b = w[i + 8];
            if (round < 2) {
                x[2 * i] = __builtin_shufflevector(
                    a, b, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29);
                x[2 * i + 1] = __builtin_shufflevector(
                    a, b, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
            } else {
                x[2 * i] = __builtin_shufflevector(
                    a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27);
                x[2 * i + 1] = __builtin_shufflevector(
                    a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
            }
        }
#pragma unroll
        for (int i = 0; i < 16; ++i) w[i] = x[i];
    }
#pragma unroll
    for (int i = 0; i < 16; ++i) v[i] = w[place(i)];
}

}  // namespace gamba
