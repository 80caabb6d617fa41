"""A step's decay f and weight g in C++ text, and a state that takes them: equations 2 to 4, 10.

f of a slow decay is so near to 1 that float32 rounds most of what it says away. So a channel that
is slow for all tokens of a chunk takes f - 1 as well, which float32 holds to its last bit, and its
state is kept as a sum of two numbers.
"""

# The factor from δ to ``rate``: exponentials are computed as powers of two.
SCALES = {"mamba": 1.4426950408889634, "bilinear": 1.0, "zoh": 1.4426950408889634}

# Of x = rate A: f, g, and the rise f - 1, which is exact where f is slow, and any number elsewhere.
FACTORS = {
    "mamba": "F rise; const F f = decay(x, rise), g = splat(1.0f);",
    "bilinear": """
        const F g = 1.0f / (1.0f - 0.5f * x), rise = x * g, f = fma_(x, g, splat(1.0f));
    """,
    "zoh": "F rise, g; const F f = decay(x, rise, g);",
}
# From x, g and m, which is f or its rise: the slopes df and dg of f and g. That of zoh is a
# polynomial where f - g would cancel.
SLOPES = {
    "bilinear": "const F df = g * g, dg = 0.5f * df;",
    "zoh": """
    const F df = State::decay_of(m, quiet), xe = x * 0.6931471805599453f;
    F slope = splat(1.7469932608e-4f);
    slope = fma_(slope, xe, splat(1.20015557571e-3f));
    slope = fma_(slope, xe, splat(6.9443082995e-3f));
    slope = fma_(slope, xe, splat(3.33321221218e-2f));
    slope = fma_(slope, xe, splat(0.12500000425576f));
    slope = fma_(slope, xe, splat(0.33333337119712f));
    slope = fma_(slope, xe, splat(0.5f));
    const F dg = within_(xe, 0.5f) ? slope : (df - g) / xe;
    """,
}

# What the gradient keeps of a token and state: f or its rise, the state before, and what it needs
# of g that is not quickly computed again.
KEPT = {"mamba": ("m", "h"), "bilinear": ("m", "h", "g"), "zoh": ("m", "h", "g")}

# A chunk is walked with care for slow decays where |x| <= 1/128 in one channel of the sixteen at
# least, or 1/32 in all. Then all channels with |x| <= 1/32 count as slow. Chunks of more than 64
# tokens take smaller limits, by their length, so that a state does not leave its base far behind.
SLOWEST, MODERATE = 1 / 128, 1 / 32


def limits(chunk: int) -> dict[str, str]:
    """The numbers that ``STATE`` names, for chunks of that many tokens."""
    share = min(1.0, 64 / chunk)
    return {"SLOWEST": f"{SLOWEST * share!r}f", "MODERATE": f"{MODERATE * share!r}f"}


# A state while it is walked. ``Plain`` is one number. ``Slow`` has lanes like it, and in those of
# ``quiet`` a base and the change since then, which is small, so that a step rounds away no more
# than a last bit of the change. In memory a state is two numbers, the second of which is what the
# first has rounded away: otherwise changes by less than a last bit would be lost at the end of
# every chunk. The base of a lane that is not slow is 0, which leaves the arithmetic of ``Plain``:
# such a lane has the same bits in both.
STATE = """
struct Plain {
    F h;
    Plain() {}
    Plain(F high, F low, I) : h(high + low) {}
    static F one_of(F f, F, I) { return f; }
    static F decay_of(F m, I) { return m; }
    F value() const { return h; }
    void add(F a, F b) { h = __builtin_elementwise_fma(a, b, h); }
    void decay(F m) { h *= m; }
    void step(F f, F, F w) { h = __builtin_elementwise_fma(f, h, w); }
    void keep(F& high, F& low) const { high = h, low = F{}; }
};
struct Slow {
    F base, change, h;
    I quiet;
    Slow() {}
    Slow(F high, F low, I slow)
        : base((F)((I)high & slow)), change(slow ? low : high + low), h(high + low), quiet(slow) {}
    // what is kept of a decay: its rise where it is slow
    static F one_of(F f, F rise, I slow) { return (F)((I)f & ~slow | (I)rise & slow); }
    static F decay_of(F m, I slow) { return m + (F)((I)(F{} + 1.0f) & slow); }
    F value() const { return h; }
    void add(F a, F b) { change = __builtin_elementwise_fma(a, b, change), h = base + change; }
    void decay(F m) {
        change = __builtin_elementwise_fma(m, h, (F)((I)change & quiet)), h = base + change;
    }
    void step(F f, F rise, F w) {
        change = __builtin_elementwise_fma(f, change, __builtin_elementwise_fma(rise, base, w));
        h = base + change;
    }
    void keep(F& high, F& low) const { high = h, low = change - (h - base); }
};
auto within_ = [&](F x, float most) -> I { return (x <= most) & (x >= -most); };
// whether largest x of each lane are worth a slow walk; without branches, which would be guessed
auto worth_ = [&](F x) -> int {
    return (int)(__builtin_reduce_or(within_(x, SLOWEST)) != 0)
        | (int)(__builtin_reduce_or(~within_(x, MODERATE)) == 0);
};
auto quiet_ = [&](F x) -> I { return within_(x, MODERATE) & -worth_(x); };  // the slow lanes
"""

# What gives f and its rise of x, and for zoh g: ``tamed`` where |x| <= 125, ``wild`` anywhere.
_DECAYS = """
auto wild = [&](F x, F& rise) __attribute__((always_inline)) -> F { return rise = exp2_(x); };
auto tamed = [&](F x, F& rise) __attribute__((always_inline)) -> F { return exp2_rise_(x, rise); };
"""
# g = (f - 1) / (x ln 2). f - 1 is summed without the rounding of f; where |x| <= 1/32, f - 1 = x p.
_DECAYS_ZOH = """
const float LN2 = 0.6931471805599453f;
auto tamed = [&](F x, F& rise, F& g) __attribute__((always_inline)) -> F {
    F near, low, part;
    const F p = exp2_parts_(x, near, low, part);
    rise = part * p;
    const F less = fma_(near, rise + low, near - 1.0f);
    g = within_(x, 0.03125f) ? p * LOG2E : less / (x * LN2);
    return fma_(near, rise, near);
};
auto wild = [&](F x, F& rise, F& g) __attribute__((always_inline)) -> F {
    const I calm = within_(x, 125.0f);
    const F near = tamed(calm ? x : F{}, rise, g), far = exp2_(x);
    g = calm ? g : (far - 1.0f) / (x * LN2);
    return rise = calm ? near : far;
};
"""
DECAYS = {"mamba": _DECAYS, "bilinear": _DECAYS, "zoh": _DECAYS_ZOH}


def walk(name: str, body: str) -> str:
    """C++ text of a lambda with that body, of a kind of state and what gives its decays.

    These are Plain or Slow, and ``tamed``, or ``wild`` for Plain. The body may name State.
    """
    return f"""
auto {name} = [&](auto kind, auto decay) __attribute__((always_inline)) {{
    using State = decltype(kind);
    {body}
}};
"""
