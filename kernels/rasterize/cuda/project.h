// The projection on CUDA: one Gaussian a thread. It compiles for a CPU too, to the bits of the
// lanes.
namespace gamba::raster {

constexpr int WIDTH = 1;
typedef float F;
typedef int I;
typedef bool Mask;
static inline F splat(float x) { return x; }
static inline F larger(F a, F b) { return wp::max(a, b); }
static inline F smaller(F a, F b) { return wp::min(a, b); }
static inline F ceil(F a) { return wp::ceil(a); }
static inline F abs(F a) { return wp::abs(a); }
static inline F sqrt(F a) { return wp::sqrt(a); }
static inline F log(F a) { return wp::log(a); }
static inline F fma(F a, F b, F c) { return ::fmaf(a, b, c); }
static inline Mask finite(F a) { return abs(a) <= 3.402823466e38f; }
static inline bool any(Mask mask) { return mask; }
static inline Mask first(int n) { return true; }

template<int SIZE>
static inline void load(const void* from, int n, F* v) {
    for (int k = 0; k < SIZE; ++k) v[k] = ((const float*)from)[k];
}
template<int SIZE>
static inline void store(void* to, int n, const F* v) {
    for (int k = 0; k < SIZE; ++k) ((float*)to)[k] = v[k];
}
static inline I load_status(const int* from, int n) { return *from; }
static inline void store_status(int* to, int n, I status) { *to = status; }

static inline Mask finite_colors(const float* colors, int channels, int n) {
    Mask found = true;
    for (int c = 0; c < channels; ++c) found &= finite(colors[c]);
    return found;
}

struct Run {  // as of rows.h, with one Gaussian
    int object, begin, end;
    Run(int task, int num, int length) : object(task / num), begin(task % num), end(begin + 1) {}
};

}  // namespace gamba::raster
#include "../project.h"
