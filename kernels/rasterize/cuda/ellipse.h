// The ellipse of a Gaussian on CUDA, one of a thread. A root, a reciprocal and a logarithm are one
// instruction each, off by about 2^-22, which the slack of the limit covers. The tests run the
// lists on a CPU too.
namespace gamba::raster {

typedef float F;
typedef int I;
static inline F splat(float x) { return x; }
static inline F max(F a, F b) { return wp::max(a, b); }
static inline F min(F a, F b) { return wp::min(a, b); }
static inline F floats(I x) { return (float)x; }
static inline I ints(F x) { return (int)x; }
#ifdef __CUDA_ARCH__
static inline F sqrt(F x) {
    asm("sqrt.approx.ftz.f32 %0, %0;" : "+f"(x));
    return x;
}
static inline F reciprocal(F x) {
    asm("rcp.approx.ftz.f32 %0, %0;" : "+f"(x));
    return x;
}
static inline F log2(F x) {
    asm("lg2.approx.ftz.f32 %0, %0;" : "+f"(x));
    return x;
}
#else
static inline F sqrt(F x) { return wp::sqrt(x); }
static inline F reciprocal(F x) { return 1.0f / x; }
static inline F log2(F x) { return wp::log2(x); }
#endif

// Two numbers of an array, at once where they lie at a multiple of 8 bytes.
static inline wp::vec2 load(const wp::array_t<wp::vec2>& values, int i) {
    struct alignas(8) Two {
        float x, y;
    };
    const wp::vec2* const at = values.data + i;
    if ((size_t)at & 7) return *at;
    const Two two = *(const Two*)at;
    return {two.x, two.y};
}

}  // namespace gamba::raster
#include "../ellipse.h"
namespace gamba::raster {

// The ellipse of Gaussian i with that box, which matters where tiles are tested against it.
template<class Config, class Splats>
static inline Ellipse ellipse_of(const Splats& splats, int i, float alpha_min, wp::vec2 box) {
    constexpr float TWICE_LN2 = 1.3862943611198906f;
    const wp::vec2 mean = load(splats.means2d, i);
    const wp::vec3 conic = splats.conics.data[i];
    const float a = conic[0], k = conic[1], e = conic[2];
    const float level = log2(splats.view_opacities.data[i] * reciprocal(alpha_min));
    const float limit = TWICE_LN2 * level * Config::SLACK + Config::SLACK_ABS;
    const float over_a = reciprocal(a), reach = sqrt(limit * reciprocal(e));
    const float top = -k * a * reach * sqrt(over_a * reciprocal(a * k * k + e));
    return {mean[0], mean[1], k, e, limit, over_a, reach, top, box[0], box[1]};
}

}  // namespace gamba::raster
