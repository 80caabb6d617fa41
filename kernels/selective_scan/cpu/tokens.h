// What the CPU's leaves keep of the tokens that they walk: TOKENS of them, or fewer at the end.
// The values of a token lie together, because arrays of 4 KiB would evict one another from the
// cache. What the states do not need lies apart. A rate is δ times SCALE.
#if GRADIENT
struct Token {
    F rate, du, dy, y, s, p;
};
struct Late {
    F u, slope, gate;
};
// Of a token and state: f or its rise, the state before, and g where it is not quickly made again.
struct Kept {
    F m, h;
#if WEIGHTED
    F g;
#endif
};
alignas(64) Late late[TOKENS];
alignas(64) Kept kept[TOKENS * AT_ONCE];
#else
struct Token {
    F rate, du, y, gate;
};
#endif
alignas(64) Token token[TOKENS];
F top = F{};  // the largest |rate| of each lane
bool tame;    // whether all |rate A| are <= 125

const int count = p.count, states = sizes.states;
const bool use_softplus = sizes.use_softplus, stream = sizes.stream;
// Of the lane group: N rates A, then the largest |A|, D and the bias.
const F* const channel = row_(channel_in, p.k);
const F widest = channel[states], skip = channel[states + 1], bias = channel[states + 2];
auto here_ = [&](auto& array, int width) { return rows_(array, p.b, p.t0, p.d, width); };

// A row's lines lie together, but a lane group wants one line of each row. So the rows of the next
// strip are fetched in their order, each lane group fetching its share. That is done while the
// states are walked, as those loops leave the memory idle; so are the lines fetched that this lane
// group will write.
struct Fetch {
    const char* at;
    int64_t step, jump;
    int line, lines;
    void next() {
        __builtin_prefetch(at);
        const bool last = ++line == lines;
        at += last ? jump : step;
        line = last ? 0 : line;
    }
};
Fetch fetches[8];
int asked = 0, fetched = 0;
const int next = GRADIENT ? -TOKENS : TOKENS;
const bool more = p.t0 + next >= 0 && p.t0 + next < sizes.length;
auto read_soon_ = [&](auto& array) {
    const auto rows = here_(array, 16);
    const int row = p.j * count / p.blocks, line = p.j * count % p.blocks;
    const int64_t step = rows.step, bytes = 16 * sizeof(*rows.first);
    fetches[asked++] = {
        (const char*)rows.first + (more ? (next + row) * step : 0) + (line - p.j) * bytes, bytes,
        (more ? step : 0) - (p.blocks - 1) * bytes, line, p.blocks};
};
auto write_soon_ = [&](auto& array) {
    if (array.shape[1] == 0 || stream) return;
    const auto rows = here_(array, 16);
    fetches[asked++] = {(const char*)rows.first, (int64_t)rows.step, (int64_t)rows.step, 0, 1};
};
auto fetch_ = [&]() -> Fetch {  // the next of what is to be fetched, if there is one yet
    if (fetched < asked) return fetches[fetched++];
    return {(const char*)token, 0, 0, 0, 1};
};
