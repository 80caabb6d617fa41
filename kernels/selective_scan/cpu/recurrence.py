"""Native inner loops of the CPU scan: one state or a few, a strip of tokens, sixteen channels.

Equations are those of README.md. Values per token come from ``tokens.py``; B and C
are read where they are, from token ``t0`` on.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ...runtime.lanes import lanes, prelude
from .decays import DECAYS, FACTORS, KEPT, SLOPES, STATE, limits
from .decays import walk as walk_of
from .together import ADVANCE_BLOCK, BLOCKS, RETREAT_BLOCK
from .tokens import TOKENS
from .tuning import Tuning

# gradients that cost work inside the loops, as bits of ``needs``
NEED_DZ, NEED_DC, NEED_DB, NEED_DH = 1, 2, 4, 8

_OPEN = (
    TOKENS
    + """
TOKEN* const token = aligned_((TOKEN*)scratch.data);
const F* const rates = (const F*)a_in.data;
const Tail& tail = *(const Tail*)&token[count];
int fetched = 0;
auto fetch_ = [&]() -> Fetch {  // the next of what is to be fetched, if there is one yet
    if (fetched < tail.fetches) return tail.fetch[fetched++];
    return {(const char*)token, 0, 0, 0, 1};
};
auto state_ = [&](auto& array, int n) -> F& { return ((F*)array.data)[n]; };
// B or C from entry n on, token by token
struct Column {
    const char* at;
    const size_t step;
    const float* row(int t) const { return (const float*)(at + t * step); }
    float operator[](int t) const { return *row(t); }
};
auto column_ = [&](auto& array, int n) -> Column {
    const auto* s = array.strides;
    return {(const char*)array.data + (size_t)batch * s[0] + (size_t)t0 * s[1]
        + (size_t)group * s[2] + (size_t)n * 4, (size_t)s[1]};
};
"""
)
_STATES = """
for (int n = 0; n < states; ++n) {
    const F a = rates[n];
"""
_REST = """
while (fetched < tail.fetches) {
    Fetch fetch = fetch_();
    for (int t = 0; t < count; ++t) fetch.next();
}
"""
_LOOK = """
    const I quiet = quiet_(tail.top * a);
    const bool care = tame && __builtin_reduce_or(quiet);
"""
_CHOOSE = """
    if (care) walk(Slow(), tamed);
    else if (tame) walk(Plain(), tamed);
    else walk(Plain(), wild);
"""
# Equations 1 and 5.
_ADVANCE = """
    const Column b = column_(b_in, n), c = column_(c_in, n);
WALKS
}
"""
_ADVANCE_WALK = """
        State h(state_(h_out, n), state_(h_out, states + n), quiet);
        for (int t = 0; t < count; ++t) {
            const F x = token[t].rate * a;
            FACTORS
            h.step(f, rise, g * (token[t].du * b[t]));
            token[t].y = fma_(h.value(), splat(c[t]), token[t].y);
        }
        h.keep(state_(h_out, n), state_(h_out, states + n));
"""

# Equation 1 alone, and the product of the decays.
_ACCUMULATE = """
    const Column b = column_(b_in, n);
WALKS
}
"""
_ACCUMULATE_WALK = """
        State h(state_(h_out, n), state_(h_out, states + n), quiet);
        State product(state_(product_out, n), state_(product_out, states + n), quiet);
        for (int t = 0; t < count; ++t) {
            const F x = token[t].rate * a;
            FACTORS
            h.step(f, rise, g * (token[t].du * b[t]));
            product.decay(State::one_of(f, rise, quiet));
        }
        h.keep(state_(h_out, n), state_(h_out, states + n));
        product.keep(state_(product_out, n), state_(product_out, states + n));
"""

# What the outputs send back to the state before the first token, and the product of the decays.
_GATHER = """
    const Column c = column_(c_in, n);
WALKS
}
"""
_GATHER_WALK = """
        State dh(state_(dh_out, n), state_(dh_out, states + n), quiet);
        State product(state_(product_out, n), state_(product_out, states + n), quiet);
        for (int t = 0; t < count; ++t) {
            const F x = token[t].rate * a;
            FACTORS
            product.decay(State::one_of(f, rise, quiet));
            dh.add(product.value(), token[t].dy * c[t]);
        }
        dh.keep(state_(dh_out, n), state_(dh_out, states + n));
        product.keep(state_(product_out, n), state_(product_out, states + n));
"""

# As _ADVANCE, keeping m and h of every token, and adding dy·h to the sums of dC (equation 8); then
# backwards, equations 6, 7 and 9 to 12. Σ rate q is left in da.
_KEPT = """
struct Kept { F KEPT; };
Kept* const kept = aligned_((Kept*)kept_out.data);
"""
_RETREAT = f"""
    const Column b = column_(b_in, n), c = column_(c_in, n);
    F* const db = (F*)db_out.data + n * CHUNK;
    F* const dc = (F*)dc_out.data + n * CHUNK;
    if (first) for (int t = 0; t < count; ++t) {{
        if (needs & {NEED_DB}) db[t] = F{{}};
        if (needs & {NEED_DC}) dc[t] = F{{}};
    }}
