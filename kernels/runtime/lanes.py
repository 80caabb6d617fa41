"""Native leaves of the CPU kernels: sixteen adjacent channels as one SIMD value.

A leaf is a little C++ with the compiler's vector types, which become AVX-512, AVX2 or NEON
instructions. The loops around them, and all that is not arithmetic on lanes, are Warp kernels.
"""

import struct

import torch
import warp as wp

W = 16  # channels of a lane group: one cache line of float32
lanes = wp.types.vector(W, wp.float32)
LANES = "wp::vec_t<16, float>"
WARP_DTYPES = {
    torch.float32: wp.float32,
    torch.float16: wp.float16,
    torch.bfloat16: wp.bfloat16,
}

VECTORS = """
typedef float F __attribute__((vector_size(64), aligned(4)));
typedef int I __attribute__((vector_size(64), aligned(4)));
auto splat = [](float x) -> F { return (F){x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; };
"""

# 2^x for |x| <= 1/2 by degree: minimax polynomials with the constant term held at 1, so that
# 2^x - 1 keeps its relative accuracy for small x: the errors of slow decays add up over thousands
# of steps. Highest power first.
_EXP2 = {
    2: (0.2398640364408493, 0.7029417753219604, 1.0),
    3: (5.500893294811249e-2, 0.24221095442771912, 0.6932829022407532, 1.0),
    4: (
        *(9.582852944731712e-3, 5.5906426161527634e-2, 0.24024099111557007),
        *(0.6931241750717163, 1.0),
    ),
    5: (
        *(1.3400436146184802e-3, 9.666373021900654e-3, 5.550333112478256e-2),
        *(0.2402234822511673, 0.6931471824645996, 1.0),
    ),
    6: (
        *(1.546973508084193e-4, 1.3390866806730628e-3, 9.618030861020088e-3),
        *(5.5503569543361664e-2, 0.24022650718688965, 0.6931471824645996, 1.0),
    ),
}


def _polynomial(degree: int) -> str:
    """C++ text that computes p from f, so that fma_(p, f, 1) is the polynomial of that degree."""
    first, *rest, _ = _EXP2[degree]
    lines = [f"F p = splat({first!r}f);", *(f"p = fma_(p, f, splat({c!r}f));" for c in rest)]
    return "\n    ".join(lines)


# exp2 rounds to an integer by adding 1.5 * 2^23 (+127, the exponent bias), and takes the polynomial
# of the rest. NaN stays NaN.
_PRELUDE = (
    VECTORS
    + """
auto fma_ = [](F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
// max(top, |x|) by their bits, so that NaN is the greatest
auto wider_ = [](F top, F x) -> F {
    I i = (I)x & 0x7fffffff;
    return (F)(i > (I)top ? i : (I)top);
};
// whether |x| <= 125 in all lanes
auto tame_ = [](F x) -> bool { return !__builtin_reduce_or(~((x <= 125.0f) & (x >= -125.0f))); };
const float LOG2E = 1.44269504088896341f;
const F shifter = splat(12583039.0f);
auto exp2_clamped_ = [&](F x) -> F {
    F r = x + shifter;
    F f = x - (r - shifter);
    ACCURATE
    return fma_(p, f, splat(1.0f)) * (F)((I)r << 23);
};
auto exp2_ = [&](F x) -> F {
    x = x < -126.0f ? splat(-126.0f) : x;
    return exp2_clamped_(x > 128.0f ? splat(128.0f) : x);
};
// e^-|x|; NaN gives 2^-126
auto decay_ = [&](F x) -> F {
    x = (F)((I)x | (int)0x80000000) * LOG2E;
    return exp2_clamped_(x > -126.0f ? x : splat(-126.0f));
};
// p for |x| <= 125 and no NaN, of another degree: 2^x is near (1 + low) (1 + f p), where near is a
// float32 and low what that rounds away. If |x| < 1/32, near is 1, low is 0 and f is x.
auto exp2_parts_ = [&](F x, F& near, F& low, F& f) -> F {
    const F plain = splat(12582912.0f);
    F r = x + plain;
    f = x - (r - plain);
    near = (F)(((I)r << 23) + 0x3f800000), low = F{};
    TAME
    return p;
};
// 2^x of the same x. Where |x| < 1/32, rise is 2^x - 1 and keeps what 2^x rounds away; elsewhere it
// is some number.
auto exp2_rise_ = [&](F x, F& rise) -> F {
    F near, low, f;
    const F p = exp2_parts_(x, near, low, f);
    rise = f * p;
    JOIN
};
"""
).replace("ACCURATE", _polynomial(6))


