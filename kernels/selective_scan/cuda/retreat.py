"""The native inner loop of the CUDA scan's gradient: a few tokens forwards again, then backwards.

Names are those of ``tokens.py``. The walk forwards holds the decays and states of ``SUB`` tokens
in registers for the walk backwards. Sums over states leave the threads as partial sums of the
lanes, ``SUB`` tokens as one vector; sums over channels are completed over the block and stored.
"""

import functools

import warp as wp

from ...runtime.scalars import WIDE
from .blocks import MARK, BlockShape, arena_io
from .groups import Groups
from .tokens import SUB, marks_access, prelude


def token_stride(f: BlockShape) -> int:
    """Floats between the products for dB or dC of two tokens, half the banks apart."""
    return (f.slots + 1) * f.width


def _add(g: Groups, at: int, values: str) -> str:
    """Stores a lane's sums of ``SUB`` tokens for each channel, over all state blocks."""
    return f"""
        WP_PRAGMA_UNROLL
        for (int i = 0; i < CH; ++i) {{
            float* to = s + {at} + q * {g.lane_stride} + (sub * CH + i) * {g.step * SUB};
            to += slot * {SUB};
            if (walk > 0) {{
                float before[{SUB}];
                load_su(to, before);
                WP_PRAGMA_UNROLL
                for (int t = 0; t < {SUB}; ++t) {values}[i][t] += before[t];
            }}
            store_su(to, {values}[i]);
        }}"""


def _product(f: BlockShape, at: int, values: str) -> str:
    to = f"s + {at} + (sub * {SUB} + t) * {token_stride(f)} + slot * WIDTH + q * ST"
    return f"store_st({to}, {values});"


def _forwards(g: Groups, mode: str, at: dict, flags: frozenset) -> str:
    """The walk forwards: exponentials first, as they wait for no state, and loads a token ahead."""
    early = "factors_(r[i][t], an[k], fs[t][k], g);" if mode == "mamba" else ""
    late = "" if mode == "mamba" else "factors_(r[i][t], an[k], fs[t][k], g);"
    return f"""
        WP_PRAGMA_UNROLL
        for (int t = 0; t < {SUB}; ++t) {{
            float g;
            WP_PRAGMA_UNROLL
            for (int k = 0; k < E; ++k) {{ const int i = k / ST; {early} }}
        }}
        fetch_(0, next);
        float y[CH][{SUB}] = {{}};
        WP_PRAGMA_UNROLL
        for (int t = 0; t < {SUB}; ++t) {{
            const Token v = next;
            if (t + 1 < {SUB}) fetch_(t + 1, next);
            float dc[ST] = {{}};
            WP_PRAGMA_UNROLL
            for (int k = 0; k < E; ++k) {{
                const int i = k / ST, j = k % ST;
                float g = 1.0f;
                {late}
                hs[t][k] = hn[k];
                hn[k] = fs[t][k] * hn[k] + g * (x[i][t] * v.b[j]);
                {"dc[j] += dy[i][t] * hn[k];" if "dC" in flags else ""}
                {"y[i][t] += v.c[j] * hn[k];" if "y" in flags else ""}
            }}
            {_product(g.shape, at["DC"], "dc") if "dC" in flags else ""}
        }}
        {_add(g, at["Y"], "y") if "y" in flags else ""}
"""


