"""Native leaves of the CPU compositor: the 16 pixels of a 4 x 4 block as one SIMD value.

A leaf is a few lines of C++ with the compiler's vector types, which become AVX-512, AVX2 or NEON
instructions. The loops around them are Warp kernels. In a block, lane l is pixel (l % 4, l // 4).
"""

import functools
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .tuning import Tuning

LANES = 16
lanes = wp.types.vector(LANES, wp.float32)
lanes_int = wp.types.vector(LANES, wp.int32)

TYPES = """
typedef float F __attribute__((vector_size(64), aligned(4)));
typedef int I __attribute__((vector_size(64), aligned(4)));
const F X = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
const F Y = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
auto max_ = [](F a, F b) -> F { return a > b ? a : b; };
auto min_ = [](F a, F b) -> F { return a < b ? a : b; };
auto fma_ = [](F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
auto any_ = [](I mask) -> bool { return __builtin_reduce_or(mask) != 0; };
auto all_ = [](I mask) -> bool { return __builtin_reduce_and(mask) != 0; };
// pairwise, in a fixed order
auto total_ = [](F x) -> float {
    float s[16];
    *(F*)s = x;
    for (int w = 8; w > 0; w >>= 1)
        for (int l = 0; l < w; ++l) s[l] += s[l + w];
    return s[0];
};
"""


def _leaf(body: str, result: str = "F") -> str:
    """The snippet that computes ``out``; Warp wants the decorator itself spelled out below."""
    kind = "float" if result == "F" else "int"
    return (
        f"{TYPES} {result} out; {body} wp::vec_t<16, {kind}> packed; *({result}*)&packed = out;"
        "return packed;"
    )


# The least q on the rectangle of a block's pixel centres (README.md §2, the last paragraph), for 16
# blocks at once; the bits of those where it is within the limit become one mask at the end.
_TOUCHED = """
    F x0 = *(const F*)&xs, y0 = *(const F*)&ys, zero = F{};
    x0 = x0 - center_x; y0 = y0 - center_y;
    F x1 = x0 + WIDTH.0f, y1 = y0 + HEIGHT.0f;
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


@functools.cache
def block_leaves(tuning: Tuning) -> SimpleNamespace:
    """The leaves ``first_x, first_y, touched``, whose lanes are the blocks of a tile.

    ``first_x`` and ``first_y`` give the first pixel of each block's sub-tile, from the tile's own.
    ``touched`` sets bit b if the sub-tile of block b may hold a pixel with q <= limit, where
    slope = -a k / (a k² + e). Lanes without a block mean nothing.
    """
    blocks = range(LANES)
    firsts_x = [4 * (b % tuning.columns) // tuning.width * tuning.width for b in blocks]
    firsts_y = [4 * (b // tuning.columns) // tuning.height * tuning.height for b in blocks]
    text = _TOUCHED.replace("WIDTH", str(tuning.width - 1))
    text = text.replace("HEIGHT", str(tuning.height - 1))

    @wp.func_native(_leaf(f"const F first = {{{', '.join(map(str, firsts_x))}}}; out = first + x;"))
    def first_x(x: wp.float32) -> lanes: ...

    @wp.func_native(_leaf(f"const F first = {{{', '.join(map(str, firsts_y))}}}; out = first + y;"))
    def first_y(y: wp.float32) -> lanes: ...

    @wp.func_native(TYPES + text)
    def touched(
        xs: lanes,
        ys: lanes,
        center_x: wp.float32,
        center_y: wp.float32,
        a: wp.float32,
        k: wp.float32,
        e: wp.float32,
        slope: wp.float32,
        limit: wp.float32,
    ) -> wp.int32: ...

    return SimpleNamespace(first_x=first_x, first_y=first_y, touched=touched)


@wp.func
@no_type_check
def blocks_inside(width: wp.int32, height: wp.int32, columns: wp.int32) -> wp.int32:
    """Bit b is set if block b of a tile has a pixel in the picture, of which this much is left."""
    bits = wp.int32(0)
    for b in range(columns * columns):
        if (b % columns) * 4 < width and (b // columns) * 4 < height:
            bits = bits | (1 << b)
    return bits


@wp.func_native("return __builtin_ctz(bits);")
def lowest_bit(bits: wp.int32) -> wp.int32:
    """Index of the lowest set bit; bits != 0."""
    ...


@wp.func_native(TYPES + "return __builtin_reduce_or((I)(*(const F*)&x != 0.0f));")
def any_nonzero(x: lanes) -> wp.int32:
    """Not 0 if some lane is not 0."""
    ...


@wp.func_native("return __builtin_popcount(bits);")
def count_bits(bits: wp.int32) -> wp.int32:
    """Number of set bits."""
    ...


@wp.func_native("""
__builtin_prefetch(means2d.data + g);
__builtin_prefetch(conics.data + g);
__builtin_prefetch(view_opacities.data + g);
__builtin_prefetch(colors.data + (size_t)row * colors.shape[1]);
""")
def fetch(
    means2d: wp.array[wp.vec2],
    conics: wp.array[wp.vec3],
    view_opacities: wp.array[wp.float32],
    colors: wp.array2d[wp.float32],
    g: wp.int32,
    row: wp.int32,
):
    """Prefetches a Gaussian that a later pair needs."""
    ...


@wp.func_native("""
const char* const row = (const char*)(v_pairs.data + (size_t)pair * v_pairs.shape[1]);
__builtin_prefetch(row, 1);
__builtin_prefetch(row + v_pairs.shape[1] * 4 - 1, 1);
__builtin_prefetch(written.data + pair, 1);
""")
def fetch_row(v_pairs: wp.array2d[wp.float32], written: wp.array[wp.uint8], pair: wp.int32):
    """Prefetches the row that a later pair writes: rows are in the order of the Gaussians."""
    ...


@wp.func_native("return __atomic_fetch_add(counter.data, 1, __ATOMIC_RELAXED);")
def take(counter: wp.array[wp.int32]) -> wp.int32:
    """The next number that no other worker has taken."""
    ...


@wp.func_native(_leaf("F A = *(const F*)&a; out = A < 0.0f ? -A : A;"))
def absolute(a: lanes) -> lanes: ...


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
