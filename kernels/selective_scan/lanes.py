"""Native leaves of the CPU kernels: sixteen adjacent channels as one SIMD value.

A leaf is a little C++ with the compiler's vector types, which become AVX-512, AVX2 or NEON
instructions. The loops around them, and all that is not arithmetic on lanes, are Warp kernels.
"""

import torch
import warp as wp

W = 16  # channels of a lane group: one cache line of float32
lanes = wp.types.vector(W, wp.float32)
VALUE, WIDTH = lanes, W  # the names that scalars.py shares
LANES = "wp::vec_t<16, float>"

VECTORS = """
typedef float F __attribute__((vector_size(64), aligned(4)));
typedef int I __attribute__((vector_size(64), aligned(4)));
"""

# exp2: round to an integer by adding 1.5 * 2^23 (+127, the exponent bias), then a minimax
# polynomial of the rest with the constant term held at 1, so that exp2(x) - 1 keeps its relative
# accuracy for small x: the errors of slow decays add up over thousands of steps. NaN stays NaN.
PRELUDE = (
    VECTORS
    + """
auto fma_ = [](F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
auto exp2_ = [&](F x) -> F {
    const F low = F{} - 126.0f, high = F{} + 128.0f, shifter = F{} + 12583039.0f;
    x = x < low ? low : x;
    x = x > high ? high : x;
    F r = x + shifter;
    F f = x - (r - shifter);
    F p = F{} + 1.5353360628288064e-4f;
    p = fma_(p, f, F{} + 1.3398874866584892e-3f);
    p = fma_(p, f, F{} + 9.618437366421834e-3f);
    p = fma_(p, f, F{} + 5.5503324696939e-2f);
    p = fma_(p, f, F{} + 0.24022647913498998f);
    p = fma_(p, f, F{} + 0.6931472028559706f);
    p = fma_(p, f, F{} + 1.0f);
    return p * (F)((I)r << 23);
};
const float LOG2E = 1.44269504088896341f;
"""
)


def _unary(body: str) -> str:
    return PRELUDE + f"F v = *(const F*)&x; {LANES} result; {body} return result;"


# softplus(x) = max(x, 0) + log1p(e), e = exp(-|x|), log1p(e) = 2 atanh(e / (2 + e)): no branch,
# relatively accurate for x << 0, and x itself in float32 well before 20.
@wp.func_native(
    _unary("""
F e = exp2_((v < 0.0f ? v : -v) * LOG2E);
F s = e / (e + 2.0f);
F w = s * s;
F p = F{} + 0.1401223282424694f;
p = fma_(p, w, F{} + 0.13999569703388653f);
p = fma_(p, w, F{} + 0.20010849594358543f);
p = fma_(p, w, F{} + 0.33333206564805135f);
p = fma_(p, w, F{} + 1.0f);
*(F*)&result = (v < 0.0f ? F{} : v) + 2.0f * s * p;
""")
)
def softplus(x: lanes) -> lanes: ...


@wp.func_native(
    _unary("""
F e = exp2_((v < 0.0f ? v : -v) * LOG2E);
*(F*)&result = (v < 0.0f ? e : F{} + 1.0f) / (e + 1.0f);
""")
)
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


_ADDRESS = (
    "{T}* p = ({T}*)((char*)x.data + (size_t)b * x.strides[0] + (size_t)t * x.strides[1]) + d;"
)
# element type, lanes from *p, one lane from p[i], *p from lanes v, p[i] from v.c[i]
_CODE = {
    torch.float32: ("float", "*(const F*)p", "p[i]", "*(F*)p = *(const F*)&v", "p[i] = v.c[i]"),
    torch.float16: (
        "_Float16",
        "__builtin_convertvector(*(const H*)p, F)",
        "(float)p[i]",
        "*(H*)p = __builtin_convertvector(*(const F*)&v, H)",
        "p[i] = (_Float16)v.c[i]",
    ),
    torch.bfloat16: (
        "unsigned short",
        "(F)(__builtin_convertvector(*(const S*)p, I) << 16)",
        "widen(p[i])",
        "*(S*)p = __builtin_convertvector(narrow((I)*(const F*)&v), S)",
        "p[i] = (unsigned short)narrow(I{} + bits(v.c[i]))[0]",
    ),
}
_HALF = """
typedef _Float16 H __attribute__((vector_size(32), aligned(2)));
"""
_BFLOAT = """
typedef unsigned short S __attribute__((vector_size(32), aligned(2)));
auto widen = [](unsigned short s) -> float {
    int i = (int)s << 16;
    float f;
    __builtin_memcpy(&f, &i, 4);
    return f;
};
auto bits = [](float f) -> int { int i; __builtin_memcpy(&i, &f, 4); return i; };
auto narrow = [](I i) -> I {  // to nearest, ties to even; NaN stays a NaN
    I is_nan = (i & 0x7fffffff) > 0x7f800000;
    I rounded = (i + 0x7fff + ((i >> 16) & 1)) >> 16;
    return (is_nan ? (i >> 16) | 0x40 : rounded) & 0xffff;
};
"""
WARP_DTYPES = {
    torch.float32: wp.float32,
    torch.float16: wp.float16,
    torch.bfloat16: wp.bfloat16,
}


def _accessors(dtype: torch.dtype):
    element, read, read_one, write, write_one = _CODE[dtype]
    scalar = WARP_DTYPES[dtype]
    address = VECTORS + {torch.float16: _HALF, torch.bfloat16: _BFLOAT}.get(dtype, "")
    address += _ADDRESS.format(T=element)
    read_body = (
        f"{LANES} r; if (count == 16) *(F*)&r = {read};"
        f"else for (int i = 0; i < count; ++i) r.c[i] = {read_one}; return r;"
    )
    write_body = f"if (count == 16) {write}; else for (int i = 0; i < count; ++i) {write_one};"

    @wp.func_native(address + read_body)
    def load(x: wp.array3d(dtype=scalar), b: int, t: int, d: int, count: int) -> lanes: ...

    @wp.func_native(address + write_body)
    def store(x: wp.array3d(dtype=scalar), b: int, t: int, d: int, count: int, v: lanes): ...

    return load, store


# By element type, ``(load, store)``: both address row [b, t] of a [B, L, D] array, dense in D, from
# channel d on. Lanes from ``count`` on are read as 0 and not written.
ACCESSORS = {dtype: _accessors(dtype) for dtype in WARP_DTYPES}
