"""Common parts of the CUDA compositor's kernels: a warp, its pixels, shared memory, and the test.

A tile of 16 x 16 pixels is eight sub-tiles of 8 x 4. A block is one warp and works on a tile, or on
a half or a quarter of it: on 8, 4 or 2 sub-tiles, in each of which a lane owns one pixel. CUDA.md
has the design.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, no_type_check

import warp as wp

from ...runtime.views import struct
from ..constants import TILE
from ..tiles import Picture, color_row, q_limit
from . import leaves as L

wp.set_module_options({"enable_backward": False})

WARP = 32
WIDTH, HEIGHT = 8, 4  # pixels of a sub-tile; two of them side by side
SUB_TILES = 8  # in a tile
STOP = 16  # bit STOP + j of a pair: a pixel of sub-tile j stopped at it; below are 4 x 4 blocks
RECORD = 12  # floats of a Gaussian in shared memory
PITCH = WARP + 4  # floats of a row of partial sums: aligned, and without bank conflicts
CHUNK = 4  # a launch has at most so many channels

# An integer that branches change in place; Warp would keep a copy of a plain one for each branch.
word = wp.types.vector(1, wp.int32)

LOG2_E_HALF = 0.72134752044  # exp(-q/2) = 2^(-this q)
# The rounding of a position: the test of a sub-tile may keep too much, never too little.
_SLACK_PIXELS = 0.01


def first_block(j: int) -> int:
    """The left one of the two blocks of 4 x 4 pixels that make up sub-tile j."""
    return j // 2 * 4 + j % 2 * 2


_ANY_OF = """
#if __CUDA_ARCH__ < 800
    for (int i = 16; i > 0; i /= 2) x |= __shfl_xor_sync(0xffffffffu, x, i);
    return x;
#else
    int r;
    asm volatile("redux.sync.or.b32 %0, %1, 0xffffffff;" : "=r"(r) : "r"(x));
    return r;
#endif
"""
_GET4 = """
    wp::vec_t<4, float> v;
    const float4 r = *(const float4*)(arena.data.ptr + i);
    v.c[0] = r.x, v.c[1] = r.y, v.c[2] = r.z, v.c[3] = r.w;
    return v;
"""
_PUT4 = """
    float4 r;
    r.x = v.c[0], r.y = v.c[1], r.z = v.c[2], r.w = v.c[3];
    *(float4*)(arena.data.ptr + i) = r;
"""


@wp.func_native("__syncwarp();")
def sync(): ...


@wp.func_native(_ANY_OF)
def any_of(x: wp.int32) -> wp.int32:
    """The or of all lanes' integers."""
    ...


@wp.func_native("return (int)__ballot_sync(0xffffffffu, x != 0);")
def ballot(x: wp.int32) -> wp.int32:
    """Bit l: lane l's integer is not 0."""
    ...


def kernel_options(warps: int) -> dict[str, Any]:
    """Options of a kernel whose blocks are warps, so many of which share a multiprocessor."""
    return {"module": "unique", "launch_bounds": (WARP, warps), "grid_stride": False}


class Memory(NamedTuple):
    """A warp's shared memory: ``arena`` is the tile's type, the rest are functions."""

    arena: object
    put: Callable
    put_int: Callable
    get_int: Callable
    put4: Callable  # at a multiple of 4
    get4: Callable


@functools.cache
def shared_memory(size: int) -> Memory:
    """Access to ``size`` floats."""
    # Its stub has the function of that name only.
    arena_type = wp.tile[float, size]  # pyright: ignore[reportIndexIssue]

    @wp.func_native("arena.data.ptr[i] = v;")
    def put(arena: arena_type, i: wp.int32, v: wp.float32): ...

    @wp.func_native("memcpy(arena.data.ptr + i, &v, 4);")
    def put_int(arena: arena_type, i: wp.int32, v: wp.int32): ...

    @wp.func_native("int v; memcpy(&v, arena.data.ptr + i, 4); return v;")
    def get_int(arena: arena_type, i: wp.int32) -> wp.int32: ...

    @wp.func_native(_PUT4)
    def put4(arena: arena_type, i: wp.int32, v: wp.vec4): ...

    @wp.func_native(_GET4)
    def get4(arena: arena_type, i: wp.int32) -> wp.vec4: ...

    return Memory(arena_type, put, put_int, get_int, put4, get4)


@struct
class Place:
    """Tile and pixels of a warp and a lane."""

    index: wp.int32  # of the warp's part among those of all tiles
    lane: wp.int32
    image: wp.int32
    tile: wp.int32
    part: wp.int32  # which part of the tile
    px: wp.int32  # the lane's pixel in the first sub-tile
    py: wp.int32
    pixel: wp.int64  # its number in all pictures
    place: wp.int64  # its number by tiles and sub-tiles; those of the next ones are WARP apart
    x: wp.vec2  # centres of the lane's pixels, by columns of sub-tiles
    y: wp.vec4  # by rows of sub-tiles
    corner: wp.vec2  # the centre of the part's first pixel


