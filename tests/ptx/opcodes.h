// The operations of PTX that compute, each on the 32 lanes of a warp; machine.cpp has all others.
//
// A register is 32 slots of 4 bytes (W) or 8 (Q), one a lane. A predicate is a W of 0 or 1; what
// has 16 bits lies in a W with zeros above it.
#include <cfenv>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

typedef uint8_t u8;
typedef uint16_t u16;
typedef uint32_t u32;
typedef uint64_t u64;
typedef int16_t s16;
typedef int32_t s32;
typedef int8_t s8;
typedef int64_t s64;
typedef float f32;
typedef double f64;

const u64 SHARED = 1ull << 56, LOCAL = 2ull << 56;  // where a space begins in generic addresses

#define EACH(l, lanes)                                                                             \
    for (int l = 0; l < 32; l++)                                                                   \
        if ((lanes) >> l & 1)

struct Instruction {  // as parse.py has it
    s32 op, guard, inverted, target, writes, reads, to[4], given[5];
    s32 space, size, vector, is_signed, wide, wide_address;
    s64 offset;
};

// Kinds of which machine.cpp knows more than that their lanes compute.
enum Kind { PLAIN, SELECT, AND, OR, LOAD, STORE, ATOMIC, BRANCH, EXIT, BLOCK, WARP, SHUFFLE };

struct Opcode {
    // The unit is what works on it; a move is mostly none of the machine's instructions, and a
    // routine many. Operands are told by their widths, first of what is written.
    const char *name, *unit, *operands;
    s32 writes;
    Kind kind;
    void (*run)(u8* file, const Instruction& I, u32 lanes);
};

template<class T>
using Slot = std::conditional_t<sizeof(T) == 8, u64, u32>;
template<class... T>
struct Widths {
    static constexpr char text[] = {(sizeof(T) == 8 ? 'Q' : 'W')..., 0};
};

template<class T>
inline T value(Slot<T> slot) {
    if constexpr (!std::is_floating_point_v<T>) return (T)slot;
    T x;
    memcpy(&x, &slot, sizeof x);
    return x;
}

template<class T>
inline Slot<T> slot(T x) {
    if constexpr (!std::is_floating_point_v<T>) return (std::make_unsigned_t<T>)x;
    Slot<T> s;
    memcpy(&s, &x, sizeof s);
    return s;
}

template<class D, class... A, size_t... i, class F>
inline void on_lanes(
    u8* file, const Instruction& I, u32 lanes, F function, std::index_sequence<i...>) {
    auto to = (Slot<D>*)(file + I.to[0]);
    auto one = [&](int l) {
        to[l] = slot<D>(function(value<A>(((const Slot<A>*)(file + I.given[i]))[l])...));
    };
    if (lanes == ~0u) {
#pragma GCC ivdep
        for (int l = 0; l < 32; l++) one(l);
    } else {
        EACH(l, lanes) one(l);
    }
}

// The approximate units: 0 rounds as best can be, 1 takes the smallest value that the documented
// bound allows, any other number draws an error within it for each argument. What the ISA's tables
// of special arguments state is exact: 0 has the power 1, which masks tokens past the end.
static u32 approximate = 0;

// What .ftz makes of an operand or a result: subnormal float32 numbers become 0 of their sign.
inline f32 flushed(f32 x) { return std::fpclassify(x) == FP_SUBNORMAL ? std::copysign(0.f, x) : x; }
template<class T>
inline T flushed(T x) {
    return x;
}

inline f32 approx(double exact, f32 argument, double bound) {
    if (!approximate || !std::isfinite(exact) || flushed(argument) == 0) return exact;
    u32 x = slot(argument) ^ approximate * 0x9E3779B9u;
    x = (x ^ x >> 16) * 0x7feb352du;
    x = (x ^ x >> 15) * 0x846ca68bu;
    double drawn = (x ^ x >> 16) / 2147483648.0 - 1.0;
    return exact * (1 + bound * (approximate == 1 ? -1.0 : drawn));
}

template<class T>
inline T truncated(f32 x) {  // beyond the type's range, its ends; NaN is 0
    const double low = std::is_signed_v<T> ? -2147483648.0 : 0.0, high = low + 4294967295.0;
    return std::isnan(x) ? 0 : x < low ? (T)low : x > high ? (T)high : (T)x;
}

