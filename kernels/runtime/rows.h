// Rows of a tensor [B, L, D] as lanes. A row is dense in D; tokens and batch elements may be
// strided.

// The rows from batch element b, token t0 and channel d on: lanes past the width are read as 0 and
// not written.
auto rows_ = [](auto& array, int b, int t0, int d, int width) __attribute__((always_inline)) {
    auto* at = array.data;
    struct Rows {
        decltype(at) first;
        size_t step;  // bytes
        int width;
        decltype(at) row(int t) const { return (decltype(at))((char*)first + t * step); }
    };
    at = (decltype(at))((char*)at + (size_t)b * array.strides[0] + (size_t)t0 * array.strides[1]);
    return Rows{at + d, (size_t)array.strides[1], width};
};

typedef _Float16 H __attribute__((vector_size(32), aligned(2)));
typedef unsigned short S __attribute__((vector_size(32), aligned(2)));
typedef float Line __attribute__((vector_size(64), aligned(64)));
// bfloat16 to nearest, ties to even; NaN stays a NaN
auto narrow_ = [](I i) -> I {
    I is_nan = (i & 0x7fffffff) > 0x7f800000;
    I rounded = (i + 0x7fff + ((i >> 16) & 1)) >> 16;
    return (is_nan ? (i >> 16) | 0x40 : rounded) & 0xffff;
};

auto read_ = [&](const auto& rows, int t) __attribute__((always_inline)) -> F {
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
};

auto write_ = [&](const auto& rows, int t, F v) __attribute__((always_inline)) {
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
        *(S*)row = __builtin_convertvector(narrow_((I)v), S);
#endif
    } else {
        const I narrow = narrow_((I)v);
        for (int i = 0; i < rows.width; ++i) ((unsigned short*)row)[i] = (unsigned short)narrow[i];
    }
};

// Large results go past the caches: their lines need not be read before they are written, and would
// only push out what is wanted soon. ``stream`` says so, and that all lines are whole, of float32.
auto put_ = [&](const auto& rows, int t, F v, bool stream) __attribute__((always_inline)) {
    if (stream) __builtin_nontemporal_store((Line)v, (Line*)rows.row(t));
    else write_(rows, t, v);
};
