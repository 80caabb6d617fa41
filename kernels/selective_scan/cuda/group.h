// A thread's elements of a tile in shared memory, ADJACENT tokens at a time; ``jump`` floats lie
// between four tokens.
#include "shape.h"
auto group_ = [&](int k, int jump) -> float* {
    return arena.data.ptr + at + ((k * ROWS + p.row) * ADJACENT) / 4 * jump + p.row * ADJACENT % 4;
};
float v[ADJACENT];
