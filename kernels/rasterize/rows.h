// Sixteen Gaussians as lanes, from and to rows of tensors, and the runs of them that tasks take.
#include "../runtime/sixteen.h"
namespace gamba::raster {

static inline I finite(F a) { return abs(a) <= 3.402823466e38f; }

// Rows of SIZE numbers as lanes, of which n <= 16 are read and written, and others are 0; loops of
// constant length become loads and shuffles.
template<int SIZE>
INLINE void load(const void* from, int n, F* v) {
    const float* const p = (const float*)from;
    float part[SIZE][16] = {};
    auto fill = [&](int count) {
        for (int l = 0; l < count; ++l)
            for (int k = 0; k < SIZE; ++k) part[k][l] = p[SIZE * l + k];
    };
    if (n == 16) fill(16);
    else fill(n);
    for (int k = 0; k < SIZE; ++k) v[k] = *(const F*)part[k];
}
template<int SIZE>
INLINE void store(void* to, int n, const F* v) {
    float* const p = (float*)to;
    float part[SIZE][16];
    for (int k = 0; k < SIZE; ++k) *(F*)part[k] = v[k];
    auto spill = [&](int count) {
        for (int l = 0; l < count; ++l)
            for (int k = 0; k < SIZE; ++k) p[SIZE * l + k] = part[k][l];
    };
    if (n == 16) spill(16);
    else spill(n);
}

// A task's numbers [begin, end) of the [0, num) of an object, or view, which has ``count`` runs.
struct Run {
    int count, object, index, begin, end;
    Run(int task, int num, int length)
        : count((num + length - 1) / length), object(task / count), index(task % count),
          begin(index * length), end(begin + length < num ? begin + length : num) {}
};

}  // namespace gamba::raster