def _backwards(g: Groups, mode: str, at: dict, flags: frozenset) -> str:
    slopes = """
                const float f = fs[t][k], w = d;
                dh[k] = f * d;
                const float p = dh[k] * hs[t][k];"""
    if mode != "mamba":
        slopes = """
                float f, g, df, dg;
                slopes_(rt[i], an[k], f, g, df, dg);
                dh[k] = f * d;
                const float w = g * d, p = d * (hs[t][k] * df + xt[i] * v.b[j] * dg);"""
    if mode == "zoh":  # its slopes need the registers: what can be loaded again is not held
        own = f"(sub * SPAN + channel + i) * {SUB} + t"
        operands = f"r[i][t], s[{at['DU']} + {own}], s[{at['DY']} + {own}]"
    else:
        operands = "r[i][t], x[i][t], dy[i][t]"
    rate, own_x, own_dy = operands.split(", ")
    return f"""
        float through[CH][{SUB}] = {{}}, dstep[CH][{SUB}] = {{}};
        WP_PRAGMA_UNROLL
        for (int t = {SUB - 1}; t >= 0; --t) {{
            const Token v = next;
            if (t > 0) fetch_(t - 1, next);
            float db[ST] = {{}}, rt[CH], xt[CH], dyt[CH];
            WP_PRAGMA_UNROLL
            for (int i = 0; i < CH; ++i) {{
                rt[i] = {rate};
                xt[i] = {own_x};
                {f"dyt[i] = {own_dy};" if "read" in flags else ""}
            }}
            WP_PRAGMA_UNROLL
            for (int k = 0; k < E; ++k) {{
                const int i = k / ST, j = k % ST;
                const float d = {"dh[k] + dyt[i] * v.c[j]" if "read" in flags else "dh[k]"};
                {slopes}
                {"db[j] += w * xt[i];" if "dB" in flags else ""}
                through[i][t] += w * v.b[j];
                dstep[i][t] += p * an[k];
                da[k] += p * rt[i];
            }}
            {_product(g.shape, at["DB"], "db") if "dB" in flags else ""}
        }}
        {_add(g, at["S"], "through")}
        {_add(g, at["P"], "dstep")}
"""


