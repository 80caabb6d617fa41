"""What the CUDA compositor's kernels share: a warp, its pixels, its shared memory, and the test.

A block is one warp and works on one tile of 16 x 16 pixels: eight sub-tiles of 8 x 4, in each of
which a lane owns one pixel. Leaf functions are C++ with a CPU form, for tests on CPU blocks.
CUDA.md has the design.
"""

import functools
from typing import NamedTuple

import warp as wp

from ..constants import TILE
from .frame import Frame, color_row

wp.set_module_options({"enable_backward": False})

WARP = 32
PIXELS = TILE * TILE // WARP  # of a lane, one in each sub-tile
WIDTH, HEIGHT = 8, 4  # pixels of a sub-tile; two of them side by side
RECORD = 12  # floats of a Gaussian in shared memory
PITCH = WARP + 4  # floats of a row of partial sums: aligned, and without bank conflicts
CHUNK = 4  # channels of a launch, at most

vec8 = wp.types.vector(PIXELS, wp.float32)

_TILE = wp.constant(TILE)
_LOG2_E_HALF = wp.constant(0.72134752044)  # exp(-q/2) = 2^(-this q)
# Rounding of q, relative and absolute, and of a position in pixels: the test of a sub-tile may
# keep too much, never too little.
_SLACK = wp.constant(1.0 + 1e-4)
_SLACK_ABS = wp.constant(1e-4)
_SLACK_PIXELS = wp.constant(0.01)


def sub_tile(j: int) -> tuple[int, int]:
    """Where sub-tile j begins in the tile: x, y in pixels."""
    return j % 2 * WIDTH, j // 2 * HEIGHT


def first_block(j: int) -> int:
    """The left one of the two blocks of 4 x 4 pixels that make up sub-tile j."""
    return j // 2 * 4 + j % 2 * 2


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return exp2f(x);
#endif
""")
def exp2(x: wp.float32) -> wp.float32:
    """2^x, to 2 units in the last place."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return 1.0f / x;
#endif
""")
def reciprocal(x: wp.float32) -> wp.float32:
    """1/x of a normal number, to 1 unit in the last place; of 1 exactly 1."""
    ...


# fmaf by name: forward and backward must see the same alpha, so no choice is left to the compiler.
@wp.func_native("return fmaf(k, dy, dx);")
def sheared(k: wp.float32, dx: wp.float32, dy: wp.float32) -> wp.float32:
    """u of README §5."""
    ...


@wp.func_native("return fmaf(a * u, u, fmaf(e * dy, dy, level));")
def exponent(
    a: wp.float32, e: wp.float32, level: wp.float32, u: wp.float32, dy: wp.float32
) -> wp.float32:
    """log2 of alpha; ``a, e`` are the conic's times -log2(e)/2, ``level`` is log2 of opacity."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(x) - 1;
#else
    return __builtin_ctz(x);
#endif
""")
def lowest_bit(x: wp.int32) -> wp.int32:
    """The number of the lowest bit that is set; one must be."""
    ...


_SYNC = """
#if defined(__CUDA_ARCH__)
    __syncwarp();
#else
    WP_TILE_SYNC();
#endif
"""
_GATHER = """
    unsigned* votes = (unsigned*)arena.data.ptr;
    votes[lane] = vote;
    WP_TILE_SYNC();
    unsigned r = 0;
    for (int i = 0; i < 32; ++i) r |= votes[i];
    WP_TILE_SYNC();
    return (int)r;
#endif
"""
_ANY_OF = f"""
#if defined(__CUDA_ARCH__)
    int r;
    asm volatile("redux.sync.or.b32 %0, %1, 0xffffffff;" : "=r"(r) : "r"(x));
    return r;
#else
    const unsigned vote = x;
{_GATHER}"""
_BALLOT = f"""
#if defined(__CUDA_ARCH__)
    return (int)__ballot_sync(0xffffffffu, x != 0);
#else
    const unsigned vote = x != 0 ? 1u << lane : 0u;
{_GATHER}"""
# A tile begins at a multiple of 16 bytes on CUDA, anywhere on the CPU.
_GET4 = f"""
    wp::vec_t<4, float> v;
#if defined(__CUDA_ARCH__)
    const float4 r = *(const float4*)(arena.data.ptr + {WARP} + i);
    v.c[0] = r.x, v.c[1] = r.y, v.c[2] = r.z, v.c[3] = r.w;
#else
    memcpy(&v, arena.data.ptr + {WARP} + i, 16);
#endif
    return v;
"""
_PUT4 = f"""
#if defined(__CUDA_ARCH__)
    float4 r;
    r.x = v.c[0], r.y = v.c[1], r.z = v.c[2], r.w = v.c[3];
    *(float4*)(arena.data.ptr + {WARP} + i) = r;
#else
    memcpy(arena.data.ptr + {WARP} + i, &v, 16);
