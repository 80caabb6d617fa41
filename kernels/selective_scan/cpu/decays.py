"""A step's decay f and weight g in C++ text, and a state that takes them: equations 2 to 4, 10.

f of a slow decay is so near to 1 that float32 rounds most of what it says away. So the states of a
chunk whose decays are all slow take f - 1 instead, which float32 holds to its last bit, and are
kept as a sum of two numbers.
"""

# The factor from δ to ``rate``: exponentials are computed as powers of two.
SCALES = {"mamba": 1.4426950408889634, "bilinear": 1.0, "zoh": 1.4426950408889634}

_PHI = """
    const F xe = x * 0.6931471805599453f;
    F series = splat(2.505210838544172e-8f), slope = splat(2.505210838544172e-7f);
    const float series_of[10] = {2.755731922398589e-7f, 2.755731922398589e-6f, 2.48015873015873e-5f,
        1.984126984126984e-4f, 1.388888888888889e-3f, 8.333333333333333e-3f,
        4.1666666666666664e-2f, 0.16666666666666666f, 0.5f, 1.0f};
    for (int i = 0; i < 10; ++i) series = fma_(series, xe, splat(series_of[i]));
    for (int i = 0; i < 9; ++i) slope = fma_(slope, xe, splat(series_of[i] * (float)(9 - i)));
    const I small = (xe < 1.0f) & (xe > -1.0f);
    const F safe = small ? splat(1.0f) : xe;
    const F g = small ? series : (m - 1.0f) / safe;
"""
# Of x = rate A: m, which is f here, and g.
FACTORS = {
    "mamba": "const F m = exp2(x), g = splat(1.0f);",
    "bilinear": "const F g = 1.0f / (1.0f - 0.5f * x), m = fma_(x, g, splat(1.0f));",
    "zoh": "const F m = exp2(x);" + _PHI,
}
# From x and m: the slopes df and dg of f and g, and g again.
SLOPES = {
    "bilinear": "const F g = 1.0f / (1.0f - 0.5f * x), df = g * g, dg = 0.5f * df;",
    "zoh": _PHI + "const F df = m, dg = small ? slope : (m - g) / safe;",
}

SPREAD = 64  # a decay is slow where |x| <= 1 / SPREAD; longer chunks take their length instead
# (2^x - 1) / x for |x| <= 1/64: the series of the exponential, off by 5.3e-8 at most.
_RISE = """
    const F rise = fma_(fma_(splat(0.05550410866482158f), x, splat(0.2402265069591007f)), x,
        splat(0.6931471805599453f));
"""
# The same where the decay is slow; m is f - 1 here.
SLOW_FACTORS = {
    "mamba": _RISE + "const F m = x * rise, g = splat(1.0f);",
    "bilinear": "const F g = 1.0f / (1.0f - 0.5f * x), m = x * g;",
    "zoh": _RISE + "const F m = x * rise, g = rise * 1.4426950408889634f;",
}
SLOW_SLOPES = {
    "bilinear": SLOPES["bilinear"],
    "zoh": _RISE
    + """
    const F g = rise * 1.4426950408889634f, df = m + 1.0f, xe = x * 0.6931471805599453f;
    const F dg = fma_(fma_(splat(0.125f), xe, splat(0.3333333333333333f)), xe, splat(0.5f));
    """,
}

# A state while it is walked. ``Plain`` is one number. ``Slow`` is a base and the change since then,
# which is small, so that a step rounds away no more than a last bit of the change. In memory a
# state is two numbers, the second of which is what the first has rounded away: otherwise changes by
# less than a last bit would be lost at the end of every chunk.
STATE = """
struct Plain {
    F h;
    Plain(F high, F low) : h(high + low) {}
    F value() const { return h; }
    void add(F a, F b) { h = __builtin_elementwise_fma(a, b, h); }
    void decay(F m) { h *= m; }
    void step(F m, F w) { h = __builtin_elementwise_fma(m, h, w); }
    void keep(F& high, F& low) const { high = h, low = F{}; }
};
struct Slow {
    F base, change;
    Slow(F high, F low) : base(high), change(low) {}
    F value() const { return base + change; }
    void add(F a, F b) { change = __builtin_elementwise_fma(a, b, change); }
    void decay(F m) { change = __builtin_elementwise_fma(m, base + change, change); }
    void step(F m, F w) {
        change += __builtin_elementwise_fma(m, change, __builtin_elementwise_fma(m, base, w));
    }
    void keep(F& high, F& low) const {
        const F h = base + change;
        low = change - (h - base), high = h;
    }
};
const float slowest = 1.0f / SPREAD;
auto slow_ = [&](F x) -> bool {
    return !__builtin_reduce_or(~((x <= slowest) & (x >= -slowest)));
};
"""


def walks(name: str, body: str, discretization: str) -> str:
    """C++ text of two lambdas with that body: ``name``, of an exp2, and ``slow_name``, of anything.

    The body may hold FACTORS and SLOPES, which stand for m, g, df and dg of x, and STATE, which
    stands for the type of a state.
    """
    plain = {"FACTORS": FACTORS, "SLOPES": SLOPES}, "Plain"
    slow = {"FACTORS": SLOW_FACTORS, "SLOPES": SLOW_SLOPES}, "Slow"
    text = ""
    for prefix, (parts, state) in (("", plain), ("slow_", slow)):
        own = body.replace("STATE", state)
        for part, by_name in parts.items():
            own = own.replace(part, by_name.get(discretization, ""))
        text += f"auto {prefix}{name} = [&](auto exp2) __attribute__((always_inline)) {{{own}}};\n"
    return text
