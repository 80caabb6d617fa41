"""Native inner loops of the CUDA scan: a thread's states over a tile of tokens.

Equations are those of README.md. The operands of a tile are floats in shared memory, channels or
states adjacent: δ (``STEP``), δu (``DU``), dy (``DY``), B and C. Tokens past the end have δ = 0 and
change nothing. The code is C++ for a CPU as well, where the tests run it.
"""

import functools
import math

import warp as wp

from ...runtime.scalars import EXP2, RECIPROCAL
from .blocks import MARK, BlockShape, arena_io

SUB = 4  # tokens whose states and decays the gradient holds in registers
UNROLL = 4  # tokens whose sums wait in registers, so that their loads need not wait for stores

# Equations 2 to 4: f and g of x = δA, where ``a`` holds A, times log2(e) for an exponential.
_COEFFICIENTS = [
    1.0 / math.factorial(k) for k in range(1, 13)
]  # of (e^x - 1) / x, lowest power first
_PHI = """
    const float x = rate * a * 0.6931471805599453f;
    const bool small = x < 1.0f && x > -1.0f;
    const float inverse = reciprocal_(small ? 1.0f : x);
    float series = 0.0f, slope = 0.0f;
"""
_PHI += "".join(f"    series = series * x + {c!r}f;\n" for c in reversed(_COEFFICIENTS))
_PHI += "    g = small ? series : (f - 1.0f) * inverse;\n"
_PHI_SLOPE = "".join(
    f"    slope = slope * x + {(k + 1) * c!r}f;\n"
    for k, c in reversed(list(enumerate(_COEFFICIENTS[1:])))
)
_FACTORS = {
    "mamba": "f = exp2_(rate * a); g = 1.0f;",
    "bilinear": "g = reciprocal_(1.0f - 0.5f * (rate * a)); f = 1.0f + rate * a * g;",
    "zoh": "f = exp2_(rate * a);" + _PHI,
}
_SLOPES = {
    "mamba": "df = f; dg = 0.0f;",
    "bilinear": "df = g * g; dg = 0.5f * df;",
    "zoh": _PHI_SLOPE + "df = f; dg = small ? slope : (f - g) * inverse;",
}


# Vectors of shared memory are aligned; on a CPU a tile may lie anywhere.
_ALIGNED = """
#if defined(__CUDA_ARCH__)
#define ALIGNED(bytes) alignas(bytes)
#else
#define ALIGNED(bytes)
#endif
"""

# The local array that holds the marks, and a thread's states in it as vectors.
_MARKS = """
float* marks = (float*)(((size_t)ARRAY.data + 15) & ~(size_t)15);
constexpr int VE = E % 4 == 0 ? 4 : E % 2 == 0 ? 2 : 1;
struct ALIGNED(4 * VE) PE { float v[VE]; };
auto load_e = [](float* at, float* h, bool store) {
    WP_PRAGMA_UNROLL
    for (int k = 0; k < E / VE; ++k) {
        PE v;
        if (!store) v = ((PE*)at)[k];
        WP_PRAGMA_UNROLL
        for (int m = 0; m < VE; ++m) {
            if (store) v.v[m] = h[k * VE + m];
            else h[k * VE + m] = v.v[m];
        }
        if (store) ((PE*)at)[k] = v;
    }
};
"""


def marks_access(array: str) -> str:
    """C++ text: ``marks``, aligned, in the local ``array``, and ``load_e`` to load and store."""
    return _MARKS.replace("ARRAY", array)


# The state blocks, one after the other over the same tile.
_WALK = """
WP_PRAGMA_NO_UNROLL
for (int walk = 0; walk < WALKS; ++walk) {
    const int state = walk * WIDTH + q * ST;
    float hn[E], an[E];
    WP_PRAGMA_UNROLL
    for (int k = 0; k < E; ++k) hn[k] = h.c[walk * E + k], an[k] = a.c[walk * E + k];
"""
_END_WALK = """
    WP_PRAGMA_UNROLL
    for (int k = 0; k < E; ++k) h.c[walk * E + k] = hn[k];
}
"""


