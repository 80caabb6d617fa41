"""The native inner loop of the CUDA scan's gradient: a few tokens forwards again, then backwards.

Names are those of ``tokens.py``. The walk forwards holds the decays and states of the tokens
in registers for the walk backwards. Sums over states leave the threads as partial sums of the
lanes, sums over channels are completed over the block and stored.
"""

import functools

import warp as wp

from .blocks import MARK, BlockShape, arena_io
from .tokens import SUB, marks_access, prelude


def lane_stride(f: BlockShape) -> int:
    """Floats between the partial sums of two lanes."""
    return SUB * f.span + f.pad


def token_stride(f: BlockShape) -> int:
    """Floats between the products for dB or dC of two tokens, half the banks apart."""
    return (f.slots + 1) * f.width


def _add(f: BlockShape, at: int, values: str) -> str:
    """Stores one float per channel as a lane's partial sum, over all state blocks."""
    return f"""{{
            float* to = s + {at} + q * {lane_stride(f)} + t * SPAN + channel;
            if (walk > 0) {{
                float before[CH];
                load_ch(to, before);
                WP_PRAGMA_UNROLL
                for (int i = 0; i < CH; ++i) {values}[i] += before[i];
            }}
            store_ch(to, {values});
        }}"""


def _forwards(f: BlockShape, mode: str, at: dict, flags: frozenset) -> str:
    """The walk forwards: exponentials first, as they wait for no state, and loads a token ahead."""
    early = "factors_(r[i], an[k], fs[t][k], g);" if mode == "mamba" else ""
    late = "" if mode == "mamba" else "factors_(v.r[i], an[k], fs[t][k], g);"
    dc = f"store_st(s + {at['DC']} + t * {token_stride(f)} + slot * WIDTH + q * ST, dc);"
    return f"""
    WP_PRAGMA_UNROLL
    for (int t = 0; t < {SUB}; ++t) {{
        float r[CH], g;
        load_ch(s + {at["STEP"]} + t * SPAN + channel, r);
        WP_PRAGMA_UNROLL
        for (int k = 0; k < E; ++k) {{ const int i = k / ST; {early} }}
    }}
    fetch_(0, next);
    WP_PRAGMA_UNROLL
    for (int t = 0; t < {SUB}; ++t) {{
        const Token v = next;
        if (t + 1 < {SUB}) fetch_(t + 1, next);
        float y[CH] = {{}}, dc[ST] = {{}};
        WP_PRAGMA_UNROLL
        for (int k = 0; k < E; ++k) {{
            const int i = k / ST, j = k % ST;
            float g = 1.0f;
            {late}
            hs[t][k] = hn[k];
            hn[k] = fs[t][k] * hn[k] + g * (v.x[i] * v.b[j]);
            {"dc[j] += v.dy[i] * hn[k];" if "dC" in flags else ""}
            {"y[i] += v.c[j] * hn[k];" if "y" in flags else ""}
        }}
        {dc if "dC" in flags else ""}
        {_add(f, at["Y"], "y") if "y" in flags else ""}
    }}
"""


def _backwards(f: BlockShape, mode: str, at: dict, flags: frozenset) -> str:
    slopes = """
            const float f = fs[t][k], w = d;
            dh[k] = f * d;
            const float p = dh[k] * hs[t][k];"""
    if mode != "mamba":
        slopes = """
            float f, g, df, dg;
            slopes_(v.r[i], an[k], f, g, df, dg);
            dh[k] = f * d;
            const float w = g * d, p = d * (hs[t][k] * df + v.x[i] * v.b[j] * dg);"""
    db = f"store_st(s + {at['DB']} + t * {token_stride(f)} + slot * WIDTH + q * ST, db);"
    return f"""
    WP_PRAGMA_UNROLL
    for (int t = {SUB - 1}; t >= 0; --t) {{
        const Token v = next;
        if (t > 0) fetch_(t - 1, next);
        float through[CH] = {{}}, dstep[CH] = {{}}, db[ST] = {{}};
        WP_PRAGMA_UNROLL
        for (int k = 0; k < E; ++k) {{
            const int i = k / ST, j = k % ST;
            const float d = {"dh[k] + v.dy[i] * v.c[j]" if "read" in flags else "dh[k]"};
            {slopes}
            {"db[j] += w * v.x[i];" if "dB" in flags else ""}
            through[i] += w * v.b[j];
            dstep[i] += p * an[k];
            da[k] += p * v.r[i];
        }}
        {db if "dB" in flags else ""}
        {_add(f, at["S"], "through")}
        {_add(f, at["P"], "dstep")}
    }}
"""


