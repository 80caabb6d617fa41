"""Native leaves of the CPU compositor: the 16 pixels of a 4 x 4 block as one SIMD value.

A leaf is a few lines of C++ with the compiler's vector types, which become AVX-512, AVX2 or NEON
instructions. The loops around them are Warp kernels. In a block, lane l is pixel (l % 4, l // 4).
"""

import warp as wp

LANES = 16
lanes = wp.types.vector(LANES, wp.float32)
lanes_int = wp.types.vector(LANES, wp.int32)

_TYPES = """
typedef float F __attribute__((vector_size(64), aligned(4)));
typedef int I __attribute__((vector_size(64), aligned(4)));
const F X = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
const F Y = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
auto max_ = [](F a, F b) -> F { return a > b ? a : b; };
auto min_ = [](F a, F b) -> F { return a < b ? a : b; };
auto fma_ = [](F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
"""


def _leaf(body: str, result: str = "F") -> str:
    """The snippet that computes ``out``; Warp wants the decorator itself spelled out below."""
    kind = "float" if result == "F" else "int"
    return (
        f"{_TYPES} {result} out; {body} wp::vec_t<16, {kind}> packed; *({result}*)&packed = out;"
        "return packed;"
    )


@wp.func_native(_leaf("out = X * 4.0f + x;"))
def block_x(x: wp.float32) -> lanes:
    """Abscissa of the first pixel of each of the 16 blocks of a tile; the tile begins at x."""
    ...


@wp.func_native(_leaf("out = Y * 4.0f + y;"))
def block_y(y: wp.float32) -> lanes:
    """Ordinate of the first pixel of each of the 16 blocks of a tile; the tile begins at y."""
    ...


# README eq. 6 as in bin.py, for 16 blocks at once; the mask is gathered lane by lane at the end.
@wp.func_native(
    _TYPES
    + """
    F x0 = *(const F*)&xs, y0 = *(const F*)&ys, zero = F{};
    x0 = x0 - center_x; y0 = y0 - center_y;
    F x1 = x0 + 3.0f, y1 = y0 + 3.0f;
    F ny = max_(y0, min_(zero, y1)), nx = max_(x0, min_(zero, x1));
    F kny = k * ny;
    F u = max_(x0, min_(-kny, x1)) + kny;
    F q = a * u * u + e * ny * ny;
    F y = max_(y0, min_(nx * slope, y1));
    u = nx + k * y;
    q = min_(q, a * u * u + e * y * y);
    const I bit = {1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768};
    return __builtin_reduce_or((I)(q <= limit) & bit);
    """
)
def blocks_touched(
    xs: lanes,
    ys: lanes,
    center_x: wp.float32,
    center_y: wp.float32,
    a: wp.float32,
    k: wp.float32,
    e: wp.float32,
    slope: wp.float32,
    limit: wp.float32,
) -> wp.int32:
    """Bit b is set if block b may hold a pixel with q <= limit; slope = -a k / (a k² + e)."""
    ...


@wp.func_native("return __builtin_ctz(bits);")
def lowest_bit(bits: wp.int32) -> wp.int32:
    """Index of the lowest set bit; bits != 0."""
    ...


@wp.func_native(_leaf("out = X + k * Y + u;"))
def sheared(k: wp.float32, u: wp.float32) -> lanes:
    """The coordinate u = x + k y of a block's pixels; its first pixel has the given u."""
    ...


@wp.func_native(_leaf("out = Y + y;"))
def rows(y: wp.float32) -> lanes:
    """Ordinates of a block's pixels; the first row has the given one."""
    ...


# 2^x: rounded to an integer by adding 1.5 * 2^23 (+127, the exponent bias), and a minimax
# polynomial of the rest. a and e come with the factor -log2(e)/2.
@wp.func_native(
    _leaf(
        """
    F U = *(const F*)&u, V = *(const F*)&y;
    F x = fma_(U * a, U, V * V * e);
    x = max_(x, F{} - 126.0f);
    const F shifter = F{} + 12583039.0f;
    F n = x + shifter;
    F f = x - (n - shifter);
    F p = F{} + 1.5353360628288064e-4f;
    p = fma_(p, f, F{} + 1.3398874866584892e-3f);
    p = fma_(p, f, F{} + 9.618437366421834e-3f);
    p = fma_(p, f, F{} + 5.5503324696939e-2f);
    p = fma_(p, f, F{} + 0.24022647913498998f);
    p = fma_(p, f, F{} + 0.6931472028559706f);
    p = fma_(p, f, F{} + 1.0f);
    F alpha = p * (F)((I)n << 23) * opacity;
    out = alpha >= alpha_min ? min_(alpha, F{} + alpha_max) : F{};
    """
    )
)
def alphas(
    u: lanes,
    y: lanes,
    a: wp.float32,
    e: wp.float32,
    opacity: wp.float32,
    alpha_min: wp.float32,
    alpha_max: wp.float32,
) -> lanes:
    """Alpha = opacity * 2^(a u² + e y²), 0 where below alpha_min, clamped to alpha_max."""
    ...


@wp.func_native(_TYPES + "return __builtin_reduce_or((I)(*(const F*)&x != 0.0f));")
def any_nonzero(x: lanes) -> wp.int32:
    """Not 0 if some lane is not 0."""
    ...


@wp.func_native(_TYPES + "return __builtin_reduce_or((I)(*(const F*)&x > 0.0f));")
def any_positive(x: lanes) -> wp.int32:
    """Not 0 if some lane is above 0."""
    ...


