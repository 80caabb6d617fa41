// A worker sorts lists by depth, stably, one after the other: of views, whose Gaussians they put in
// order, or of tiles, whose staged intersections lie in the order of the Gaussians' index. Sorted
// are words of the key and the place; digits of at most 11 bits from those bits in which the keys
// of a list differ. Depths are not negative, so their bits are ordered as they are.
typedef unsigned long long Word;
struct Staged {
    int key, gaussian, number;
};
const bool views = !staged.data;
const int size = splats.depths.shape[0] / count;  // Gaussians of a view
for (;;) {
    const int list = __atomic_fetch_add(counter.data, 1, __ATOMIC_RELAXED);
    if (list >= count) return;
    const int begin = views ? list * size : lists.starts.data[list];
    const int n = views ? size : lists.starts.data[list + 1] - begin;
    const unsigned* const depths = (const unsigned*)splats.depths.data + begin;
    const Staged* const items = (const Staged*)staged.data + begin;
    Word* now = (Word*)workspace.data + (size_t)task * workspace.shape[1];
    Word* then = now + workspace.shape[1] / 2;
    auto key = [&](int j) -> unsigned { return views ? depths[j] : items[j].key; };
    unsigned least = ~0u, most = 0;
    for (int j = 0; j < n; ++j) {
        least = key(j) < least ? key(j) : least;
        most = key(j) > most ? key(j) : most;
    }
    for (int j = 0; j < n; ++j) now[j] = (Word)(key(j) - least) << 32 | (unsigned)j;
    if (n <= 24) {
        for (int j = 1; j < n; ++j) {
            const Word word = now[j];
            int k = j;
            for (; k > 0 && now[k - 1] > word; --k) now[k] = now[k - 1];
            now[k] = word;
        }
    } else if (most > least) {
        const int bits = 32 - __builtin_clz(most - least), longest = n < 6000 ? 8 : 11;
        const int turns = (bits + longest - 1) / longest, digit = (bits + turns - 1) / turns;
        const unsigned mask = (1u << digit) - 1;
        int counts[4][2048];
        for (int t = 0; t < turns; ++t)
            for (unsigned d = 0; d <= mask; ++d) counts[t][d] = 0;
        for (int j = 0; j < n; ++j)
            for (int t = 0; t < turns; ++t) ++counts[t][(now[j] >> 32) >> t * digit & mask];
        for (int t = 0; t < turns; ++t) {
            int place = 0;
            for (unsigned d = 0; d <= mask; ++d) {
                const int many = counts[t][d];
                counts[t][d] = place;
                place += many;
            }
            for (int j = 0; j < n; ++j)
                then[counts[t][(now[j] >> 32) >> t * digit & mask]++] = now[j];
            Word* const other = now;
            now = then;
            then = other;
        }
    }
    for (int j = 0; j < n; ++j) {
        const unsigned i = now[j];
        if (views) lists.order.data[begin + j] = begin + i;
        else {
            lists.pairs.data[begin + j] = items[i].gaussian;
            lists.rows.data[begin + j] = items[i].number;
        }
    }
}
