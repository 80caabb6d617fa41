// Sixteen ellipses on a CPU, of Gaussians, or one for sixteen rows of its tiles.
#include "../../runtime/sixteen.h"
namespace gamba::raster {

static inline I ints(F x) { return __builtin_convertvector(x, I); }
static inline F floats(I x) { return __builtin_convertvector(x, F); }

// log(x) for x >= 1 to 2e-7 of itself or 1e-7: the limit has a slack of 1e-4. The polynomial is the
// series of 2 atanh(s) = log m to s^9, for m from sqrt(½) to sqrt(2).
static inline F log(F x) {
    const I bits = (I)x;
    const I n = (bits - 0x3f3504f3) >> 23;
    const F m = (F)(bits - (n << 23));
    const F s = (m - 1.0f) / (m + 1.0f), w = s * s;
    F p = fma(w, splat(0.2222222f), splat(0.2857143f));
    p = fma(p, w, splat(0.4f));
    p = fma(p, w, splat(0.6666667f));
    p = fma(p, w, splat(2.0f));
    return fma(floats(n), splat(0.69314718f), p * s);
}

}  // namespace gamba::raster
#include "../ellipse.h"
namespace gamba::raster {

// Of a mean, a conic, an opacity and half sides of a box.
template<class Config>
static inline Ellipse ellipse_of(const F* v, float alpha_min) {
    const F a = v[2], k = v[3], e = v[4];
    const F limit = log(v[5] / alpha_min) * (2.0f * Config::SLACK) + Config::SLACK_ABS;
    const F top = -k * a * sqrt(limit / (a * (a * k * k + e) * e));
    return {v[0], v[1], k, e, limit, splat(1.0f) / a, sqrt(limit / e), top, v[6], v[7]};
}

}  // namespace gamba::raster