def _totals(f: BlockShape, at: dict, flags: frozenset) -> str:
    """Sums the products for dB and dC over the block's channels: a thread takes one sum."""
    sums = [name for name in ("dB", "dC") if name in flags]
    if not sums:
        return ""
    is_b = f"e < {SUB} * WIDTH" if len(sums) == 2 else str("dB" in flags).lower()
    return f"""
    WP_PRAGMA_UNROLL
    for (int e = lane; e < {len(sums) * SUB} * WIDTH; e += {f.block}) {{
        const int t = e / WIDTH % {SUB}, n = e % WIDTH;
        const bool is_b = {is_b};
        const float* from = s + (is_b ? {at["DB"]} : {at["DC"]}) + t * {token_stride(f)} + n;
        float v[4] = {{}};
        WP_PRAGMA_UNROLL
        for (int i = 0; i < {f.slots}; ++i) v[i % 4] += from[i * WIDTH];
        float* to = is_b ? db_out.data : dc_out.data;
        to += ((size_t)row * length + t0 + t) * states + walk * WIDTH + n;
        if (t < left && walk * WIDTH + n < states) *to = (v[0] + v[1]) + (v[2] + v[3]);
    }}
"""


@functools.cache
def retreating(f: BlockShape, mode: str, at: tuple, arena_size: int, flags: frozenset):
    """Equations 6 to 12 over the ``SUB`` tokens from ``t0`` on, of which ``left`` are there.

    ``both`` is dh and the sum of dA, from after the tokens to before them.

    Args:
        at: offsets of ``STEP, DU, DY, B, C``; of partial sums ``Y, S, P``; of products ``DB, DC``.
        flags: of ``read`` (there is dy), ``y``, ``dB``, ``dC`` (wanted), ``through`` (dh is).
    """
    offset = dict.fromkeys(("DY", "C", "Y", "S", "P", "DB", "DC"), 0) | dict(at)
    vec = wp.types.vector(f.walks * f.held, wp.float32)
    pair = wp.types.vector(2 * f.walks * f.held, wp.float32)
    arena_type, _, _ = arena_io(arena_size)
    read = f"""
    load_ch(s + {offset["DY"]} + t * SPAN + channel, v.dy);
    load_st(s + {offset["C"]} + t * PADDED + state, v.c);
"""
    snippet = f"""
{prelude(f, mode)}
{marks_access("marks_in")}
struct Token {{ float r[CH], x[CH], dy[CH], b[ST], c[ST]; }};
WP_PRAGMA_NO_UNROLL
for (int walk = 0; walk < WALKS; ++walk) {{
    const int state = walk * WIDTH + q * ST;
    auto fetch_ = [&](int t, Token& v) {{
        load_ch(s + {offset["STEP"]} + t * SPAN + channel, v.r);
        load_ch(s + {offset["DU"]} + t * SPAN + channel, v.x);
        load_st(s + {offset["B"]} + t * PADDED + state, v.b);
        {read if "read" in flags else ""}
    }};
    Token next;
    float hn[E], an[E], dh[E], da[E], hs[{SUB}][E], fs[{SUB}][E];
    load_e(marks + (walk * {MARK // SUB} + mark) * E, hn, false);
    WP_PRAGMA_UNROLL
    for (int k = 0; k < E; ++k) {{
        an[k] = a.c[walk * E + k];
        dh[k] = both.c[walk * E + k];
        da[k] = both.c[(WALKS + walk) * E + k];
    }}
    {_forwards(f, mode, offset, flags)}
    {_backwards(f, mode, offset, flags) if "through" in flags else ""}
    WP_PRAGMA_UNROLL
    for (int k = 0; k < E; ++k) {{
        both.c[walk * E + k] = dh[k];
        both.c[(WALKS + walk) * E + k] = da[k];
    }}
    WP_TILE_SYNC();
    {_totals(f, offset, flags)}
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
        slot: int,
        q: int,
        lane: int,
        states: int,
        t0: int,
        left: int,
        row: int,
        length: int,
        a: vec,
        both: pair,
        db_out: wp.array3d(dtype=float),
        dc_out: wp.array3d(dtype=float),
    ) -> pair: ...

    return retreat
