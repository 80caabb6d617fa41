// Writes the intersections of a task's windows, each to the next place of its tile. Where the
// Gaussians come front to back the lists are done; else `sort.inl` takes what is staged here.
#include "footprints.h"

int* const cursors = work.counts.data + (size_t)task * work.counts.shape[1];
const int* const keys = (const int*)splats.depths.data;
struct Staged {
    int key, gaussian, number;
};
Staged* const items = (Staged*)staged.data;
int p = work.numbers.data[task];
auto emit = [&](int& cursor, int i) {
    const int place = cursor++;
    if (order) {
        lists.pairs.data[place] = i;
        lists.rows.data[place] = p;
    } else items[place] = {keys[i], i, p};
    ++p;
};
for (int j = begin, g = image * groups + first_group; j < end; j += 16, ++g) {
    const int n = end - j < 16 ? end - j : 16;
    const int* const corner = corners_of(g);
    const Word* const words = words_of(g);
    auto bits_of = [&](int l) -> int { return words[l >> 2] >> 16 * (l & 3) & 0xffff; };
    if (any_(*(const I*)corner < 0)) {  // some are large
        for (int l = 0; l < n; ++l) {
            const int i = gaussian(j + l);
            lists.offsets.data[j + l] = p;
            if (corner[l] < 0)
                rows_(i, [&](int ty, int first, int last) {
                    int* const row = cursors + (size_t)ty * tiles_x;
                    for (int tx = first; tx <= last; ++tx) emit(row[tx], i);
                });
            else
                for (int bits = bits_of(l); bits; bits &= bits - 1)
                    emit(cursors[corner[l] + within[__builtin_ctz(bits)]], i);
        }
        continue;
    }
    int number = p;
    for (int l = 0; l < n; ++l) {
        lists.offsets.data[j + l] = number;
        number += __builtin_popcount(bits_of(l));
    }
    for (int w = 0; w < 4; ++w)
        for (Word word = words[w]; word; word &= word - 1) {
            const int k = __builtin_ctzll(word), l = 4 * w + (k >> 4);
            emit(cursors[corner[l] + within[k & 15]], gaussian(j + l));
        }
}
