"""Native inner loops of the CPU scan: one state n, a strip of tokens, sixteen channels.

Equations are those of README.md. Values per token come from ``tokens.py``; rows of B and C are
passed whole, the strip's first token is ``t0``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .lanes import LANES, PRELUDE, lanes
from .tokens import TOKENS

# gradients that cost work inside the loops, as bits of ``needs``
NEED_DZ, NEED_DC, NEED_DB, NEED_DH = 1, 2, 4, 8

LOG2E = 1.4426950408889634
# what δ is multiplied by to give ``rate``: exponentials are powers of two
SCALES = {"mamba": LOG2E, "bilinear": 1.0, "zoh": LOG2E}

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
    const F g = small ? series : (f - 1.0f) / safe;
"""
# Equations 2 to 4: f and g of x = rate A.
_FACTORS = {
    "mamba": "const F f = exp2(x); const F g = splat(1.0f);",
    "bilinear": "const F g = 1.0f / (1.0f - 0.5f * x); const F f = fma_(x, g, splat(1.0f));",
    "zoh": "const F f = exp2(x);" + _PHI,
}
# And their slopes, f given.
_SLOPES = {
    "bilinear": "const F g = 1.0f / (1.0f - 0.5f * x); const F df = g * g, dg = 0.5f * df;",
    "zoh": _PHI + "const F df = f, dg = small ? slope : (f - g) / safe;",
}
_OPERANDS = (
    PRELUDE
    + TOKENS
    + """
F h = *(const F*)&h_in;
const F a = *(const F*)&a_in;
const float* b = &b_in.data[t0];
"""
)
_RETURN = f"{LANES} r; *(F*)&r = h; return r;"

# Equations 1 and 5.
_ADVANCE = """
const float* c = &c_in.data[t0];
Token* const token = aligned_((Token*)scratch.data) + first;
auto walk = [&](auto exp2) {
    for (int t = 0; t < count; ++t) {
        const F x = token[t].rate * a;
        FACTORS
        h = fma_(f, h, g * (token[t].du * b[t]));
        token[t].y = fma_(h, splat(c[t]), token[t].y);
    }
};
if (tame) walk(exp2_tame_);
else walk(exp2_);
"""

# Equation 1 alone, and the product of the decays.
_ACCUMULATE = """
F& product = *(F*)product_out.data;
const Token* const token = aligned_((const Token*)scratch.data) + first;
auto walk = [&](auto exp2) {
    F decay = product;
    for (int t = 0; t < count; ++t) {
        const F x = token[t].rate * a;
        FACTORS
        h = fma_(f, h, g * (token[t].du * b[t]));
        decay *= f;
    }
    product = decay;
};
if (tame) walk(exp2_tame_);
else walk(exp2_);
"""

# What the outputs send back to the state before the first token, and the product of the decays.
_GATHER = """
F& product = *(F*)product_out.data;
const float* c = &b_in.data[t0];
const GradToken* const token = aligned_((const GradToken*)scratch.data) + first;
auto walk = [&](auto exp2) {
    F decay = product;
    for (int t = 0; t < count; ++t) {
        const F x = token[t].rate * a;
        FACTORS
        decay *= f;
        h = fma_(decay, token[t].dy * c[t], h);
    }
    product = decay;
};
if (tame) walk(exp2_tame_);
else walk(exp2_);
"""

# As _ADVANCE, keeping f and h of every token, and adding dy·h to the sums of dC (equation 8).
_RECOMPUTE = f"""
const float* c = &c_in.data[t0];
GradToken* const token = aligned_((GradToken*)scratch.data) + first;
Kept* const kept = aligned_((Kept*)kept_out.data);
F* const dc = (F*)dc_out.data + row;
auto walk = [&](auto exp2) {{
    for (int t = 0; t < count; ++t) {{
        const F x = token[t].rate * a;
        FACTORS
        kept[t].f = f;
        kept[t].h = h;
        h = fma_(f, h, g * (token[t].du * b[t]));
        if (needs & {NEED_DZ}) token[t].y = fma_(h, splat(c[t]), token[t].y);
        if (needs & {NEED_DC}) dc[t] = fma_(token[t].dy, h, dc[t]);
    }}
}};
if (tame) walk(exp2_tame_);
else walk(exp2_);
"""