@functools.cache
def placing(parts: int):
    """The function that finds a lane's place, with tiles cut into so many parts."""
    pixels = SUB_TILES // parts

    @wp.func
    @no_type_check
    def place(picture: Picture, index: wp.int32, lane: wp.int32) -> Place:
        p = Place()
        p.index = index
        p.lane = lane
        p.tile = index // wp.static(parts)
        p.part = index % wp.static(parts)
        p.image = p.tile // (picture.tiles_x * picture.tiles_y)
        x = p.tile % picture.tiles_x * TILE
        y = p.tile // picture.tiles_x % picture.tiles_y * TILE + p.part * wp.static(TILE // parts)
        p.px = x + lane % WIDTH
        p.py = y + lane // WIDTH
        line = p.image * picture.height + p.py  # among those of all pictures
        p.pixel = wp.int64(line) * wp.int64(picture.width) + wp.int64(p.px)
        p.place = wp.int64(index) * wp.int64(wp.static(pixels * WARP)) + wp.int64(lane)
        for i in range(2):
            p.x[i] = float(p.px + i * WIDTH) + 0.5
        for i in range(wp.static(pixels // 2)):
            p.y[i] = float(p.py + i * HEIGHT) + 0.5
        p.corner = wp.vec2(float(x) + 0.5, float(y) + 0.5)
        return p

    return place


@functools.cache
def touching(parts: int):
    """The test of a Gaussian against the sub-tiles of a part of a tile (README eq. 6)."""

    @wp.func
    @no_type_check
    def touched(
        corner: wp.vec2, mean: wp.vec2, conic: wp.vec3, opacity: wp.float32, alpha_min: wp.float32
    ) -> wp.int32:
        # bit j: the ellipse alpha >= alpha_min touches sub-tile j
        a, k, e = conic[0], conic[1], conic[2]
        limit = q_limit(opacity, alpha_min)
        reach = L.root(limit * L.reciprocal(e))
        over_a = L.reciprocal(a)
        # top = -k a sqrt(limit / (a e (a k² + e)))
        top = -k * a * reach * L.root(over_a * L.reciprocal(a * k * k + e))
        x = corner[0] - mean[0]
        y = corner[1] - mean[1]
        bits = word()
        for row in range(wp.static(SUB_TILES // parts // 2)):
            y0 = wp.max(y + float(row * HEIGHT), -reach)
            y1 = wp.min(y + float(row * HEIGHT + HEIGHT - 1), reach)
            if y0 <= y1:
                right = wp.clamp(top, y0, y1)
                left = wp.clamp(-top, y0, y1)
                x1 = L.root(wp.max(limit - e * right * right, 0.0) * over_a) - k * right
                x0 = -L.root(wp.max(limit - e * left * left, 0.0) * over_a) - k * left
                x1 += _SLACK_PIXELS - x
                x0 -= _SLACK_PIXELS + x
                for column in range(2):
                    if x1 >= float(column * WIDTH) and x0 <= float(column * WIDTH + WIDTH - 1):
                        bits[0] += wp.static(1) << (row * 2 + column)
        return bits[0]

    return touched


@struct
class Gaussians:
    """Gaussians to composite; dense arrays in view-major order."""

    means2d: wp.array[wp.vec2]
    conics: wp.array[wp.vec3]
    opacities: wp.array[wp.float32]
    colors: wp.array2d[wp.float32]
    channels: int  # how many ``colors`` has
    first: int  # the first channel of this launch


@functools.cache
def staging(channels: int, size: int):
    """The function that puts a lane's Gaussian into its record.

    A record holds mean x, y, -a log2(e)/2, k; -e log2(e)/2, log2 of opacity, two integers; colours.
    """
    memory = shared_memory(size)
    arena_type = memory.arena

    @wp.func
    @no_type_check
    def stage(
        arena: arena_type,
        picture: Picture,
        gaussians: Gaussians,
        lane: wp.int32,
        g: wp.int32,
        bits: wp.int32,
        row: wp.int32,
    ):
        at = lane * RECORD
        mean = L.load2(gaussians.means2d, g)
        conic = L.load3(gaussians.conics, g)
        memory.put4(arena, at, wp.vec4(mean[0], mean[1], -LOG2_E_HALF * conic[0], conic[1]))
        memory.put(arena, at + 4, -LOG2_E_HALF * conic[2])
        memory.put(arena, at + 5, wp.log2(L.load1(gaussians.opacities, g)))
        memory.put_int(arena, at + 6, bits)
        memory.put_int(arena, at + 7, row)
        source = wp.int64(color_row(picture, g)) * wp.int64(gaussians.channels)
        for c in range(wp.static(channels)):
            memory.put(arena, at + 8 + c, L.load(gaussians.colors, source, gaussians.first + c))

    return stage