WALKS
    if (!(needs & {NEED_DH})) continue;
    if (care) back(Slow(), 0);
    else back(Plain(), 0);
}}
"""
_RETREAT_WALK = f"""
        State h(state_(starts_in, n), F{{}}, quiet);
        for (int t = 0; t < count; ++t) {{
            Kept& own = kept[t];
            const F x = token[t].rate * a;
            FACTORS
            own.m = State::one_of(f, rise, quiet), own.h = h.value();
            KEEP
            h.step(f, rise, g * (token[t].du * b[t]));
            if (needs & {NEED_DZ}) token[t].y = fma_(h.value(), splat(c[t]), token[t].y);
            if (needs & {NEED_DC}) dc[t] = fma_(token[t].dy, h.value(), dc[t]);
        }}
"""
_RETREAT_BACK = f"""
        State dh(state_(dh_out, n), state_(dh_out, states + n), quiet);
        F da = F{{}};
        for (int t = count - 1; t >= 0; --t) {{
            const Kept& own = kept[t];
            const F rate = token[t].rate, du = token[t].du;
            const float b_t = b[t];
            dh.add(token[t].dy, splat(c[t]));
            const F v = dh.value();
            WEIGH
            if (needs & {NEED_DB}) db[t] = fma_(gv, du, db[t]);
            token[t].s = fma_(gv, splat(b_t), token[t].s);
            GRADIENT
            token[t].p = fma_(q, a, token[t].p);
            da = fma_(q, rate, da);
        }}
        dh.keep(state_(dh_out, n), state_(dh_out, states + n));
        state_(da_out, n) += da;
"""
# What both walks back do with a state of a token: ``gv`` is g dh, ``q`` that of equation 10.
_BACK = {
    "KEEP": ("", "own.g = g;"),
    "WEIGH": ("const F gv = v;", "const F g = own.g, gv = g * v;"),
    "GRADIENT": (
        "dh.decay(own.m); const F q = dh.value() * own.h;",
        """
            const F x = rate * a, m = own.m;
            SLOPES
            const F q = v * (own.h * df + du * b_t * dg);
            dh.decay(m);
        """,
    ),
}


def _leaf(
    text: str,
    walk: str,
    discretization: str,
    tuning: Tuning,
    *,
    token: str,
    head: str = "",
    back: str = "",
    block: str = "",
    at_once: int = 1,
    also: str = "",
) -> str:
    """The C++ text of a leaf: for every state its ``text``, with the walks that belong to it.

    ``block`` walks ``at_once`` states, if that is more than one.
    """
    parts = _LOOK + walk_of("walk", walk)
    if back:
        parts += walk_of("back", back)
    loop = (
        _STATES
        if at_once == 1
        else BLOCKS.replace("BLOCK", walk_of("block", block)).replace("ALSO", also)
    )
    text = _OPEN + head + loop + text.replace("WALKS", parts + _CHOOSE) + _REST
    for name, forms in _BACK.items():
        text = text.replace(name, forms[discretization != "mamba"])
    text = text.replace("FACTORS", FACTORS[discretization])
    text = text.replace("SLOPES", SLOPES.get(discretization, ""))
    text = prelude(tuning.degree, bool(tuning.table)) + STATE + DECAYS[discretization] + text
    chunk = tuning.chunk
    names = {"CHUNK": chunk, "AT_ONCE": at_once, "TOKEN": token, **limits(chunk)}
    names["KEPT"] = ", ".join(KEPT[discretization])
    for name, value in names.items():
        text = text.replace(name, str(value))
    return text


@functools.cache
def forward_leaves(discretization: str, tuning: Tuning) -> SimpleNamespace:
    """``advance`` and ``accumulate`` bring a lane group's states from before a strip to after."""
    parts = discretization, tuning

    block: dict[str, Any] = {"block": ADVANCE_BLOCK, "at_once": tuning.walked}

    @wp.func_native(_leaf(_ADVANCE, _ADVANCE_WALK, *parts, token="Token", **block))
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

    @wp.func_native(_leaf(_ACCUMULATE, _ACCUMULATE_WALK, *parts, token="const Token"))
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
def backward_leaves(discretization: str, tuning: Tuning) -> SimpleNamespace:
    """``retreat`` and ``gather`` bring gradients of states from after a chunk to before it.

    ``first`` says that the sums of dB and dC are empty yet.
    """
    parts = discretization, tuning

    kept: dict[str, Any] = {"head": _KEPT, "back": _RETREAT_BACK}
    kept |= {"block": RETREAT_BLOCK, "at_once": tuning.walked_back}
    kept["also"] = f"&& needs == {NEED_DZ + NEED_DC + NEED_DB + NEED_DH}"

    @wp.func_native(_leaf(_RETREAT, _RETREAT_WALK, *parts, token="GradToken", **kept))
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

    @wp.func_native(_leaf(_GATHER, _GATHER_WALK, *parts, token="const GradToken"))
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

    return SimpleNamespace(retreat=retreat, gather=gather, sum_lanes=_sum_lanes(tuning.chunk))


# Adds up the lanes of the rows of ``sums_in`` [states, CHUNK], eight rows at a time.
_SUM_LANES = """
typedef float E __attribute__((vector_size(32), aligned(4)));
const E* const rows = (const E*)sums_in.data;
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
        float* const out = total_out.data + n * (size_t)length + t0 + t;
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
        sums_in: wp.array(dtype=lanes),
        total_out: wp.array(dtype=wp.float32),
    ): ...

    return sum_lanes