# A pixel that has stopped keeps its transmittance, above t_min, with a minus sign. Written without
# a choice of T itself: that would become a masked store, from which the next load cannot forward.
@wp.func_native(
    _leaf(
        """
    F T = *(const F*)&t;
    F next = T - T * (T > 0.0f ? *(const F*)&alpha : F{});
    out = max_(next, -next) > t_min ? next : -T;
    """
    )
)
def advance(t: lanes, alpha: lanes, t_min: wp.float32) -> lanes:
    """Transmittance after a Gaussian; minus the old one where the pixel stops before it."""
    ...


@wp.func_native(_leaf("out = *(const F*)&next > 0.0f ? *(const F*)&t * *(const F*)&alpha : F{};"))
def weights(t: lanes, next: lanes, alpha: lanes) -> lanes:
    """T_i alpha_i, 0 where the pixel has stopped."""
    ...


@wp.func_native(
    _TYPES + "return __builtin_reduce_or((*(const F*)&t > 0.0f) & (*(const F*)&next < 0.0f));"
)
def any_stopped(t: lanes, next: lanes) -> wp.int32:
    """Not 0 if some pixel stops at this Gaussian."""
    ...


@wp.func_native(
    _leaf(
        "out = ((*(const F*)&t > 0.0f) & (*(const F*)&next < 0.0f)) ? I{} + k : *(const I*)&stops;",
        "I",
    )
)
def record_stops(stops: lanes_int, t: lanes, next: lanes, k: wp.int32) -> lanes_int:
    """Replaces the stop number of the pixels that stop at this Gaussian by k."""
    ...


@wp.func_native(_leaf("out = *(const I*)&stops > k ? *(const F*)&alpha : F{};"))
def before_stop(alpha: lanes, stops: lanes_int, k: wp.int32) -> lanes:
    """Alpha, 0 where the pixel stopped at Gaussian k or before."""
    ...


@wp.func_native(_leaf("out = *(const F*)&t / (1.0f - *(const F*)&alpha);"))
def rewind(t: lanes, alpha: lanes) -> lanes:
    """Transmittance before a Gaussian from that after it."""
    ...


# A clamped alpha does not depend on its inputs.
@wp.func_native(
    _leaf(
        "F A = *(const F*)&alpha;out = A < alpha_max ? *(const F*)&weight * *(const F*)&diff : F{};"
    )
)
def alpha_gradients(alpha: lanes, weight: lanes, diff: lanes, alpha_max: wp.float32) -> lanes:
    """The h of README eq. 10, alpha dL/dalpha = T alpha (s - R), 0 where alpha is clamped."""
    ...


@wp.func_native(_leaf("out = *(const F*)&a * *(const F*)&b;"))
def mul(a: lanes, b: lanes) -> lanes: ...


@wp.func_native(_leaf("out = *(const F*)&a + *(const F*)&b;"))
def add(a: lanes, b: lanes) -> lanes: ...


@wp.func_native(_leaf("F A = *(const F*)&a; out = A < 0.0f ? -A : A;"))
def absolute(a: lanes) -> lanes: ...


@wp.func_native(_leaf("out = *(const F*)&a - *(const F*)&b;"))
def sub(a: lanes, b: lanes) -> lanes: ...


@wp.func_native(_leaf("out = fma_(*(const F*)&a, *(const F*)&b, *(const F*)&c);"))
def fma(a: lanes, b: lanes, c: lanes) -> lanes:
    """Returns a b + c."""
    ...


@wp.func_native(_leaf("out = fma_(*(const F*)&a, F{} + s, *(const F*)&c);"))
def axpy(a: lanes, s: wp.float32, c: lanes) -> lanes:
    """Returns a s + c with a scalar s."""
    ...


# Pairwise, in a fixed order.
@wp.func_native(
    """
    float s[16];
    for (int l = 0; l < 16; ++l) s[l] = x.c[l];
    for (int w = 8; w > 0; w >>= 1)
        for (int l = 0; l < w; ++l) s[l] += s[l + w];
    return s[0];
    """
)
def total(x: lanes) -> wp.float32:
    """Sum of the lanes."""
    ...


# The block's pixels that lie in the picture, one channel; strides in bytes.
_PIXELS = """
    const int height = {image}.shape[1], width = {image}.shape[2];
    const int ny = height - y < 4 ? height - y : 4, nx = width - x < 4 ? width - x : 4;
    char* begin = (char*){image}.data + (size_t)view * {image}.strides[0]
        + (size_t)y * {image}.strides[1] + (size_t)x * {image}.strides[2]
        + (size_t)channel * {image}.strides[3];
    for (int j = 0; j < ny; ++j)
        for (int i = 0; i < nx; ++i) {{
            float* pixel = (float*)(begin + j * {image}.strides[1] + i * {image}.strides[2]);
            {body}
        }}
"""


@wp.func_native(_PIXELS.format(image="image", body="*pixel = value.c[4 * j + i];"))
def store_block(
    image: wp.array4d[wp.float32],
    view: wp.int32,
    y: wp.int32,
    x: wp.int32,
    channel: wp.int32,
    value: lanes,
):
    """Writes the lanes to image [view, y:y+4, x:x+4, channel]."""
    ...


@wp.func_native(
    _leaf(
        "float value[16] = {};"
        + _PIXELS.format(image="image", body="value[4 * j + i] = *pixel;")
        + "out = *(const F*)value;"
    )
)
def load_block(
    image: wp.array4d[wp.float32],
    view: wp.int32,
    y: wp.int32,
    x: wp.int32,
    channel: wp.int32,
) -> lanes:
    """Lanes from image [view, y:y+4, x:x+4, channel], 0 outside the picture."""
    ...


@wp.func_native(_leaf("F T = *(const F*)&t; out = 1.0f - (T < 0.0f ? -T : T);"))
def coverage(t: lanes) -> lanes:
    """Returns 1 - |T|."""
    ...