// A number and NaN give the number, and -0 lies below 0.
inline f32 least(f32 a, f32 b) {
    if (std::isnan(a) || std::isnan(b)) return std::isnan(a) ? std::isnan(b) ? NAN : b : a;
    return a == b ? (std::signbit(a) ? a : b) : a < b ? a : b;
}
inline f32 greatest(f32 a, f32 b) { return -least(-a, -b); }

// Without bits: PTX leaves a division by zero open, and hardware gives these.
template<class T>
inline T divided(T a, T b) {
    if (std::is_signed_v<T> && b == (T)-1) return (T)(0 - (std::make_unsigned_t<T>)a);
    return b == 0 ? (T)-1 : (T)(a / b);
}
template<class T>
inline T rest(T a, T b) {
    return b == 0 ? a : std::is_signed_v<T> && b == (T)-1 ? 0 : (T)(a % b);
}

inline u32 reversed(u32 x) {
    u32 y = 0;
    for (int i = 0; i < 32; i++) y |= (x >> i & 1) << (31 - i);
    return y;
}

inline u32 selected_bytes(u32 a, u32 b, u32 c) {  // by 4 bits of c: a byte of (b, a), or its sign
    u64 bytes = (u64)b << 32 | a;
    u32 found = 0;
    for (int i = 0; i < 4; i++) {
        u32 chosen = c >> 4 * i & 15, byte = bytes >> 8 * (chosen & 7) & 255;
        found |= (chosen & 8 ? (byte & 128 ? 255u : 0u) : byte) << 8 * i;
    }
    return found;
}

inline f32 rounded(int direction, f32 a, f32 b, f32 c) {  // a product and a sum, rounded once
    std::fesetround(direction);
    volatile f32 x = a;
    volatile f32 result = std::fma(x, b, c);
    std::fesetround(FE_TONEAREST);
    return result;
}

// To half precision, to the nearest and of two such to the even one.
inline u16 bf16(f32 x) {
    u32 bits = slot(x);
    return std::isnan(x) ? 0x7fff : (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
}
inline u16 f16(f32 x) {
    _Float16 half = x;
    u16 bits;
    memcpy(&bits, &half, 2);
    return std::isnan(x) ? 0x7fff : bits;
}
inline f32 of_f16(u16 bits) {
    _Float16 half;
    memcpy(&half, &bits, 2);
    return half;
}

// clang-format off
#define RUN(e, D, ...) [](u8* file, const Instruction& I, u32 lanes) { \
    on_lanes<D, __VA_ARGS__>(file, I, lanes, e, PLACES(__VA_ARGS__)); }
