// A strip: TOKENS tokens of a lane group, or fewer at the end. Its rows in memory, and what is
// fetched meanwhile.
#include "task.h"
namespace gamba::scan {

// The rows of a strip in their own layout.
template<class T>
INLINE Rows<T> rows_of(const Array<T>& array, const Position& p, int width) {
    return rows_from(array, p.b, p.t0, p.d, width);
}
// The same to be read, a token's lanes together: transposed rows are first copied to a field of
// the tokens, each of ``step`` bytes, unless they are not ``used``.
template<class Config, class T>
INLINE auto lanes_of(
    const Array<T>& array, const Position& p, int width, F& field, size_t step, bool used = true) {
    const Rows<T> rows = rows_of(array, p, width);
    if constexpr (Config::TRANSPOSED) return gather(rows, 0, used ? p.count : 0, &field, step);
    else return rows;
}

// A row's cache lines are adjacent, but a lane group reads one line of each row. So the rows of the
// next strip are prefetched in their order, each lane group its share, while the states are
// traversed: those loops leave the memory idle. The lines that this lane group will write are
// prefetched too.
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
struct Fetches {
    Fetch all[8];
    int asked = 0, fetched = 0;
    void ask(Fetch fetch) { all[asked++] = fetch; }
    Fetch next() {  // or one that repeats a line
        if (fetched < asked) return all[fetched++];
        return {(const char*)this, 0, 0, 0, 1};
    }
    void rest(int count) {
        while (fetched < asked) {
            Fetch fetch = next();
            for (int t = 0; t < count; ++t) fetch.next();
        }
    }
};
// In transposed rows a channel's lines are adjacent. A strip may begin or end within one; the strip
// before has fetched that, so they are met at their ends, or in the gradient at their begins.
template<class Config, class T>
static inline Fetch fetch_lines(const Rows<T>& rows, int64_t ahead) {
    const int lines = Config::TOKENS * sizeof(T) / 64;
    const int64_t jump = (int64_t)rows.across - (lines - 1) * 64;
    return {(const char*)rows.first + ahead + (Config::GRADIENT ? 0 : 63), 64, jump, 0, lines};
}
template<class Config, class T>
static inline void read_soon(Fetches& fetches, const Array<T>& array, const Position& p) {
    const int next = Config::GRADIENT ? -Config::TOKENS : Config::TOKENS;
    const bool more = p.t0 + next >= 0 && p.t0 + next < array.shape[1];
    const Rows<T> rows = rows_of(array, p, 16);
    const int64_t step = rows.step, bytes = 16 * sizeof(T);
    if (Config::TRANSPOSED && rows.transposed())
        return fetches.ask(fetch_lines<Config>(rows, more ? next * step : 0));
    const int row = p.j * p.count / p.blocks, line = p.j * p.count % p.blocks;
    fetches.ask({(const char*)rows.first + (more ? (next + row) * step : 0) + (line - p.j) * bytes,
        bytes, (more ? step : 0) - (p.blocks - 1) * bytes, line, p.blocks});
}
template<class Config, class T>
static inline void write_soon(
    Fetches& fetches, const Array<T>& array, const Position& p, bool stream) {
    if (array.shape[1] == 0 || stream) return;
    const Rows<T> rows = rows_of(array, p, 16);
    const int64_t step = rows.step;
    fetches.ask(Config::TRANSPOSED && rows.transposed()
            ? fetch_lines<Config>(rows, 0)
            : Fetch{(const char*)rows.first, step, step, 0, 1});
}

}  // namespace gamba::scan
