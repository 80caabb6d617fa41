// needs: lanes.py: maps, task
// gives: the body of back
// The slope [P, H, E], from transposed means along a row.
const int numbers = maps.got.shape[2], height = maps.got.shape[1];
#include "rows.h"

const int picture = task / height, y = task % height;
const float *c0 = at(maps.col, picture, 3 * y), *c1 = at(maps.col, picture, 3 * y + 1);
const float* c2 = at(maps.col, picture, 3 * y + 2);
F b0 = F{}, b1 = F{}, b2 = F{};
#pragma unroll
for (int k = 0; k < 11; ++k) {
    b0 = fma_(splat(weights[k]), read(c0 + k * channels), b0);
    b1 = fma_(splat(weights[k]), read(c1 + k * channels), b1);
    b2 = fma_(splat(weights[k]), read(c2 + k * channels), b2);
}
F a = read(at(maps.got, picture, y)), c = read(at(maps.want, picture, y));
F s = a + c - read(at(maps.shift, picture, 0)), q = a - c;
write(at(maps.slope, picture, y), b0 + 2.0f * (s * b1 + q * b2));