#define PLACES(...) std::make_index_sequence<sizeof(Widths<__VA_ARGS__>::text) - 1>()
#define OP1(unit, name, D, A, e) \
    {name, #unit, Widths<D, A>::text, 1, PLAIN, RUN([](A a) { return (D)(e); }, D, A)},
#define OP2K(unit, name, kind, D, A, B, e) \
    {name, #unit, Widths<D, A, B>::text, 1, kind, RUN(([](A a, B b) { return (D)(e); }), D, A, B)},
#define OP2(unit, name, D, A, B, e) OP2K(unit, name, PLAIN, D, A, B, e)
#define OP3K(unit, name, kind, D, A, B, C, e) \
    {name, #unit, Widths<D, A, B, C>::text, 1, kind, RUN(([](A a, B b, C c) { return (D)(e); }), D, A, B, C)},
#define OP3(unit, name, D, A, B, C, e) OP3K(unit, name, PLAIN, D, A, B, C, e)

// Of float32, with and without .ftz.
#define FLOAT1(unit, name, t, D, e) OP1(unit, name t, D, f32, e) \
    {name ".ftz" t, #unit, Widths<D, f32>::text, 1, PLAIN, RUN([](f32 a) { a = flushed(a); return flushed((D)(e)); }, D, f32)},
#define FLOAT2(unit, name, D, e) OP2(unit, name ".f32", D, f32, f32, e) \
    {name ".ftz.f32", #unit, Widths<D, f32, f32>::text, 1, PLAIN, \
        RUN(([](f32 a, f32 b) { a = flushed(a), b = flushed(b); return flushed((D)(e)); }), D, f32, f32)},
#define FLOAT3(unit, name, e) OP3(unit, name ".f32", f32, f32, f32, f32, e) \
    {name ".ftz.f32", #unit, Widths<f32, f32, f32, f32>::text, 1, PLAIN, \
        RUN(([](f32 a, f32 b, f32 c) { a = flushed(a), b = flushed(b), c = flushed(c); return flushed((f32)(e)); }), f32, f32, f32, f32)},

// One operation for several types; an operation that does not depend on the sign is unsigned.
#define MOVES(t, T) OP1(move, "mov." t, T, T, a) OP3K(integer, "selp." t, SELECT, T, T, T, u32, c ? a : b)
#define INTEGERS(unit, name, e) \
    OP2(unit, name ".s16", u16, u16, u16, e) OP2(unit, name ".u16", u16, u16, u16, e) OP2(unit, name ".s32", u32, u32, u32, e) \
    OP2(unit, name ".u32", u32, u32, u32, e) OP2(unit, name ".s64", u64, u64, u64, e) OP2(unit, name ".u64", u64, u64, u64, e)
#define SIGNED(unit, name, e) \
    OP2(unit, name ".s32", s32, s32, s32, e) OP2(unit, name ".u32", u32, u32, u32, e) \
    OP2(unit, name ".s64", s64, s64, s64, e) OP2(unit, name ".u64", u64, u64, u64, e)
#define LOGIC(name, kind, e) \
    OP2(integer, name ".b16", u16, u16, u16, e) OP2(integer, name ".b32", u32, u32, u32, e) OP2(integer, name ".b64", u64, u64, u64, e) \
    OP2K(integer, name ".pred", kind, u32, u32, u32, e)
#define COMPARE(name, e) \
    OP2(integer, name ".s16", u32, s16, s16, e) OP2(integer, name ".u16", u32, u16, u16, e) OP2(integer, name ".s32", u32, s32, s32, e) \
    OP2(integer, name ".u32", u32, u32, u32, e) OP2(integer, name ".s64", u32, s64, s64, e) OP2(integer, name ".u64", u32, u64, u64, e)
#define SAME(name, e) COMPARE(name, e) \
    OP2(integer, name ".b16", u32, u16, u16, e) OP2(integer, name ".b32", u32, u32, u32, e) OP2(integer, name ".b64", u32, u64, u64, e)

#define COMPUTING \
    MOVES("b16", u16) MOVES("u16", u16) MOVES("s16", u16) MOVES("b32", u32) MOVES("u32", u32) \
    MOVES("s32", u32) MOVES("f32", u32) MOVES("b64", u64) MOVES("u64", u64) MOVES("s64", u64) \
    OP1(move, "mov.pred", u32, u32, a != 0) OP1(integer, "not.pred", u32, u32, !a) \
    OP1(move, "cvta.to.global.u64", u64, u64, a) OP1(move, "cvta.to.shared.u64", u64, u64, a & ~SHARED) \
    OP1(move, "cvta.to.local.u64", u64, u64, a) \
    OP1(move, "cvta.shared.u64", u64, u64, a | SHARED) OP1(move, "cvta.local.u64", u64, u64, a) \
    OP1(integer, "cvt.s64.s32", s64, s32, a) OP1(move, "cvt.u64.u32", u64, u32, a) OP1(move, "cvt.u32.u64", u32, u64, a) \
    OP1(move, "cvt.s64.s32 of 64", s64, u64, (s32)a) OP1(move, "cvt.u64.u32 of 64", u64, u64, (u32)a) \
    OP1(move, "cvt.u32.u16", u32, u16, a) OP1(move, "cvt.u16.u32", u16, u32, a) OP1(integer, "cvt.s32.s16", s32, s16, a) OP1(integer, "cvt.s32.s8", s32, s8, a) \
    OP1(integer, "cvt.u32.u8", u32, u8, a) OP1(integer, "cvt.u16.u8", u16, u8, a) \
    OP1(convert, "cvt.rn.f32.s32", f32, s32, a) OP1(convert, "cvt.rn.f32.u32", f32, u32, a) OP1(convert, "cvt.rn.f32.s64", f32, s64, a) \
    FLOAT1(convert, "cvt.rzi", ".s32.f32", s32, truncated<s32>(a)) FLOAT1(convert, "cvt.rzi", ".u32.f32", u32, truncated<u32>(a)) \
    OP1(convert, "cvt.rn.bf16.f32", u16, f32, bf16(a)) OP1(convert, "cvt.rn.f16.f32", u16, f32, f16(a)) \
    OP1(convert, "cvt.f32.f16", f32, u16, of_f16(a)) OP1(integer, "cvt.f32.bf16", f32, u16, value<f32>((u32)a << 16)) \
    FLOAT1(convert, "cvt.rpi", ".f32.f32", f32, std::ceil(a)) FLOAT1(convert, "cvt.rmi", ".f32.f32", f32, std::floor(a)) \
    OP1(float, "cvt.sat.f32.f32", f32, f32, a > 0 ? a < 1 ? a : 1 : 0) \
    FLOAT1(move, "abs", ".f32", f32, std::fabs(a)) FLOAT1(move, "neg", ".f32", f32, -a) \
    OP1(integer, "neg.s32", u32, u32, 0 - a) OP1(integer, "neg.s64", u64, u64, 0 - a) \
    OP1(integer, "not.b16", u16, u16, ~a) OP1(integer, "not.b32", u32, u32, ~a) OP1(integer, "not.b64", u64, u64, ~a) \
    OP1(special, "brev.b32", u32, u32, reversed(a)) OP1(special, "popc.b32", u32, u32, __builtin_popcount(a)) \
    OP1(special, "clz.b32", u32, u32, a ? __builtin_clz(a) : 32) \
    OP1(special, "bfind.u32", u32, u32, a ? 31 - __builtin_clz(a) : ~0u) \
    OP1(special, "bfind.shiftamt.u32", u32, u32, a ? __builtin_clz(a) : ~0u) \
    INTEGERS(integer, "add", a + b) INTEGERS(integer, "sub", a - b) INTEGERS(multiply, "mul.lo", a * b) \
    SIGNED(routine, "div", divided(a, b)) SIGNED(routine, "rem", rest(a, b)) \
    SIGNED(integer, "min", a < b ? a : b) SIGNED(integer, "max", a > b ? a : b) \
    OP2(multiply, "mul.wide.s32", s64, s32, s32, (s64)a * b) OP2(multiply, "mul.wide.u32", u64, u32, u32, (u64)a * b) \
    OP2(multiply, "mul.hi.s32", s32, s32, s32, (s64)a * b >> 32) OP2(multiply, "mul.hi.u32", u32, u32, u32, (u64)a * b >> 32) \
    OP3(multiply, "mad.lo.s32", u32, u32, u32, u32, a * b + c) OP3(multiply, "mad.lo.u32", u32, u32, u32, u32, a * b + c) \
    OP3(multiply, "mad.lo.s64", u64, u64, u64, u64, a * b + c) \
    OP3(multiply, "mad.wide.s32", s64, s32, s32, s64, (s64)a * b + c) OP3(multiply, "mad.wide.u32", u64, u32, u32, u64, (u64)a * b + c) \
    LOGIC("and", AND, a & b) LOGIC("or", OR, a | b) LOGIC("xor", PLAIN, a ^ b) \
    OP2(integer, "shl.b16", u16, u16, u32, b > 15 ? 0 : a << b) OP2(integer, "shl.b32", u32, u32, u32, b > 31 ? 0 : a << b) \
    OP2(integer, "shl.b64", u64, u64, u32, b > 63 ? 0 : a << b) OP2(integer, "shr.u16", u16, u16, u32, b > 15 ? 0 : a >> b) \
    OP2(integer, "shr.u32", u32, u32, u32, b > 31 ? 0 : a >> b) OP2(integer, "shr.b32", u32, u32, u32, b > 31 ? 0 : a >> b) \
    OP2(integer, "shr.u64", u64, u64, u32, b > 63 ? 0 : a >> b) OP2(integer, "shr.b64", u64, u64, u32, b > 63 ? 0 : a >> b) \
    OP2(integer, "shr.s32", s32, s32, u32, a >> (b > 31 ? 31 : b)) OP2(integer, "shr.s64", s64, s64, u32, a >> (b > 63 ? 63 : b)) \
    SAME("setp.eq", a == b) SAME("setp.ne", a != b) COMPARE("setp.lt", a < b) \
    COMPARE("setp.le", a <= b) COMPARE("setp.gt", a > b) COMPARE("setp.ge", a >= b) \
    FLOAT2(integer, "setp.eq", u32, a == b) FLOAT2(integer, "setp.ne", u32, a < b || a > b) \
    FLOAT2(integer, "setp.lt", u32, a < b) FLOAT2(integer, "setp.le", u32, a <= b) \
    FLOAT2(integer, "setp.gt", u32, a > b) FLOAT2(integer, "setp.ge", u32, a >= b) \
    FLOAT2(integer, "setp.equ", u32, !(a < b || a > b)) FLOAT2(integer, "setp.neu", u32, !(a == b)) \
    FLOAT2(integer, "setp.ltu", u32, !(a >= b)) FLOAT2(integer, "setp.leu", u32, !(a > b)) \
    FLOAT2(integer, "setp.gtu", u32, !(a <= b)) FLOAT2(integer, "setp.geu", u32, !(a < b)) \
    FLOAT2(integer, "setp.nan", u32, a != a || b != b) FLOAT2(integer, "setp.num", u32, a == a && b == b) \
    FLOAT2(float, "add", f32, a + b) FLOAT2(float, "sub", f32, a - b) FLOAT2(float, "mul", f32, a * b) \
    FLOAT2(float, "add.rn", f32, a + b) FLOAT2(float, "sub.rn", f32, a - b) \
    FLOAT2(float, "mul.rn", f32, a * b) FLOAT2(routine, "div.rn", f32, a / b) \
    FLOAT2(integer, "min", f32, least(a, b)) FLOAT2(integer, "max", f32, greatest(a, b)) \
    FLOAT3(float, "fma.rn", std::fma(a, b, c)) \
    FLOAT3(float, "a * b - c", std::fma(a, b, -c)) /* contract.py writes these two */ \
    FLOAT3(float, "c - a * b", std::fma(-a, b, c)) \
    OP3(float, "fma.rm.f32", f32, f32, f32, f32, rounded(FE_DOWNWARD, a, b, c)) \
    FLOAT2(float, "add.rz", f32, rounded(FE_TOWARDZERO, a, 1, b)) \
    OP2(integer, "copysign.f32", u32, u32, u32, (a & 0x80000000u) | (b & 0x7fffffffu)) \
    OP2(float, "add.f64", f64, f64, f64, a + b) OP2(float, "mul.f64", f64, f64, f64, a * b) OP2(routine, "div.rn.f64", f64, f64, f64, a / b) \
    OP1(convert, "cvt.ftz.f64.f32", f64, f32, flushed(a)) OP1(convert, "cvt.rn.ftz.f32.f64", f32, f64, flushed((f32)a)) \
    OP2(integer, "mov.b32 of 2", u32, u16, u16, a | (u32)b << 16) \
    OP3(integer, "prmt.b32", u32, u32, u32, u32, selected_bytes(a, b, c)) \
    OP1(routine, "sqrt.rn.f32", f32, f32, std::sqrt(a)) OP1(routine, "rcp.rn.f32", f32, f32, 1 / a) \
    OP1(special, "ex2.approx.ftz.f32", f32, f32, flushed(approx(std::exp2((double)flushed(a)), a, 0x1p-22))) \
    OP1(special, "rcp.approx.ftz.f32", f32, f32, flushed(approx(1 / (double)flushed(a), a, 0x1p-23))) \
    OP1(special, "lg2.approx.ftz.f32", f32, f32, approx(std::log2((double)flushed(a)), a, 0x1p-22)) \
    OP1(special, "rsqrt.approx.ftz.f32", f32, f32, approx(1 / std::sqrt((double)flushed(a)), a, 0x1p-22)) \
    OP1(special, "sqrt.approx.ftz.f32", f32, f32, flushed(approx(std::sqrt((double)flushed(a)), a, 0x1p-23)))
// clang-format on
