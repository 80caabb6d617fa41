// needs: lanes.py: maps, task, STRIP, TWO_C1, TWO_C2
// gives: the body of down
// Means along columns, the values of a strip of rows of windows, and the parts of the slope:
// values [P, strips, E - 10 C], each the sum of its strip, and by [P, 3 (H - 10), E - 10 C].
const int numbers = maps.hor.shape[2], rows = maps.hor.shape[1] / 4 - 10;
#include "rows.h"

const int strips = maps.values.shape[1], picture = task / strips, strip = task % strips;
F total = F{};
for (int y = strip * STRIP; y < (strip + 1) * STRIP && y < rows; ++y) {
    F s0 = F{}, d0 = F{}, s2 = F{}, d2 = F{};
#pragma unroll
    for (int k = 0; k < 11; ++k) {
        s0 = fma_(splat(weights[k]), read(at(maps.hor, picture, 4 * (y + k))), s0);
        d0 = fma_(splat(weights[k]), read(at(maps.hor, picture, 4 * (y + k) + 1)), d0);
        s2 = fma_(splat(weights[k]), read(at(maps.hor, picture, 4 * (y + k) + 2)), s2);
        d2 = fma_(splat(weights[k]), read(at(maps.hor, picture, 4 * (y + k) + 3)), d2);
    }
    F s = s0 + read(at(maps.shift, picture, 0));
    F bright = s * s + TWO_C1, dark = d0 * d0;
    F rough = s2 - s0 * s0 + TWO_C2, odd = d2 - d0 * d0;
    F one = splat(1.0f), p = one / (bright + dark), q = one / (rough + odd);
    // the shares of dark and odd, of which light = 1 - 2 unlit and shape = 1 - 2 unlike
    F unlit = dark * p, unlike = odd * q, light = one - 2.0f * unlit, shape = one - 2.0f * unlike;
    if (maps.by.data) {
        F f = light * q * q * (2.0f * maps.scale);
        F by1 = -f * odd, by2 = f * rough;
        F by0 = (shape * p * p * (-4.0f * maps.scale)) * (dark * s - bright * d0);
        write(at(maps.by, picture, 3 * y), by0 - 2.0f * (by1 * s0 + by2 * d0));
        write(at(maps.by, picture, 3 * y + 1), by1);
        write(at(maps.by, picture, 3 * y + 2), by2);
    }
    const F value = 2.0f * (unlit + unlike - 2.0f * unlit * unlike);
    total = total + value;
}
write(at(maps.values, picture, strip), total);
