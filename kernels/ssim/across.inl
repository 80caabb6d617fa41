// needs: lanes.py: maps, task
// gives: the body of across
// The four maps' means along a row of two pictures: hor [P, 4 H, E - 10 C].
const int numbers = maps.hor.shape[2], height = maps.got.shape[1];
#include "rows.h"

const int picture = task / height, y = task % height;
const float *g = at(maps.got, picture, y), *w = at(maps.want, picture, y);
F s0 = F{}, s1 = F{}, s2 = F{}, s3 = F{};
const F m = read(at(maps.shift, picture, 0));  // the same for each tap, which has the same channel
#pragma unroll
for (int k = 0; k < 11; ++k) {
    F a = read(g + k * channels), c = read(w + k * channels);
    F s = a + c - m, q = a - c;
    s0 = fma_(splat(weights[k]), s, s0);
    s1 = fma_(splat(weights[k]), q, s1);
    s2 = fma_(splat(weights[k]), s * s, s2);
    s3 = fma_(splat(weights[k]), q * q, s3);
}
write(at(maps.hor, picture, 4 * y), s0);
write(at(maps.hor, picture, 4 * y + 1), s1);
write(at(maps.hor, picture, 4 * y + 2), s2);
write(at(maps.hor, picture, 4 * y + 3), s3);
