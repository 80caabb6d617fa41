// needs: problem.py: MODE, MAMBA, BILINEAR; scalars.py: reciprocal_, exp2_
// gives: factors_, slopes_, PHI, exact_
// A step's decay f and weight g of x = δA, and their slopes: equations 2 to 4 and 10. A holds
// log2(e) as well if f is an exponential.
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
