// A step's decay f and weight g of x = δA, and their slopes: equations 2 to 4 and 10. A holds
// log2(e) as well if f is an exponential.
namespace gamba::scan {

enum Mode { MAMBA, BILINEAR, ZOH };  // in the order of problem.DISCRETIZATIONS

constexpr double PHI[12] = {// of (e^x - 1) / x, lowest power first
    1., 1. / 2, 1. / 6, 1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880,
    1. / 3628800, 1. / 39916800, 1. / 479001600};

// Equation 4: the series where x is small, which it returns.
static bool exact(float step, float A, float& f, float& g, float& x, float& inverse) {
    f = exp2(step * A);
    x = step * A * 0.6931471805599453f;
    const bool small = x < 1.0f && x > -1.0f;
    inverse = reciprocal(small ? 1.0f : x);
    float series = 0.0f;
    WP_PRAGMA_UNROLL
    for (int k = 11; k >= 0; --k) series = series * x + (float)PHI[k];
    g = small ? series : (f - 1.0f) * inverse;
    return small;
}

template<int MODE>
static void factors(float step, float A, float& f, float& g) {
    if constexpr (MODE == MAMBA) {
        f = exp2(step * A), g = 1.0f;
    } else if constexpr (MODE == BILINEAR) {
        g = reciprocal(1.0f - 0.5f * (step * A));
        f = 1.0f + step * A * g;
    } else {
        float x, inverse;
        exact(step, A, f, g, x, inverse);
    }
}

// Not of MAMBA, whose weight is 1.
template<int MODE>
static void slopes(float step, float A, float& f, float& g, float& df, float& dg) {
    if constexpr (MODE == BILINEAR) {
        factors<MODE>(step, A, f, g);
        df = g * g, dg = 0.5f * df;
    } else {
        float x, inverse;
        const bool small = exact(step, A, f, g, x, inverse);
        float slope = 0.0f;
        WP_PRAGMA_UNROLL
        for (int k = 11; k >= 1; --k) slope = slope * x + (float)(k * PHI[k]);
        df = f, dg = small ? slope : (f - g) * inverse;
    }
}

}  // namespace gamba::scan
