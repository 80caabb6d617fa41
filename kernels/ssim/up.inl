// needs: lanes.py: maps, task
// gives: the body of up
// Transposed means along columns: col [P, 3 H, E + 10 C], padded on both sides.
const int numbers = maps.by.shape[2], rows = maps.by.shape[1] / 3, height = rows + 10;
#include "rows.h"

const int picture = task / height, y = task % height, edge = 10 * channels;
const int first = y < 10 ? 0 : y - 10, last = y < rows ? y : rows - 1;
F v0 = F{}, v1 = F{}, v2 = F{};
for (int t = first; t <= last; ++t) {
    const float c = weights[y - t];
    v0 = fma_(splat(c), read(at(maps.by, picture, 3 * t)), v0);
    v1 = fma_(splat(c), read(at(maps.by, picture, 3 * t + 1)), v1);
    v2 = fma_(splat(c), read(at(maps.by, picture, 3 * t + 2)), v2);
}
write(at(maps.col, picture, 3 * y) + edge, v0);
write(at(maps.col, picture, 3 * y + 1) + edge, v1);
write(at(maps.col, picture, 3 * y + 2) + edge, v2);