#endif
"""


class Memory(NamedTuple):
    """A warp's shared memory: ``arena`` is the tile's type, the rest are functions."""

    arena: type
    sync: wp.Function
    any_of: wp.Function  # the or of all lanes' integers
    ballot: wp.Function  # bit l: lane l's integer is not 0
    put: wp.Function
    put_int: wp.Function
    get_int: wp.Function
    put4: wp.Function  # at a multiple of 4
    get4: wp.Function


@functools.cache
def shared_memory(size: int) -> Memory:
    """Access to ``size`` floats, which lie behind 32 words for the CPU's votes."""
    arena_type = wp.tile[float, WARP + size]

    @wp.func_native(_SYNC)
    def sync(): ...

    @wp.func_native(_ANY_OF)
    def any_of(arena: arena_type, lane: wp.int32, x: wp.int32) -> wp.int32: ...

    @wp.func_native(_BALLOT)
    def ballot(arena: arena_type, lane: wp.int32, x: wp.int32) -> wp.int32: ...

    @wp.func_native(f"arena.data.ptr[{WARP} + i] = v;")
    def put(arena: arena_type, i: wp.int32, v: wp.float32): ...

    @wp.func_native(f"memcpy(arena.data.ptr + {WARP} + i, &v, 4);")
    def put_int(arena: arena_type, i: wp.int32, v: wp.int32): ...

    @wp.func_native(f"int v; memcpy(&v, arena.data.ptr + {WARP} + i, 4); return v;")
    def get_int(arena: arena_type, i: wp.int32) -> wp.int32: ...

    @wp.func_native(_PUT4)
    def put4(arena: arena_type, i: wp.int32, v: wp.vec4): ...

    @wp.func_native(_GET4)
    def get4(arena: arena_type, i: wp.int32) -> wp.vec4: ...

    return Memory(arena_type, sync, any_of, ballot, put, put_int, get_int, put4, get4)


@wp.struct
class Place:
    """The tile of a warp and the pixel of a lane in its first sub-tile."""

    image: wp.int32
    px: wp.int32
    py: wp.int32
    corner: wp.vec2  # the centre of the tile's first pixel


@wp.func
def make_place(frame: Frame, tile: wp.int32, lane: wp.int32) -> Place:
    p = Place()
    p.image = tile // (frame.tiles_x * frame.tiles_y)
    x = tile % frame.tiles_x * _TILE
    y = tile // frame.tiles_x % frame.tiles_y * _TILE
    p.px = x + lane % WIDTH
    p.py = y + lane // WIDTH
    p.corner = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    return p


@wp.func
def touched(
    corner: wp.vec2, mean: wp.vec2, conic: wp.vec3, opacity: wp.float32, alpha_min: wp.float32
) -> wp.int32:
    """Bit j: the ellipse alpha >= alpha_min touches sub-tile j. README eq. 6, rows of sub-tiles."""
    a, k, e = conic[0], conic[1], conic[2]
    limit = 2.0 * wp.log(opacity / alpha_min) * _SLACK + _SLACK_ABS
    reach = wp.sqrt(limit / e)
    over_a = 1.0 / a
    top = -k * a * wp.sqrt(limit / (a * (a * k * k + e) * e))
    x = corner[0] - mean[0]
    y = corner[1] - mean[1]
    bits = wp.int32(0)
    for row in range(TILE // HEIGHT):
        y0 = wp.max(y + float(row * HEIGHT), -reach)
        y1 = wp.min(y + float(row * HEIGHT + HEIGHT - 1), reach)
        if y0 <= y1:
            right = wp.clamp(top, y0, y1)
            left = wp.clamp(-top, y0, y1)
            x1 = wp.sqrt(wp.max(limit - e * right * right, 0.0) * over_a) - k * right
            x0 = -wp.sqrt(wp.max(limit - e * left * left, 0.0) * over_a) - k * left
            for column in range(TILE // WIDTH):
                begin = x + float(column * WIDTH)
                if x1 + _SLACK_PIXELS >= begin and x0 - _SLACK_PIXELS <= begin + float(WIDTH - 1):
                    bits |= 1 << (row * 2 + column)
    return bits


@functools.cache
def staging(channels: int, size: int):
    """The function that puts a lane's Gaussian into its record.

    A record holds mean x, y, -a log2(e)/2, k; -e log2(e)/2, log2 of opacity, two integers; colours.
    """
    arena_type, _, _, _, put, put_int, _, put4, _ = shared_memory(size)

    @wp.func
    def stage(
        arena: arena_type, frame: Frame, at: wp.int32, first: wp.int32, g: wp.int32,
        mean: wp.vec2, conic: wp.vec3, opacity: wp.float32, colors: wp.array2d[wp.float32],
        word: wp.int32, row: wp.int32,
    ):  # fmt: skip
        put4(arena, at, wp.vec4(mean[0], mean[1], -_LOG2_E_HALF * conic[0], conic[1]))
        put(arena, at + 4, -_LOG2_E_HALF * conic[2])
        put(arena, at + 5, wp.log2(opacity))
        put_int(arena, at + 6, word)
        put_int(arena, at + 7, row)
        source = color_row(frame, g)
        for c in range(wp.static(channels)):
            put(arena, at + 8 + c, colors[source, first + c])

    return stage
