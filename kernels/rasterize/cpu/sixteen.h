// needs: nothing
// gives: F, I, lane, splat, max_, min_, fma_, abs_, root_, any_, all_
// Sixteen numbers as one value, which becomes AVX-512, AVX2 or NEON instructions.
typedef float F __attribute__((vector_size(64), aligned(4)));
typedef int I __attribute__((vector_size(64), aligned(4)));
const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
auto splat = [](float x) -> F { return F{} + x; };
auto max_ = [](F a, F b) -> F { return a > b ? a : b; };
auto min_ = [](F a, F b) -> F { return a < b ? a : b; };
auto fma_ = [](F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
auto abs_ = [](F a) -> F { return __builtin_elementwise_abs(a); };
auto root_ = [](F a) -> F { return __builtin_elementwise_sqrt(a); };
auto any_ = [](I mask) -> bool { return __builtin_reduce_or(mask) != 0; };
auto all_ = [](I mask) -> bool { return __builtin_reduce_and(mask) != 0; };
