// The convolution on CUDA: a thread has four channels, which it reads and writes at once where they
// are aligned.
namespace gamba::conv {

constexpr int WIDTH = 4;
struct F {
    float v[WIDTH];
};
template<class Value>
static inline F each(Value value) {
    F f;
#pragma unroll
    for (int i = 0; i < WIDTH; ++i) f.v[i] = value(i);
    return f;
}
static inline F operator+(F a, F b) {
    return each([&](int i) { return a.v[i] + b.v[i]; });
}
static inline F operator+(F a, float b) {
    return each([&](int i) { return a.v[i] + b; });
}
static inline F operator-(F a, F b) {
    return each([&](int i) { return a.v[i] - b.v[i]; });
}
static inline F operator*(F a, F b) {
    return each([&](int i) { return a.v[i] * b.v[i]; });
}
static inline F fma(F a, F b, F c) { return a * b + c; }
static inline F sigmoid(F x) {
    return each([&](int i) {  // of the special function unit, errors of about 2^-22
        float e, r;
        asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(e) : "f"(-1.4426950408889634f * x.v[i]));
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(1.0f + e));
        return r;
    });
}

template<class T>
struct Rows {
    // One access of all channels; of words, since the compiler would pack 64 bits by shifts.
    struct alignas(sizeof(T) * WIDTH) Whole {
        unsigned words[sizeof(T) * WIDTH / sizeof(unsigned)];
    };
    T* first;
    size_t step;  // bytes between tokens
    int width;
    bool whole;  // all channels are one access
    T* row(int t) const { return (T*)((char*)first + t * step); }
};
// The rows from batch element b, token t0 and channel d on.
template<class T>
static inline Rows<T> rows_from(const wp::array_t<T>& array, int b, int t0, int d, int width) {
    const size_t step = (size_t)array.strides[1];
    T* const first = (T*)((char*)array.data + (size_t)b * array.strides[0] + (size_t)t0 * step) + d;
    const bool aligned = ((size_t)first | step) % sizeof(typename Rows<T>::Whole) == 0;
    return {first, step, width, width == WIDTH && aligned};
}
template<class T>
static inline F read(const Rows<T>& rows, int t) {
    const T* const row = rows.row(t);
    if (!rows.whole) return each([&](int i) { return i < rows.width ? (float)row[i] : 0.0f; });
    const auto whole = *(const typename Rows<T>::Whole*)row;
    return each([&](int i) {
        const int bit = i * 8 * sizeof(T);
        const unsigned bits = whole.words[bit / 32] >> bit % 32;
        T value;
        memcpy(&value, &bits, sizeof value);
        return (float)value;
    });
}
template<class T>
static inline void write(const Rows<T>& rows, int t, F f) {
    T* const row = rows.row(t);
    T values[WIDTH];
#pragma unroll
    for (int i = 0; i < WIDTH; ++i) values[i] = (T)f.v[i];
    if (rows.whole) {
        typename Rows<T>::Whole whole;
        memcpy(&whole, values, sizeof whole);
        *(typename Rows<T>::Whole*)row = whole;
        return;
    }
#pragma unroll
    for (int i = 0; i < WIDTH; ++i)
        if (i < rows.width) row[i] = values[i];
}
template<class T>
static inline void put(const Rows<T>& rows, int t, F f, bool) {
    write(rows, t, f);
}
template<class T>
static inline void prefetch_right(const Rows<T>&, int) {}
static inline void finish_stores() {}

}  // namespace gamba::conv
#include "conv.h"
