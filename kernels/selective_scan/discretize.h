// needs: problem.py: ON_CPU, MODE, MAMBA, BILINEAR; lanes.h: exp2_fm1_, exp2_, exp2_parts_, LOG2E;
//     sixteen.inl: F, splat, fma_, I; scalars.py: reciprocal_
// gives: InRange, AnyRange, LN2, within_, factors_, slopes_, PHI, exact_
// A step's decay f and weight g of x = δA, and their slopes: equations 2 to 4 and 10. A holds
// log2(e) as well if f is an exponential.
#if ON_CPU  // on the CPU: x = rate A, where the rate holds SCALE

// fm1 is f - 1, exact where f is slow, and any number elsewhere. InRange: |x| <= 125 in all lanes.
struct InRange {
    enum { IN_RANGE = true };
};
struct AnyRange {
    enum { IN_RANGE = false };
};
const float LN2 = 0.6931471805599453f;
auto within_ = [&](F x, float most) -> I { return (x <= most) & (x >= -most); };
auto factors_ = [&](F x, auto range, F& fm1, F& g) __attribute__((always_inline)) -> F {
    constexpr bool IN_RANGE = decltype(range)::IN_RANGE;
    if constexpr (MODE == MAMBA) {
        g = splat(1.0f);
        if constexpr (IN_RANGE) return exp2_fm1_(x, fm1);
        return fm1 = exp2_(x);
    } else if constexpr (MODE == BILINEAR) {
        g = 1.0f / (1.0f - 0.5f * x), fm1 = x * g;
        return fma_(x, g, splat(1.0f));
    } else {  // g = (f - 1) / (x ln 2), where f - 1 is summed without the rounding of f
        auto near_zero_ = [&](F x) __attribute__((always_inline)) -> F {
            F near, low, part;
            const F p = exp2_parts_(x, near, low, part);
            fm1 = part * p;
            const F less = fma_(near, fm1 + low, near - 1.0f);
            g = within_(x, 0.03125f) ? p * LOG2E : less / (x * LN2);  // |x| <= 1/32: f - 1 = x p
            return fma_(near, fm1, near);
        };
        if constexpr (IN_RANGE) return near_zero_(x);
        const I inside = within_(x, 125.0f);
        const F near = near_zero_(inside ? x : F{}), far = exp2_(x);
        g = inside ? g : (far - 1.0f) / (x * LN2);
        return fm1 = inside ? near : far;
    }
};
// The slopes of f and g, where WEIGHTED: for zoh dg is a polynomial where f - g would cancel.
auto slopes_ = [&](F x, F f, F g, F& df, F& dg) __attribute__((always_inline)) {
    if constexpr (MODE == BILINEAR) {
        df = g * g, dg = 0.5f * df;
    } else {
        const F xe = x * LN2;
        F slope = splat(1.7469932608e-4f);
        slope = fma_(slope, xe, splat(1.20015557571e-3f));
        slope = fma_(slope, xe, splat(6.9443082995e-3f));
        slope = fma_(slope, xe, splat(3.33321221218e-2f));
        slope = fma_(slope, xe, splat(0.12500000425576f));
        slope = fma_(slope, xe, splat(0.33333337119712f));
        slope = fma_(slope, xe, splat(0.5f));
        df = f, dg = within_(xe, 0.5f) ? slope : (df - g) / xe;
    }
};

#else  // on CUDA

constexpr double PHI[12] = {// of (e^x - 1) / x, lowest power first
    1., 1. / 2, 1. / 6, 1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880,
    1. / 3628800, 1. / 39916800, 1. / 479001600};
// Equation 4: the series where x is small, which it returns.
auto exact_ = [&](float rate, float a, float& f, float& g, float& x, float& inverse) -> bool {
    f = exp2_(rate * a);
    x = rate * a * 0.6931471805599453f;
    const bool small = x < 1.0f && x > -1.0f;
    inverse = reciprocal_(small ? 1.0f : x);
    float series = 0.0f;
    WP_PRAGMA_UNROLL
    for (int k = 11; k >= 0; --k) series = series * x + (float)PHI[k];
    g = small ? series : (f - 1.0f) * inverse;
    return small;
};
auto factors_ = [&](float rate, float a, float& f, float& g) {
    if constexpr (MODE == MAMBA) {
        f = exp2_(rate * a), g = 1.0f;
    } else if constexpr (MODE == BILINEAR) {
        g = reciprocal_(1.0f - 0.5f * (rate * a));
        f = 1.0f + rate * a * g;
    } else {
        float x, inverse;
        exact_(rate, a, f, g, x, inverse);
    }
};
// Where WEIGHTED.
auto slopes_ = [&](float rate, float a, float& f, float& g, float& df, float& dg) {
    if constexpr (MODE == BILINEAR) {
        factors_(rate, a, f, g);
        df = g * g, dg = 0.5f * df;
    } else {
        float x, inverse;
        const bool small = exact_(rate, a, f, g, x, inverse);
        float slope = 0.0f;
        WP_PRAGMA_UNROLL
        for (int k = 11; k >= 1; --k) slope = slope * x + (float)(k * PHI[k]);
        df = f, dg = small ? slope : (f - g) * inverse;
    }
};

#endif