def prelude(f: BlockShape, mode: str, adjacent: int = 1) -> str:
    """Constants, vector access to shared memory, and the factors of equations 2 to 4.

    Access is to the channels of a thread, ``load_ch``, to its states, ``load_st``, and to
    ``adjacent`` tokens of one channel, ``load_su``; each has its ``store_``.
    """

    def access(name: str, count: int) -> str:
        w = min(4, count)
        return f"""
struct ALIGNED({4 * w}) P{name} {{ float v[{w}]; }};
auto load_{name} = [](const float* from, float* to) {{
    WP_PRAGMA_UNROLL
    for (int k = 0; k < {count // w}; ++k) {{
        const P{name} v = ((const P{name}*)from)[k];
        WP_PRAGMA_UNROLL
        for (int m = 0; m < {w}; ++m) to[k * {w} + m] = v.v[m];
    }}
}};
auto store_{name} = [](float* to, const float* from) {{
    WP_PRAGMA_UNROLL
    for (int k = 0; k < {count // w}; ++k) {{
        P{name} v;
        WP_PRAGMA_UNROLL
        for (int m = 0; m < {w}; ++m) v.v[m] = from[k * {w} + m];
        ((P{name}*)to)[k] = v;
    }}
}};
"""

    return (
        _ALIGNED
        + EXP2
        + RECIPROCAL
        + f"constexpr int CH = {f.channels}, ST = {f.states}, E = CH * ST, SPAN = {f.span};\n"
        + f"constexpr int PADDED = {f.padded}, WIDTH = {f.width}, WALKS = {f.walks};\n"
        + access("ch", f.channels)
        + access("st", f.states)
        + access("su", adjacent)
        + f"""
auto factors_ = [&](float rate, float a, float& f, float& g) {{ {_FACTORS[mode]} }};
auto slopes_ = [&](float rate, float a, float& f, float& g, float& df, float& dg) {{
    {_FACTORS[mode]} {_SLOPES[mode]}
}};
float* s = arena.data.ptr + base;
const int channel = slot * CH;
"""
    )


@functools.cache
def advancing(f: BlockShape, mode: str, tokens: int, at: tuple, arena_size: int, read, reverse):
    """The recurrence over a tile.

    Forward it is equation 1, and with ``read`` the sums of equation 5 as partial sums of the lanes;
    in reverse it is equation 6, dh from after a tile to before it.

    Args:
        at: pairs (name, offset) of ``STEP, IN, W`` (δu and B, or dy and C), with ``read`` of
            ``C, Y``.
    """
    offset = {"C": 0, "Y": 0} | dict(at)
    vec = wp.types.vector(f.walks * f.held, wp.float32)
    arena_type, _, _ = arena_io(arena_size)
    order = f"{tokens - 1} - (t0 + u)" if reverse else "t0 + u"
    if reverse:
        update = "hn[k] = f * (hn[k] + x[i] * w[j]);"
    else:
        update = "hn[k] = f * hn[k] + g * (x[i] * w[j]);"
    load_c = f"load_st(s + {offset['C']} + t * PADDED + state, c);" if read else ""
    sum_y = "y[u * CH + i] += c[j] * hn[k];" if read else ""
    store_y = f"""
    WP_PRAGMA_UNROLL
    for (int u = 0; u < {UNROLL}; ++u) {{
        float* to = s + {offset["Y"]} + q * {tokens * f.span + f.pad} + (t0 + u) * SPAN + channel;
        if (walk > 0) {{
            float before[CH];
            load_ch(to, before);
            WP_PRAGMA_UNROLL
            for (int i = 0; i < CH; ++i) y[u * CH + i] += before[i];
        }}
        store_ch(to, y + u * CH);
    }}
    """
    snippet = f"""
{prelude(f, mode)}
{_WALK}
WP_PRAGMA_NO_UNROLL
for (int t0 = 0; t0 < {tokens}; t0 += {UNROLL}) {{
    float y[{UNROLL} * CH] = {{}};
    WP_PRAGMA_UNROLL
    for (int u = 0; u < {UNROLL}; ++u) {{
        const int t = {order};
        float r[CH], x[CH], w[ST], c[ST];
        load_ch(s + {offset["STEP"]} + t * SPAN + channel, r);
        load_ch(s + {offset["IN"]} + t * SPAN + channel, x);
        load_st(s + {offset["W"]} + t * PADDED + state, w);
        {load_c}
        WP_PRAGMA_UNROLL
        for (int i = 0; i < CH; ++i)
            WP_PRAGMA_UNROLL
            for (int j = 0; j < ST; ++j) {{
                const int k = i * ST + j;
                float f, g;
                factors_(r[i], an[k], f, g);
                {update}
                {sum_y}
            }}
    }}
    {store_y if read else ""}
}}
{_END_WALK}
return h;
"""

    @wp.func_native(snippet)
    def advance(arena: arena_type, base: int, slot: int, q: int, a: vec, h: vec) -> vec: ...

    return advance


