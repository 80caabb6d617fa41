"""Native inner loops of the CPU scan: state after state, a strip of tokens, sixteen channels.

Equations are those of README.md. Values per token come from ``tokens.py``; B and C
are read where they are, from token ``t0`` on.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ...runtime.lanes import lanes, prelude
from .tokens import TOKENS
from .tuning import Variant

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
_OPEN = (
    TOKENS
    + """
const F* const rates = (const F*)a_in.data;
auto state_ = [&](auto& array, int n) -> F& { return ((F*)array.data)[n]; };
// entry n of B or C, token by token
struct Column {
    const char* at;
    const size_t step;
    float operator[](int t) const { return *(const float*)(at + t * step); }
};
auto column_ = [&](auto& array, int n) -> Column {
    const auto* s = array.strides;
    return {(const char*)array.data + (size_t)batch * s[0] + (size_t)t0 * s[1]
        + (size_t)group * s[2] + (size_t)n * s[3], (size_t)s[1]};
};
for (int n = 0; n < states; ++n) {
    const F a = rates[n];
"""
)
_WALK = """
    if (tame) walk(exp2_tame_);
    else walk(exp2_);
}
"""

# Equations 1 and 5.
_ADVANCE = (
    _OPEN
    + """
    Token* const token = aligned_((Token*)scratch.data);
    const Column b = column_(b_in, n), c = column_(c_in, n);
    auto walk = [&](auto exp2) {
        F h = state_(h_out, n);
        for (int t = 0; t < count; ++t) {
            const F x = token[t].rate * a;
            FACTORS
            h = fma_(f, h, g * (token[t].du * b[t]));
            token[t].y = fma_(h, splat(c[t]), token[t].y);
        }
        state_(h_out, n) = h;
    };
"""
    + _WALK
)

# Equation 1 alone, and the product of the decays.
_ACCUMULATE = (
    _OPEN
    + """
    const Token* const token = aligned_((const Token*)scratch.data);
    const Column b = column_(b_in, n);
    auto walk = [&](auto exp2) {
        F h = state_(h_out, n), product = state_(product_out, n);
        for (int t = 0; t < count; ++t) {
            const F x = token[t].rate * a;
            FACTORS
            h = fma_(f, h, g * (token[t].du * b[t]));
            product *= f;
        }
        state_(h_out, n) = h;
        state_(product_out, n) = product;
    };
"""
    + _WALK
)

# What the outputs send back to the state before the first token, and the product of the decays.
_GATHER = (
    _OPEN
    + """
    const GradToken* const token = aligned_((const GradToken*)scratch.data);
    const Column c = column_(c_in, n);
    auto walk = [&](auto exp2) {
        F dh = state_(dh_out, n), product = state_(product_out, n);
        for (int t = 0; t < count; ++t) {
            const F x = token[t].rate * a;
            FACTORS
            product *= f;
            dh = fma_(product, token[t].dy * c[t], dh);
        }
        state_(dh_out, n) = dh;
        state_(product_out, n) = product;
    };
"""
    + _WALK
)

# As _ADVANCE, keeping f and h of every token, and adding dy·h to the sums of dC (equation 8); then
# backwards, equations 6, 7 and 9 to 12. Σ rate q is left in da.
_RETREAT = f"""
    GradToken* const token = aligned_((GradToken*)scratch.data);
    Kept* const kept = aligned_((Kept*)kept_out.data);
    const Column b = column_(b_in, n), c = column_(c_in, n);
    F* const db = (F*)db_out.data + n * CHUNK;
    F* const dc = (F*)dc_out.data + n * CHUNK;
    if (first) for (int t = 0; t < count; ++t) {{
        if (needs & {NEED_DB}) db[t] = F{{}};
        if (needs & {NEED_DC}) dc[t] = F{{}};
    }}
    auto walk = [&](auto exp2) {{
        F h = state_(starts_in, n);
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
    if (!(needs & {NEED_DH})) continue;
    F dh = state_(dh_out, n), da = F{{}};
    for (int t = count - 1; t >= 0; --t) {{
        GradToken& own = token[t];
        const F f = kept[t].f;
        dh = fma_(own.dy, splat(c[t]), dh);
        GRADIENT
        own.p = fma_(q, a, own.p);
        da = fma_(q, own.rate, da);
    }}
    state_(dh_out, n) = dh;
    state_(da_out, n) += da;
}}
"""
_OWN = f"""
        if (needs & {NEED_DB}) db[t] = fma_(dh, own.du, db[t]);
        own.s = fma_(dh, splat(b[t]), own.s);
        dh = f * dh;
        const F q = dh * kept[t].h;
"""
_GENERAL = f"""
        const F x = own.rate * a;
        SLOPES
        const F gh = g * dh;
        if (needs & {NEED_DB}) db[t] = fma_(gh, own.du, db[t]);
        own.s = fma_(gh, splat(b[t]), own.s);
        const F q = dh * (kept[t].h * df + own.du * b[t] * dg);
        dh = f * dh;
