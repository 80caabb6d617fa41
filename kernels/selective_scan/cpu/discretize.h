// A step's decay f and weight g of x = δA, and their slopes: equations 2 to 4 and 10. x is a rate
// times A, where the rate δ holds SCALE, so that exponentials are powers of two.
#include "../../runtime/lanes.h"
namespace gamba::scan {

enum Discretization { MAMBA, BILINEAR, ZOH };  // in the order of problem.DISCRETIZATIONS

static inline I within(F x, float most) { return (x <= most) & (x >= -most); }

// f, g and fm1 = f - 1, which is exact where f is slow, and any number elsewhere. IN_RANGE:
// |x| <= 125 in all lanes.
template<class Config, bool IN_RANGE>
INLINE F factors(F x, F& fm1, F& g) {
    if constexpr (Config::MODE == MAMBA) {
        g = splat(1.0f);
        if constexpr (IN_RANGE) return exp2_fm1<Config>(x, fm1);
        return fm1 = exp2(x);
    } else if constexpr (Config::MODE == BILINEAR) {
        g = 1.0f / (1.0f - 0.5f * x), fm1 = x * g;
        return fma(x, g, splat(1.0f));
    } else {  // g = (f - 1) / (x ln 2), where f - 1 is summed without the rounding of f
        auto near_zero = [&](F x) __attribute__((always_inline)) -> F {
            F near, low, part;
            const F p = exp2_parts<Config>(x, near, low, part);
            fm1 = part * p;
            const F less = fma(near, fm1 + low, near - 1.0f);
            g = within(x, 0.03125f) ? p * LOG2E : less / (x * LN2);  // |x| <= 1/32: f - 1 = x p
            return fma(near, fm1, near);
        };
        if constexpr (IN_RANGE) return near_zero(x);
        const I inside = within(x, 125.0f);
        const F near = near_zero(inside ? x : F{}), far = exp2(x);
        g = inside ? g : (far - 1.0f) / (x * LN2);
        return fm1 = inside ? near : far;
    }
}

// The slopes of f and g where g is not 1: for zoh dg is a polynomial where f - g would cancel, the
// least-squares fit of the series of (x e^x - e^x + 1) / x² at |x| <= 1/2.
template<class Config>
INLINE void slopes(F x, F f, F g, F& df, F& dg) {
    if constexpr (Config::MODE == BILINEAR) {
        df = g * g, dg = 0.5f * df;
    } else {
        const F xe = x * LN2;
        F slope = splat(1.7469932608e-4f);
        slope = fma(slope, xe, splat(1.20015557571e-3f));
        slope = fma(slope, xe, splat(6.9443082995e-3f));
        slope = fma(slope, xe, splat(3.33321221218e-2f));
        slope = fma(slope, xe, splat(0.12500000425576f));
        slope = fma(slope, xe, splat(0.33333337119712f));
        slope = fma(slope, xe, splat(0.5f));
        df = f, dg = within(xe, 0.5f) ? slope : (df - g) / xe;
    }
}

}  // namespace gamba::scan