# The same from a table of 2^(i/16), which one instruction of AVX-512 reads, and a cubic of what is
# left, |f| <= 1/32: one multiplication less than degree 5, and a smaller error. What the index adds
# to the exponent is taken from the table beforehand. 786432 = 1.5 * 2^19 rounds to sixteenths.
_TABLE = [
    *(1065353216, 1065200323, 1065063874, 1064944595, 1064843248, 1064760626),
    *(1064697559, 1064654911, 1064633587, 1064634532, 1064658730, 1064707212),
    *(1064781053, 1064881375, 1065009351, 1065166205),
]
# What float32 rounds away of 2^(i/16), relative to it.
_LOW = [
    2 ** (i / 16) / struct.unpack("f", struct.pack("f", 2 ** (i / 16)))[0] - 1 for i in range(16)
]
_TABLED = """
#if defined(__AVX512F__)
auto exp2_parts_ = [&](F x, F& near, F& low, F& f) -> F {
    const F plain = splat(786432.0f);
    const I table = {TABLE};
    const F lows = {LOW};
    F r = x + plain;
    f = x - (r - plain);
    near = (F)((I)__builtin_ia32_permvarsi512(table, (I)r) + ((I)r << 19));
    low = (F)__builtin_ia32_permvarsi512((I)lows, (I)r);
    F p = splat(0.05550522f);
    p = fma_(p, f, splat(0.24023214f));
    return fma_(p, f, splat(0.69314718f));
};
#else
POLYNOMIAL
#endif
"""
_JOIN = "return (F)((I)fma_(p, f, splat(1.0f)) + ((I)near - 0x3f800000));"
_JOIN_TABLED = f"""
#if defined(__AVX512F__)
    return fma_(near, rise, near);
#else
    {_JOIN}
#endif
"""


def prelude(degree: int, table: bool = False) -> str:
    """C++ text of the arithmetic on lanes.

    Args:
        degree: of the polynomial in ``exp2_parts_`` and ``exp2_rise_``.
        table: whether a table takes its place where the processor has AVX-512.
    """
    text = _PRELUDE.replace("JOIN", _JOIN_TABLED if table else _JOIN)
    if table:
        begin, end = text.index("auto exp2_parts_"), text.index("// 2^x of the same x.")
        tabled = _TABLED.replace("TABLE", ", ".join(map(str, _TABLE)))
        tabled = tabled.replace("LOW", ", ".join(f"{x!r}f" for x in _LOW))
        text = text[:begin] + tabled.replace("POLYNOMIAL", text[begin:end]) + text[end:]
    return text.replace("TAME", _polynomial(degree))


PRELUDE = prelude(5)

# softplus(x) = max(x, 0) + log1p(e), e = exp(-|x|), log1p(e) = 2 atanh(e / (2 + e)): no branch,
# relatively accurate for x << 0, and x itself in float32 well before 20. NaN stays NaN.
ACTIVATIONS = """
// from s = e / (2 + e)
auto softplus_of_ = [&](F v, F s) -> F {
    F w = s * s;
    F p = splat(0.1401223282424694f);
    p = fma_(p, w, splat(0.13999569703388653f));
    p = fma_(p, w, splat(0.20010849594358543f));
    p = fma_(p, w, splat(0.33333206564805135f));
    p = fma_(p, w, splat(1.0f));
    return fma_(s + s, p, F{} > v ? F{} : v);
};
auto softplus_ = [&](F v) -> F {
    F e = decay_(v);
    return softplus_of_(v, e / (e + 2.0f));
};
auto sigmoid_ = [&](F v) -> F {
    F e = decay_(v);
    return (v < 0.0f ? e : splat(1.0f)) / (e + 1.0f);
};
"""


@wp.func_native(PRELUDE + ACTIVATIONS + f"{LANES} r; *(F*)&r = softplus_(*(const F*)&x); return r;")
def softplus(x: lanes) -> lanes: ...


@wp.func_native(PRELUDE + ACTIVATIONS + f"{LANES} r; *(F*)&r = sigmoid_(*(const F*)&x); return r;")
def sigmoid(x: lanes) -> lanes: ...


@wp.func_native(VECTORS + f"{LANES} r; *(F*)&r = *(const F*)&a * *(const F*)&b; return r;")
def times(a: lanes, b: lanes) -> lanes: ...


@wp.func_native(
    PRELUDE + f"{LANES} r; *(F*)&r = fma_(*(const F*)&a, *(const F*)&b, *(const F*)&c); return r;"
)
def fma(a: lanes, b: lanes, c: lanes) -> lanes: ...


# A state that decays towards zero passes through denormals, which slow x86 down a hundredfold.
@wp.func_native("""
#if defined(__x86_64__)
int before = (int)__builtin_ia32_stmxcsr();
__builtin_ia32_ldmxcsr(before | 0x8040);
return before;
#else
return 0;
#endif
""")
def flush_denormals() -> int: ...


@wp.func_native("""
#if defined(__x86_64__)
__builtin_ia32_ldmxcsr(before);
#endif
""")
def restore_denormals(before: int): ...