# Equations 6, 7 and 9 to 12, backwards; h is the gradient of h_t, da is Σ rate q.
_RETREAT = """
const float* c = &c_in.data[t0];
GradToken* const token = aligned_((GradToken*)scratch.data) + first;
const Kept* const kept = aligned_((const Kept*)kept_in.data);
F* const db = (F*)db_out.data + row;
F da = F{};
for (int t = count - 1; t >= 0; --t) {
    GradToken& k = token[t];
    h = fma_(k.dy, splat(c[t]), h);
    const F f = kept[t].f;
    GRADIENT
    k.p = fma_(q, a, k.p);
    da = fma_(q, k.rate, da);
}
*(F*)da_out.data = da;
"""
_OWN = f"""
    if (needs & {NEED_DB}) db[t] = fma_(h, k.du, db[t]);
    k.s = fma_(h, splat(b[t]), k.s);
    h = f * h;
    const F q = h * kept[t].h;
"""
_GENERAL = f"""
    const F x = k.rate * a;
    SLOPES
    const F gh = g * h;
    if (needs & {NEED_DB}) db[t] = fma_(gh, k.du, db[t]);
    k.s = fma_(gh, splat(b[t]), k.s);
    const F q = h * (kept[t].h * df + k.du * b[t] * dg);
    h = f * h;
"""
_GRADIENTS = {
    "mamba": _OWN,
    "bilinear": _GENERAL.replace("SLOPES", _SLOPES["bilinear"]),
    "zoh": _GENERAL.replace("SLOPES", _SLOPES["zoh"]),
}


@functools.cache
def forward_leaves(discretization: str) -> SimpleNamespace:
    """``advance`` and ``accumulate``; both return the state after the strip."""
    factors = _FACTORS[discretization]

    @wp.func_native(_OPERANDS + _ADVANCE.replace("FACTORS", factors) + _RETURN)
    def advance(
        h_in: lanes,
        a_in: lanes,
        tame: int,
        b_in: wp.array(dtype=wp.float32),
        c_in: wp.array(dtype=wp.float32),
        t0: int,
        count: int,
        first: int,
        scratch: wp.array(dtype=lanes),
    ) -> lanes: ...

    @wp.func_native(_OPERANDS + _ACCUMULATE.replace("FACTORS", factors) + _RETURN)
    def accumulate(
        h_in: lanes,
        a_in: lanes,
        tame: int,
        b_in: wp.array(dtype=wp.float32),
        t0: int,
        count: int,
        first: int,
        scratch: wp.array(dtype=lanes),
        product_out: wp.array(dtype=lanes),
    ) -> lanes: ...

    return SimpleNamespace(advance=advance, accumulate=accumulate)


@functools.cache
def backward_leaves(discretization: str) -> SimpleNamespace:
    """``recompute``, ``retreat`` and ``gather``; two return the gradient of the first state."""
    factors = _FACTORS[discretization]
    gradient = _GRADIENTS[discretization]

    @wp.func_native(_OPERANDS + _RECOMPUTE.replace("FACTORS", factors))
    def recompute(
        h_in: lanes,
        a_in: lanes,
        tame: int,
        b_in: wp.array(dtype=wp.float32),
        c_in: wp.array(dtype=wp.float32),
        t0: int,
        count: int,
        first: int,
        scratch: wp.array(dtype=lanes),
        needs: int,
        row: int,
        kept_out: wp.array(dtype=lanes),
        dc_out: wp.array(dtype=lanes),
    ): ...

    @wp.func_native(_OPERANDS + _RETREAT.replace("GRADIENT", gradient) + _RETURN)
    def retreat(
        h_in: lanes,
        a_in: lanes,
        b_in: wp.array(dtype=wp.float32),
        c_in: wp.array(dtype=wp.float32),
        t0: int,
        count: int,
        first: int,
        scratch: wp.array(dtype=lanes),
        needs: int,
        row: int,
        kept_in: wp.array(dtype=lanes),
        db_out: wp.array(dtype=lanes),
        da_out: wp.array(dtype=lanes),
    ) -> lanes: ...

    @wp.func_native(_OPERANDS + _GATHER.replace("FACTORS", factors) + _RETURN)
    def gather(
        h_in: lanes,
        a_in: lanes,
        tame: int,
        b_in: wp.array(dtype=wp.float32),
        t0: int,
        count: int,
        first: int,
        scratch: wp.array(dtype=lanes),
        product_out: wp.array(dtype=lanes),
    ) -> lanes: ...

    return SimpleNamespace(recompute=recompute, retreat=retreat, gather=gather)


@wp.func_native(
    PRELUDE
    + """
const F* p = (const F*)sums.data + first;
for (int t = 0; t < count; ++t) {
    F v = p[t];
    v += __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7);
    v += __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3, 8, 9, 10, 11, 12, 13, 14, 15);
    out.data[t0 + t] = (v[0] + v[1]) + (v[2] + v[3]);
}
"""
)
def sum_lanes(
    sums: wp.array(dtype=lanes), first: int, count: int, t0: int, out: wp.array(dtype=wp.float32)
): ...