"""
_GRADIENTS = {
    "mamba": _OWN,
    "bilinear": _GENERAL.replace("SLOPES", _SLOPES["bilinear"]),
    "zoh": _GENERAL.replace("SLOPES", _SLOPES["zoh"]),
}


@functools.cache
def forward_leaves(discretization: str, degree: int) -> SimpleNamespace:
    """``advance`` and ``accumulate``: the states of a lane group from before the strip to after."""
    factors, head = _FACTORS[discretization], prelude(degree)

    @wp.func_native(head + _ADVANCE.replace("FACTORS", factors))
    def advance(
        states: int,
        tame: int,
        batch: int,
        group: int,
        t0: int,
        count: int,
        a_in: wp.array(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        c_in: wp.array4d(dtype=wp.float32),
        scratch: wp.array(dtype=lanes),
        h_out: wp.array(dtype=lanes),
    ): ...

    @wp.func_native(head + _ACCUMULATE.replace("FACTORS", factors))
    def accumulate(
        states: int,
        tame: int,
        batch: int,
        group: int,
        t0: int,
        count: int,
        a_in: wp.array(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        scratch: wp.array(dtype=lanes),
        h_out: wp.array(dtype=lanes),
        product_out: wp.array(dtype=lanes),
    ): ...

    return SimpleNamespace(advance=advance, accumulate=accumulate)


@functools.cache
def backward_leaves(discretization: str, variant: Variant) -> SimpleNamespace:
    """``retreat`` and ``gather``: gradients of states from after the chunk to before.

    ``first`` says that the sums of dB and dC are empty yet.
    """
    factors = _FACTORS[discretization]
    head, chunk = prelude(variant.degree), str(variant.chunk)
    retreat_text = _OPEN + _RETREAT.replace("GRADIENT", _GRADIENTS[discretization])
    retreat_text = retreat_text.replace("FACTORS", factors).replace("CHUNK", chunk)

    @wp.func_native(head + retreat_text)
    def retreat(
        states: int,
        tame: int,
        batch: int,
        group: int,
        t0: int,
        count: int,
        first: int,
        needs: int,
        a_in: wp.array(dtype=lanes),
        b_in: wp.array4d(dtype=wp.float32),
        c_in: wp.array4d(dtype=wp.float32),
        starts_in: wp.array(dtype=lanes),
        scratch: wp.array(dtype=lanes),
        kept_out: wp.array(dtype=lanes),
        db_out: wp.array(dtype=lanes),
        dc_out: wp.array(dtype=lanes),
        dh_out: wp.array(dtype=lanes),
        da_out: wp.array(dtype=lanes),
    ): ...

    @wp.func_native(head + _GATHER.replace("FACTORS", factors))
    def gather(
        states: int,
        tame: int,
        batch: int,
        group: int,
        t0: int,
        count: int,
        a_in: wp.array(dtype=lanes),
        c_in: wp.array4d(dtype=wp.float32),
        scratch: wp.array(dtype=lanes),
        dh_out: wp.array(dtype=lanes),
        product_out: wp.array(dtype=lanes),
    ): ...

    return SimpleNamespace(retreat=retreat, gather=gather, sum_lanes=_sum_lanes(variant.chunk))


# Rows of ``sums`` [states, CHUNK] to their sums over lanes, eight rows at a time.
_SUM_LANES = """
typedef float E __attribute__((vector_size(32), aligned(4)));
const E* const rows = (const E*)sums.data;
auto pair = [](E a, E b) -> E {
    return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13)
        + __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
};
auto quad = [](E a, E b) -> E {
    return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13)
        + __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
};
for (int n = 0; n < states; ++n)
    for (int t = 0; t < count; t += 8) {
        const E* const r = rows + 2 * (n * CHUNK + t);
        E v[8];
        for (int i = 0; i < 8; ++i) v[i] = r[2 * i] + r[2 * i + 1];
        const E low = quad(pair(v[0], v[1]), pair(v[2], v[3]));
        const E high = quad(pair(v[4], v[5]), pair(v[6], v[7]));
        const E all = __builtin_shufflevector(low, high, 0, 1, 2, 3, 8, 9, 10, 11)
            + __builtin_shufflevector(low, high, 4, 5, 6, 7, 12, 13, 14, 15);
        float* const out = total.data + n * (size_t)length + t0 + t;
        if (t + 8 <= count) *(E*)out = all;
        else for (int i = 0; i < count - t; ++i) out[i] = all[i];
    }
"""


@functools.cache
def _sum_lanes(chunk: int):
    @wp.func_native(_SUM_LANES.replace("CHUNK", str(chunk)))
    def sum_lanes(
        states: int,
        length: int,
        t0: int,
        count: int,
        sums: wp.array(dtype=lanes),
        total: wp.array(dtype=wp.float32),
    ): ...

    return sum_lanes
