// Arithmetic on sixteen lanes, and rows of tensors [B, L, D] as lanes.
#include "sixteen.h"
namespace gamba {

// max(most, |x|) by their bits, so that NaN is the greatest
static inline F max_abs(F most, F x) {
    I i = (I)x & 0x7fffffff;
    return (F)(i > (I)most ? i : (I)most);
}
// true if |x| <= 125 in all lanes
static inline bool in_range(F x) { return !__builtin_reduce_or(~((x <= 125.0f) & (x >= -125.0f))); }
constexpr float LOG2E = 1.44269504088896341f, LN2 = 0.6931471805599453f;

// (2^x - 1) / x for |x| <= 1/2: minimax polynomials, so that 2^x - 1 keeps its relative accuracy
// for small x: the errors of slow decays add up over thousands of steps. Highest power first.
constexpr float POWER_2[] = {0.2398640364408493f, 0.7029417753219604f};
constexpr float POWER_3[] = {5.500893294811249e-2f, 0.24221095442771912f, 0.6932829022407532f};
constexpr float POWER_4[] = {
    9.582852944731712e-3f, 5.5906426161527634e-2f, 0.24024099111557007f, 0.6931241750717163f};
constexpr float POWER_5[] = {1.3400436146184802e-3f, 9.666373021900654e-3f, 5.550333112478256e-2f,
    0.2402234822511673f, 0.6931471824645996f};
constexpr float POWER_6[] = {1.546973508084193e-4f, 1.3390866806730628e-3f, 9.618030861020088e-3f,
    5.5503569543361664e-2f, 0.24022650718688965f, 0.6931471824645996f};
template<int N>
INLINE F horner(F x, const float (&c)[N]) {
    F p = splat(c[0]);
#pragma unroll
    for (int i = 1; i < N; ++i) p = fma(p, x, splat(c[i]));
    return p;
}

// exp2 rounds to an integer by adding 1.5 * 2^23 (+127, the exponent bias), and takes the
// polynomial of the rest. NaN stays NaN.
static inline F exp2_clamped(F x) {
    const F shifter = splat(12583039.0f);
    F r = x + shifter;
    F f = x - (r - shifter);
    return fma(horner(f, POWER_6), f, splat(1.0f)) * (F)((I)r << 23);
}
static inline F exp2(F x) {
    x = x < -126.0f ? splat(-126.0f) : x;
    return exp2_clamped(x > 128.0f ? splat(128.0f) : x);
}
// e^-|x|; NaN gives 2^-126
static inline F decay(F x) {
    x = (F)((I)x | (int)0x80000000) * LOG2E;
    return exp2_clamped(x > -126.0f ? x : splat(-126.0f));
}
// p for |x| <= 125 and no NaN, of another degree: 2^x is near (1 + low) (1 + f p), where near is a
// float32 and low its rounding error. If |x| < 1/32, near is 1, low is 0 and f is x.
template<class Config>
static inline F exp2_parts(F x, F& near, F& low, F& f) {
#if defined(__AVX512F__)
    if constexpr (Config::TABLE) {
        // From a table of 2^(i/16), which one instruction reads, and a cubic of the rest, |f| <=
        // 1/32: one multiplication less than degree 5, and a smaller error. The table has the
        // index's part of the exponent subtracted. 786432 = 1.5 * 2^19 rounds to sixteenths.
        const F plain = splat(786432.0f);
        const I table = {1065353216, 1065200323, 1065063874, 1064944595, 1064843248, 1064760626,
            1064697559, 1064654911, 1064633587, 1064634532, 1064658730, 1064707212, 1064781053,
            1064881375, 1065009351, 1065166205};
        // the rounding error of 2^(i/16) in float32, relative to it
        const F lows = {0.0f, 4.628547078944223e-08f, -1.199215704517087e-08f,
            4.7297823435599184e-08f, 3.193418085523092e-08f, 3.621057320657428e-08f,
            -3.099072076739873e-08f, -7.475213226193489e-09f, 1.7114271333440456e-08f,
            -3.047683416745883e-08f, 5.233334210430485e-09f, 6.107591543624835e-09f,
            -1.4719605534452285e-08f, -5.258795177098818e-09f, -6.1282597885181644e-09f,
            5.140609271592211e-09f};
        F r = x + plain;
        f = x - (r - plain);
        near = (F)((I)__builtin_ia32_permvarsi512(table, (I)r) + ((I)r << 19));
        low = (F)__builtin_ia32_permvarsi512((I)lows, (I)r);
        F p = splat(0.05550522f);
        p = fma(p, f, splat(0.24023214f));
        return fma(p, f, splat(0.69314718f));
    }
#endif
    const F plain = splat(12582912.0f);
    F r = x + plain;
    f = x - (r - plain);
    near = (F)(((I)r << 23) + 0x3f800000), low = F{};
    if constexpr (Config::DEGREE == 2) return horner(f, POWER_2);
    else if constexpr (Config::DEGREE == 3) return horner(f, POWER_3);
    else if constexpr (Config::DEGREE == 4) return horner(f, POWER_4);
    else if constexpr (Config::DEGREE == 5) return horner(f, POWER_5);
    else return horner(f, POWER_6);
}
// 2^x of the same x. Where |x| < 1/32, fm1 is 2^x - 1 and keeps the digits that 2^x rounds away;
// elsewhere it is undefined.
template<class Config>
static inline F exp2_fm1(F x, F& fm1) {
    F near, low, f;
    const F p = exp2_parts<Config>(x, near, low, f);
    fm1 = f * p;
#if defined(__AVX512F__)
    if constexpr (Config::TABLE) return fma(near, fm1, near);
#endif
    return (F)((I)fma(p, f, splat(1.0f)) + ((I)near - 0x3f800000));
}

// softplus(x) = max(x, 0) + log1p(e), e = exp(-|x|), log1p(e) = 2 atanh(e / (2 + e)): no branch,
// relatively accurate for x << 0, and x itself in float32 well before 20. NaN stays NaN.
// Here from s = e / (2 + e).
static inline F softplus_of(F v, F s) {
    F w = s * s;
    F p = splat(0.1401223282424694f);
    p = fma(p, w, splat(0.13999569703388653f));
    p = fma(p, w, splat(0.20010849594358543f));
    p = fma(p, w, splat(0.33333206564805135f));
    p = fma(p, w, splat(1.0f));
    return fma(s + s, p, F{} > v ? F{} : v);
}
static inline F softplus(F v) {
    F e = decay(v);
    return softplus_of(v, e / (e + 2.0f));
}
static inline F sigmoid(F v) {
    F e = decay(v);
    return (v < 0.0f ? e : splat(1.0f)) / (e + 1.0f);
}
// Rows of a tensor [B, L, D] as lanes. Its channels are dense, or its tokens are, and it is
// transposed. The other dimensions may be strided.

template<class T>
struct Rows {
    T* first;
    size_t step, across;  // bytes between tokens, and between channels
    int width;
    T* row(int t) const { return (T*)((char*)first + t * step); }
    bool transposed() const { return across != sizeof(T) && step == sizeof(T); }
    // rows of which each is a channel; their lanes are the tokens from t to before ``end``
    Rows channels(int t, int end) const { return {row(t), across, step, end - t}; }
};
// The rows from batch element b, token t0 and channel d on: lanes past the width are read as 0 and
// not written.
template<class T>
INLINE Rows<T> rows_from(const wp::array_t<T>& array, int b, int t0, int d, int width) {
    const size_t step = (size_t)array.strides[1], across = (size_t)array.strides[2];
    char* const at = (char*)array.data + (size_t)b * array.strides[0];
    return {(T*)(at + (size_t)t0 * step + d * across), step, across, width};
}

typedef _Float16 H __attribute__((vector_size(32), aligned(2)));
typedef unsigned short S __attribute__((vector_size(32), aligned(2)));
typedef float Line __attribute__((vector_size(64), aligned(64)));
// bfloat16 to nearest, ties to even; NaN stays a NaN
static inline I narrow(I i) {
    I is_nan = (i & 0x7fffffff) > 0x7f800000;
    I rounded = (i + 0x7fff + ((i >> 16) & 1)) >> 16;
    return (is_nan ? (i >> 16) | 0x40 : rounded) & 0xffff;
}

template<class R>
INLINE F read(const R& rows, int t) {
    auto* const row = rows.row(t);
    F v = F{};
    if constexpr (__is_same(decltype(row), float* const)) {
        if (rows.width >= 16) return *(const F*)row;
        for (int i = 0; i < rows.width; ++i) v[i] = row[i];
    } else if constexpr (__is_same(decltype(row), wp::half* const)) {
        if (rows.width >= 16) return __builtin_convertvector(*(const H*)row, F);
        for (int i = 0; i < rows.width; ++i) v[i] = (float)((const _Float16*)row)[i];
    } else {
        if (rows.width >= 16) return (F)(__builtin_convertvector(*(const S*)row, I) << 16);
        I wide = I{};
        for (int i = 0; i < rows.width; ++i) wide[i] = (int)((const unsigned short*)row)[i] << 16;
        v = (F)wide;
    }
    return v;
}

template<class R>
INLINE void write(const R& rows, int t, F v) {
    auto* const row = rows.row(t);
    if constexpr (__is_same(decltype(row), float* const)) {
        if (rows.width >= 16) *(F*)row = v;
        else
            for (int i = 0; i < rows.width; ++i) row[i] = v[i];
    } else if constexpr (__is_same(decltype(row), wp::half* const)) {
        if (rows.width >= 16) *(H*)row = __builtin_convertvector(v, H);
        else
            for (int i = 0; i < rows.width; ++i) ((_Float16*)row)[i] = (_Float16)v[i];
    } else if (rows.width >= 16) {
#if defined(__AVX512BF16__)  // one instruction: the same bits, but a result below 2^-126 becomes 0
        typedef __bf16 N __attribute__((vector_size(32), aligned(2)));
        *(N*)row = __builtin_convertvector(v, N);
#else
        *(S*)row = __builtin_convertvector(narrow((I)v), S);
#endif
    } else {
        const I bits = narrow((I)v);
        for (int i = 0; i < rows.width; ++i) ((unsigned short*)row)[i] = (unsigned short)bits[i];
    }
}

// Large results bypass the caches: their lines need not be read before they are written, and would
// evict data that is used soon. ``stream``: do so; all lines are whole, of float32.
template<class R>
INLINE void put(const R& rows, int t, F v, bool stream) {
    if (stream) __builtin_nontemporal_store((Line)v, (Line*)rows.row(t));
    else write(rows, t, v);
}

// Calls tile(t, width, end) for the tokens from begin to before ``end`` of transposed rows, by
// sixteen or fewer at the end; full tiles are compiled separately.
template<class R, class Tile>
INLINE void tiles(const R& rows, int begin, int end, Tile tile) {
    for (int t = begin; t < end; t += 16)
        if (rows.width >= 16 && t + 16 <= end) tile(t, 16, t + 16);
        else tile(t, rows.width, t + 16 < end ? t + 16 : end);
}
// Tokens in memory, from ``begin`` on, each as lanes, ``step`` bytes apart.
struct Lanes {
    float* first;
    size_t step;
    int begin, width;
    float* row(int t) const { return (float*)((char*)first + (t - begin) * step); }
};
// Copies tokens to ``to``.
template<class T>
INLINE Lanes gather(const Rows<T>& rows, int begin, int end, F* to, size_t step) {
    const Lanes lanes = {(float*)to, step, begin, 16};
    if (!rows.transposed())
        for (int t = begin; t < end; ++t) write(lanes, t, read(rows, t));
    else
        tiles(rows, begin, end, [&](int t, int width, int stop) __attribute__((always_inline)) {
            const auto channels = rows.channels(t, stop);
            F v[16] = {};
            for (int i = 0; i < width; ++i) v[i] = read(channels, i);
            transpose(v);
            for (int i = 0; i < channels.width; ++i) write(lanes, t + i, v[i]);
        });
    return lanes;
}
// Writes ``value(t)`` of tokens t.
template<class T, class Value>
INLINE void scatter(const Rows<T>& rows, int begin, int end, Value value, bool stream) {
    if (!rows.transposed())
        for (int t = begin; t < end; ++t) put(rows, t, value(t), stream);
    else
        tiles(rows, begin, end, [&](int t, int width, int stop) __attribute__((always_inline)) {
            const auto channels = rows.channels(t, stop);
            F v[16] = {};
            for (int i = 0; i < channels.width; ++i) v[i] = value(t + i);
            transpose(v);
            for (int i = 0; i < width; ++i) put(channels, i, v[i], stream);
        });
}

}  // namespace gamba