@functools.cache
def decaying(f: BlockShape, mode: str, tokens: int, at: tuple, arena_size: int):
    """Multiplies a tile's decays into ``h``, for the rules whose decays are no exponentials."""
    offset = dict(at)
    vec = wp.types.vector(f.walks * f.held, wp.float32)
    arena_type, _, _ = arena_io(arena_size)
    snippet = f"""
{prelude(f, mode)}
for (int t = 0; t < {tokens}; ++t)
    WP_PRAGMA_UNROLL
    for (int k = 0; k < {f.walks} * E; ++k) {{
        float f, g;
        factors_(s[{offset["STEP"]} + t * SPAN + channel + k % E / ST], a.c[k], f, g);
        h.c[k] *= f;
    }}
return h;
"""

    @wp.func_native(snippet)
    def decay(arena: arena_type, base: int, slot: int, q: int, a: vec, h: vec) -> vec: ...

    return decay


@functools.cache
def marking(f: BlockShape, mode: str, tokens: int, at: tuple, arena_size: int):
    """Walks the recurrence over a tile and keeps the state before every ``SUB`` tokens.

    δ and δu are ``[token / 4, channel, 4]``, as in ``groups.py``. The marks of a chunk are local
    memory: up to 1 KB per channel, too much for registers, and left to the cache where shared
    memory would limit the number of blocks.
    """
    offset = dict(at)
    vec = wp.types.vector(f.walks * f.held, wp.float32)
    arena_type, _, _ = arena_io(arena_size)
    snippet = f"""
{prelude(f, mode, SUB)}
{marks_access("marks_out")}
{_WALK}
WP_PRAGMA_NO_UNROLL
for (int sub = 0; sub < {tokens // SUB}; ++sub) {{
    const int mark = tile * {tokens // SUB} + sub;
    if (mark >= count) break;
    load_e(marks + (walk * {MARK // SUB} + mark) * E, hn, true);
    if (mark + 1 == count) break;
    float r[CH][{SUB}], x[CH][{SUB}];
    WP_PRAGMA_UNROLL
    for (int i = 0; i < CH; ++i) {{
        const int own = (sub * SPAN + channel + i) * {SUB};
        load_su(s + {offset["STEP"]} + own, r[i]);
        load_su(s + {offset["DU"]} + own, x[i]);
    }}
    WP_PRAGMA_UNROLL
    for (int t = 0; t < {SUB}; ++t) {{
        float w[ST];
        load_st(s + {offset["B"]} + (sub * {SUB} + t) * PADDED + state, w);
        WP_PRAGMA_UNROLL
        for (int i = 0; i < CH; ++i)
            WP_PRAGMA_UNROLL
            for (int j = 0; j < ST; ++j) {{
                const int k = i * ST + j;
                float f, g;
                factors_(r[i][t], an[k], f, g);
                hn[k] = f * hn[k] + g * (x[i][t] * w[j]);
            }}
    }}
}}
{_END_WALK}
return h;
"""

    @wp.func_native(snippet)
    def mark(
        arena: arena_type,
        base: int,
        marks_out: wp.array(dtype=float),
        tile: int,
        count: int,
        slot: int,
        q: int,
        a: vec,
        h: vec,
    ) -> vec: ...

    return mark
