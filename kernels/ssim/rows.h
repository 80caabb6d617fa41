// needs: lanes.py: WEIGHTS, maps, group, numbers
// gives: weights, channels, d, width, at, read, write
// Sixteen adjacent numbers of a picture's row, or fewer at its end, with WINDOW as weights.
// Pictures are [P, H, E], E = W * C. Maps between two launches have their rows side by side: row 4
// y + i is map i of row y, and 3 y + i where there are three. README.md has the formulas.
#include "../runtime/sixteen.h"
const float weights[11] = WEIGHTS;
const int channels = maps.channels, d = group * 16;
const int width = numbers - d < 16 ? numbers - d : 16;
// where row y of a picture has the first of the numbers
auto at = [&](const auto& rows, int picture, int y) -> float* {
    return (float*)((char*)rows.data + (size_t)picture * rows.strides[0]
               + (size_t)y * rows.strides[1])
        + d;
};
auto read = [&](const float* p) -> F {
    if (width >= 16) return *(const F*)p;
    F v = F{};
    for (int i = 0; i < width; ++i) v[i] = p[i];
    return v;
};
auto write = [&](float* p, F v) {
    if (width >= 16) *(F*)p = v;
    else
        for (int i = 0; i < width; ++i) p[i] = v[i];
};
