"""Native inner loops of the CPU scan: one state n, a chunk of tokens, sixteen channels.

Equations are those of README.md. Rows of B and C are passed from the chunk's first token ``t0`` on.
"""

import warp as wp

from .lanes import LANES, PRELUDE, lanes

# gradients that cost work inside the loops, as bits of ``needs``
NEED_DZ, NEED_DC, NEED_DB, NEED_DH = 1, 2, 4, 8

# Equations 2 to 4 by mode: f and g of x = δA and their slopes. ``rate`` is δ, times log2(e) where
# an exponential is wanted. ``mode`` is a constant of the kernel, so that one branch remains.
MODES = {"mamba": 0, "bilinear": 1, "zoh": 2}
_PHI = """
    F x = rate[t] * a * 0.6931471805599453f;
    F series = F{} + 2.505210838544172e-8f, slope = F{} + 2.505210838544172e-7f;
    const float k[10] = {2.755731922398589e-7f, 2.755731922398589e-6f, 2.48015873015873e-5f,
        1.984126984126984e-4f, 1.388888888888889e-3f, 8.333333333333333e-3f,
        4.1666666666666664e-2f, 0.16666666666666666f, 0.5f, 1.0f};
    for (int i = 0; i < 10; ++i) series = fma_(series, x, F{} + k[i]);
    for (int i = 0; i < 9; ++i) slope = fma_(slope, x, F{} + k[i] * (float)(9 - i));
    I small = (x < 1.0f) & (x > -1.0f);
    F safe = small ? F{} + 1.0f : x;
    g = small ? series : (f - 1.0f) / safe;
"""
_STEP = (
    """
    F f, g = F{} + 1.0f;
    if (mode == 1) {
        g = 1.0f / (1.0f - 0.5f * (rate[t] * a));
        f = fma_(rate[t] * a, g, F{} + 1.0f);
    } else f = exp2_(rate[t] * a);
    if (mode == 2) {"""
    + _PHI
    + "}"
)
_SLOPE = (
    """
    F f = fs[t], g = F{} + 1.0f, df = f, dg = F{};
    if (mode == 1) {
        g = 1.0f / (1.0f - 0.5f * (rate[t] * a));
        df = g * g;
        dg = 0.5f * df;
    }
    if (mode == 2) {"""
    + _PHI
    + "dg = small ? slope : (f - g) / safe;}"
)
_OPERANDS = """
F h = *(const F*)&h_in;
const F a = *(const F*)&a_in;
const F* rate = (const F*)rate_in.data;
const F* du = (const F*)du_in.data;
const float* b = &b_in.data[t0];
const float* c = &c_in.data[t0];
"""


# Equations 1 and 5 for one state over a chunk.
@wp.func_native(
    PRELUDE
    + _OPERANDS
    + f"""
F* y = (F*)y_out.data;
for (int t = 0; t < count; ++t) {{
    {_STEP}
    h = fma_(f, h, g * (du[t] * b[t]));
    y[t] = fma_(h, F{{}} + c[t], y[t]);
}}
{LANES} r; *(F*)&r = h; return r;
"""
)
def advance(
    mode: int,
    h_in: lanes,
    a_in: lanes,
    rate_in: wp.array(dtype=lanes),
    du_in: wp.array(dtype=lanes),
    b_in: wp.array(dtype=wp.float32),
    c_in: wp.array(dtype=wp.float32),
    t0: int,
    count: int,
    y_out: wp.array(dtype=lanes),
) -> lanes: ...


# As ``advance``, keeping f and h of every token, and adding dy·h to the sums of dC (equation 8).
@wp.func_native(
    PRELUDE
    + _OPERANDS
    + f"""
const F* dy = (const F*)dy_in.data;
F* y = (F*)y_out.data;
F* fs = (F*)f_out.data;
F* hs = (F*)h_out.data;
F* dc = (F*)dc_out.data + first;
hs[0] = h;
for (int t = 0; t < count; ++t) {{
    {_STEP}
    h = fma_(f, h, g * (du[t] * b[t]));
    fs[t] = f;
    hs[t + 1] = h;
    if (needs & {NEED_DZ}) y[t] = fma_(h, F{{}} + c[t], y[t]);
    if (needs & {NEED_DC}) dc[t] = fma_(dy[t], h, dc[t]);
}}
"""
)
def recompute(
    mode: int,
    h_in: lanes,
    a_in: lanes,
    rate_in: wp.array(dtype=lanes),
    du_in: wp.array(dtype=lanes),
    b_in: wp.array(dtype=wp.float32),
    c_in: wp.array(dtype=wp.float32),
    t0: int,
    count: int,
    dy_in: wp.array(dtype=lanes),
    needs: int,
    first: int,
    y_out: wp.array(dtype=lanes),
    f_out: wp.array(dtype=lanes),
    h_out: wp.array(dtype=lanes),
    dc_out: wp.array(dtype=lanes),
): ...


# Equations 6, 7 and 9 to 12 for one state, backwards over a chunk; h is the gradient of h_t.
@wp.func_native(
    PRELUDE
    + _OPERANDS
    + f"""
const F* step = (const F*)step_in.data;
const F* dy = (const F*)dy_in.data;
const F* fs = (const F*)f_in.data;
const F* hs = (const F*)hs_in.data;
F* s = (F*)s_out.data;
F* p = (F*)p_out.data;
F* db = (F*)db_out.data + first;
F da = F{{}};
for (int t = count - 1; t >= 0; --t) {{
    {_SLOPE}
    h = fma_(dy[t], F{{}} + c[t], h);
    if (needs & {NEED_DB}) db[t] = fma_(g * h, du[t], db[t]);
    s[t] = fma_(g * h, F{{}} + b[t], s[t]);
    F q;
    if (mode == 0) q = (f * h) * hs[t];
    else q = h * (hs[t] * df + du[t] * b[t] * dg);
    h = f * h;
    p[t] = fma_(q, a, p[t]);
    da = fma_(q, step[t], da);
}}
*(F*)da_out.data = da;
{LANES} r; *(F*)&r = h; return r;
"""
)
def retreat(
    mode: int,
    h_in: lanes,
    a_in: lanes,
    rate_in: wp.array(dtype=lanes),
    du_in: wp.array(dtype=lanes),
    b_in: wp.array(dtype=wp.float32),
    c_in: wp.array(dtype=wp.float32),
    t0: int,
    count: int,
    step_in: wp.array(dtype=lanes),
    dy_in: wp.array(dtype=lanes),
    f_in: wp.array(dtype=lanes),
    hs_in: wp.array(dtype=lanes),
    needs: int,
    first: int,
    s_out: wp.array(dtype=lanes),
    p_out: wp.array(dtype=lanes),
    db_out: wp.array(dtype=lanes),
    da_out: wp.array(dtype=lanes),
) -> lanes: ...


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
