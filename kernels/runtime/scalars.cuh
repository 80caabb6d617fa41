// Arithmetic of one channel per thread, and numbers of a tensor as bits, for CUDA kernels.
namespace gamba {

constexpr float LOG2E = 1.4426950408889634f;

// Each of the two is one instruction on the special function unit, with a relative error of about
// 2^-22. Denormals count as 0.
static inline float exp2(float x) {
    float r;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
}
static inline float reciprocal(float x) {
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
}
// The square root, to 2 units in the last place.
static inline float root(float x) {
    float r;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
}
// x itself, so that values computed from it before need not stay in registers.
static inline int opaque(int x) {
    asm volatile("" : "+r"(x));
    return x;
}

// The product of two int32 in one instruction, as addresses need it.
static inline long long wide(int a, int b) {
    long long r;
    asm("mul.wide.s32 %0, %1, %2;" : "=l"(r) : "r"(a), "r"(b));
    return r;
}

static inline float sigmoid(float x) {
    return reciprocal(1.0f + exp2(-LOG2E * x));  // 0 where the power is infinite
}

// It has no branch and is relatively accurate for x << 0, as the one in lanes.h; 2 atanh(s) in one.
static inline float softplus(float x) {
    const float e = exp2(-LOG2E * fabsf(x)), s = e * reciprocal(e + 2.0f), w = s * s;
    const float p = 0.40021699188717086f + w * (0.27999139406777306f + w * 0.2802446564849388f);
    return fmaxf(x, 0.0f) + s * (2.0f + w * (0.6666641312961027f + w * p));
}

// This is the sigmoid, from the exponential that ``softplus`` uses as well.
static inline float softplus_slope(float x) {
    const float e = exp2(-LOG2E * fabsf(x));
    return (x < 0.0f ? e : 1.0f) * reciprocal(1.0f + e);
}

// The bits of a number: loads are in flight while a tile before is computed, and converting would
// wait for them.
static inline unsigned bits_of(const float* at) { return *(const unsigned*)at; }
template<class Half>
static inline unsigned bits_of(const Half* at) {
    return *(const unsigned short*)at;
}

template<class Number>
static inline float widen(unsigned bits) {  // of a bfloat16
    return __uint_as_float(bits << 16);
}
template<>
inline float widen<float>(unsigned bits) {
    return __uint_as_float(bits);
}
template<>
inline float widen<wp::half>(unsigned bits) {
    wp::half h;
    h.u = (unsigned short)bits;
    return wp::half_to_float(h);
}

}  // namespace gamba
