// needs: kernels.py: WIDTH, TRANSPOSED, x_in, PIECE, pieces_in, task, k, state_in, weight_in,
//     bias_in; scalars.py: reciprocal_, exp2_, ELEMENT; lanes.h: rows_, read_, write_, put_,
//     sigmoid_; sixteen.inl: fma_
// gives: F, each_, fma_, sigmoid_, one, rows_, b, t0, d, width, read_, write_, put_, next_, pieces,
//     begin, stop, own, end, rows, before, w, taps, w0, w1, w2, w3, bias, x0, x1, x2, start
// The beginning of both kernels. A value F is WIDTH channels, from the head of kernels.py: sixteen
// lanes on a CPU, a few numbers on CUDA.
#if defined(__CUDA_ARCH__)
struct F {
    float v[WIDTH];
    F operator+(F o) const {
#pragma unroll
        for (int i = 0; i < WIDTH; ++i) o.v[i] = v[i] + o.v[i];
        return o;
    }
    F operator-(F o) const {
#pragma unroll
        for (int i = 0; i < WIDTH; ++i) o.v[i] = v[i] - o.v[i];
        return o;
    }
    F operator*(F o) const {
#pragma unroll
        for (int i = 0; i < WIDTH; ++i) o.v[i] = v[i] * o.v[i];
        return o;
    }
};
auto each_ = [](auto value) -> F {
    F f;
#pragma unroll
    for (int i = 0; i < WIDTH; ++i) f.v[i] = value(i);
    return f;
};
auto fma_ = [](F x, F y, F z) -> F { return x * y + z; };
auto sigmoid_ = [&](F x) -> F {
    return each_([&](int i) { return reciprocal_(1.0f + exp2_(-1.4426950408889634f * x.v[i])); });
};
const F one = each_([](int) { return 1.0f; });
// One access of all channels; of words, since the compiler would pack 64 bits by shifts.
struct alignas(sizeof(ELEMENT) * WIDTH) Whole {
    unsigned words[sizeof(ELEMENT) * WIDTH / sizeof(unsigned)];
};
auto rows_ = [](auto& array, int b, int t0, int d, int width) {
    typedef decltype(array.data + 0) Row;
    struct Rows {
        Row first;
        size_t step;  // bytes
        int width;
        bool whole;  // all channels are one access
        Row row(int t) const { return (Row)((char*)first + t * step); }
    };
    char* const at =
        (char*)array.data + (size_t)b * array.strides[0] + (size_t)t0 * array.strides[1];
    const Row first = (Row)at + d;
    const size_t step = (size_t)array.strides[1];
    return Rows{first, step, width, width == WIDTH && ((size_t)first | step) % sizeof(Whole) == 0};
};
auto read_ = [&](const auto& rows, int t) -> F {
    const auto row = rows.row(t);
    if (!rows.whole) return each_([&](int i) { return i < rows.width ? (float)row[i] : 0.0f; });
    const Whole whole = *(const Whole*)row;
    return each_([&](int i) {
        const int bit = i * 8 * sizeof(ELEMENT);
        const unsigned bits = whole.words[bit / 32] >> bit % 32;
        ELEMENT e;
        memcpy(&e, &bits, sizeof e);
        return (float)e;
    });
};
auto write_ = [](const auto& rows, int t, F f) {
    const auto row = rows.row(t);
    ELEMENT e[WIDTH];
#pragma unroll
    for (int i = 0; i < WIDTH; ++i) e[i] = (ELEMENT)f.v[i];
    if (rows.whole) {
        Whole whole;
        memcpy(&whole, e, sizeof whole);
        *(Whole*)row = whole;
        return;
    }
#pragma unroll
    for (int i = 0; i < WIDTH; ++i)
        if (i < rows.width) row[i] = e[i];
};
auto put_ = [&](const auto& rows, int t, F f, bool) { write_(rows, t, f); };
auto next_ = [](const auto&, int) {};
#else
const F one = F{} + 1.0f;
#endif
const int pieces = (x_in.shape[1] + PIECE - 1) / PIECE;
int b = 0, begin = 0, stop = x_in.shape[1], t0 = 0, own = 0;  // ``own``: the sequence
if (pieces_in.shape[0] > 0) {
    const int* const piece = (const int*)pieces_in.data + (size_t)task * 5;
    b = piece[0], begin = piece[1], stop = piece[2], t0 = piece[3], own = piece[4];
    if (own < 0) return;
} else b = own = task / pieces, t0 = task % pieces * PIECE;
#if !defined(__CUDA_ARCH__)
// Each row is in another page, so no processor prefetches what the next task reads: the next lanes,
// or of transposed rows the next tokens, whose lines these tokens share.
auto next_ = [&](const auto& rows, int t) {
    const int own = t - t0, lines = PIECE * sizeof(*rows.first) / 64;
    __builtin_prefetch(!TRANSPOSED
            ? (char*)(rows.row(t) + WIDTH)
            : (char*)rows.row(t0 + PIECE) + own / lines * rows.across + own % lines * 64 + 63);
};
#endif
const int end = t0 + PIECE < stop ? t0 + PIECE : stop;
const int d = k * WIDTH, width = x_in.shape[2] - d < WIDTH ? x_in.shape[2] - d : WIDTH;
const auto rows = rows_(x_in, b, 0, d, width), before = rows_(state_in, own, 0, d, width);
const F* const w = (const F*)weight_in.data + k;
const size_t taps = weight_in.shape[1];
const F w0 = w[0], w1 = w[taps], w2 = w[2 * taps], w3 = w[3 * taps];
const F bias = ((const F*)bias_in.data)[k];
F x0 = F{}, x1 = F{}, x2 = F{};  // the three tokens before
auto start = [&](const auto& xs) {
    for (int t = t0 - 3; t < t0; ++t) {
        x0 = x1, x1 = x2;
        if (t >= begin) x2 = read_(xs, t);
        else if (state_in.shape[1] > 0) x2 = read_(before, t - begin + 3);
    }
};