def _totals(g: Groups, at: dict, flags: frozenset) -> str:
    """Sums the products for dB and dC over the block's channels: a thread takes ``n`` sums."""
    f = g.shape
    sums = [name for name in ("dB", "dC") if name in flags]
    if not sums:
        return ""
    all_sums = len(sums) * g.tokens * f.width
    n = max([v for v in (1, 2, 4) if f.width % v == 0 and all_sums // v >= f.block] or [1])
    num = all_sums // n
    is_b = f"e < {g.tokens * f.width // n}" if len(sums) == 2 else str("dB" in flags).lower()
    total = " + ".join(f"v[{i}].v[m]" for i in range(f.slots))
    if f.slots >= 4:
        total = "(v[0].v[m] + v[1].v[m]) + (v[2].v[m] + v[3].v[m])"
    each = f"if (lane < {num}) {{ const unsigned e = lane;"
    if num > f.block:
        each = f"for (unsigned e = lane; e < {num}; e += {f.block}) {{"
    return f"""
    {each}
        const int t = e / {f.width // n} % {g.tokens}, n = e % {f.width // n} * {n};
        const bool is_b = {is_b};
        const float* from = s + (is_b ? {at["DB"]} : {at["DC"]}) + t * {token_stride(f)} + n;
        struct ALIGNED({4 * n}) Sums {{ float v[{n}]; }};
        Sums v[{min(4, f.slots)}];
        WP_PRAGMA_UNROLL
        for (int i = 0; i < {f.slots}; ++i) {{
            const Sums one = *(const Sums*)(from + i * WIDTH);
            WP_PRAGMA_UNROLL
            for (int m = 0; m < {n}; ++m)
                v[i % 4].v[m] = i < 4 ? one.v[m] : v[i % 4].v[m] + one.v[m];
        }}
        float* to = is_b ? db_out.data : dc_out.data;
        to += product + wide_(t0 + t, states) + walk * WIDTH + n;
        WP_PRAGMA_UNROLL
        for (int m = 0; m < {n}; ++m)
            if (t < left && walk * WIDTH + n + m < states)
                to[m] = {total};
    }}
"""


@functools.cache
def retreating(g: Groups, mode: str, at: tuple, arena_size: int, flags: frozenset):
    """Equations 6 to 12 over the tokens of a tile from ``t0`` on, of which ``left`` are there.

    ``product`` is where the block's products for dB and dC begin. ``both`` is dh and the sum of dA,
    from after the tokens to before them.

    Args:
        g: how the tile's tokens lie in shared memory.
        at: offsets of ``STEP, DU, DY, B, C``; of lanes' sums ``Y, S, P``; of products ``DB, DC``.
        flags: of ``read`` (there is dy), ``y``, ``dB``, ``dC`` (wanted), ``through`` (dh is).
    """
    f = g.shape
    offset = dict.fromkeys(("DY", "C", "Y", "S", "P", "DB", "DC"), 0) | dict(at)
    vec = wp.types.vector(f.walks * f.held, wp.float32)
    pair = wp.types.vector(2 * f.walks * f.held, wp.float32)
    arena_type, _, _ = arena_io(arena_size)
    read = "read" in flags
    load_c = f"load_st(s + {offset['C']} + (sub * {SUB} + t) * PADDED + state, v.c);"
    load_dy = f"load_su(s + {offset['DY']} + own, dy[i]);"
    snippet = f"""
{prelude(f, mode, SUB)}
{WIDE}
{marks_access("marks_in")}
struct Token {{ float b[ST], c[ST]; }};
WP_PRAGMA_NO_UNROLL
for (int walk = 0; walk < WALKS; ++walk) {{
    const int state = walk * WIDTH + q * ST;
    float an[E], dh[E], da[E];
    WP_PRAGMA_UNROLL
    for (int k = 0; k < E; ++k) {{
        an[k] = a.c[walk * E + k];
        dh[k] = both.c[walk * E + k];
        da[k] = both.c[(WALKS + walk) * E + k];
    }}
    WP_PRAGMA_NO_UNROLL
    for (int sub = subs - 1; sub >= 0; --sub) {{
        auto fetch_ = [&](int t, Token& v) {{
            load_st(s + {offset["B"]} + (sub * {SUB} + t) * PADDED + state, v.b);
            {load_c if read else ""}
        }};
        Token next;
        float r[CH][{SUB}], x[CH][{SUB}], dy[CH][{SUB}];
        WP_PRAGMA_UNROLL
        for (int i = 0; i < CH; ++i) {{
            const int own = (sub * SPAN + channel + i) * {SUB};
            load_su(s + {offset["STEP"]} + own, r[i]);
            load_su(s + {offset["DU"]} + own, x[i]);
            {load_dy if read else ""}
        }}
        float hn[E], hs[{SUB}][E], fs[{SUB}][E];
        load_e(marks + (walk * {MARK // SUB} + mark + sub) * E, hn, false);
        {_forwards(g, mode, offset, flags)}
        {_backwards(g, mode, offset, flags) if "through" in flags else ""}
    }}
    WP_PRAGMA_UNROLL
    for (int k = 0; k < E; ++k) {{
        both.c[walk * E + k] = dh[k];
        both.c[(WALKS + walk) * E + k] = da[k];
    }}
    WP_TILE_SYNC();
    {_totals(g, offset, flags) if f.walks > 1 else ""}
    if (WALKS > 1) WP_TILE_SYNC();
}}
return both;
"""

    @wp.func_native(snippet)
    def retreat(
        arena: arena_type,
        base: int,
        marks_in: wp.array(dtype=float),
        mark: int,
        subs: int,
        slot: int,
        q: int,
        lane: int,
        states: int,
        t0: int,
        left: int,
        product: wp.int64,
        a: vec,
        both: pair,
        db_out: wp.array3d(dtype=float),
        dc_out: wp.array3d(dtype=float),
    ) -> pair: ...

    return retreat


@functools.cache
def totalling(g: Groups, at: tuple, arena_size: int, flags: frozenset):
    """The sums for dB and dC after ``retreat``, where that has not made them state block by block.

    Apart from it, so that loads can be on their way meanwhile that would cost the walk registers.
    """
    f = g.shape
    offset = dict.fromkeys(("DB", "DC"), 0) | dict(at)
    arena_type, _, _ = arena_io(arena_size)
    snippet = f"""
{prelude(f, "mamba", SUB)}
{WIDE}
const int walk = 0;
{_totals(g, offset, flags) if f.walks == 1 else ""}
"""

    @wp.func_native(snippet)
    def total(
        arena: arena_type,
        base: int,
        slot: int,
        lane: int,
        states: int,
        t0: int,
        left: int,
        product: wp.int64,
        db_out: wp.array3d(dtype=float),
        dc_out: wp.array3d(dtype=float),
    ): ...

    return total
