"""Common parts of the CUDA compositor's gradient: a warp, its pixels, and shared memory.

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
from ..tiles import RasterParams

wp.set_module_options({"enable_backward": False})

WARP = 32
WIDTH, HEIGHT = 8, 4  # pixels of a sub-tile; two of them side by side
SUB_TILES = 8  # in a tile
STOP = 16  # bit STOP + j of a pair: a pixel of sub-tile j stopped at it; below are 4 x 4 blocks
RECORD = 12  # floats of a Gaussian in shared memory, as of one in ``records.py``
PITCH = WARP + 4  # floats of a row of partial sums: aligned, and without bank conflicts

# An integer that branches change in place; Warp would keep a copy of a plain one for each branch.
word = wp.types.vector(1, wp.int32)


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


@wp.func_native("__syncthreads();")
def sync_block(): ...


@wp.func_native(_ANY_OF)
def any_of(x: wp.int32) -> wp.int32:
    """The or of all lanes' integers."""
    ...


@wp.func_native("return (int)__ballot_sync(0xffffffffu, x != 0);")
def ballot(x: wp.int32) -> wp.int32:
    """Bit l: lane l's integer is not 0."""
    ...


def kernel_options(warps: int, block: int = 1) -> dict[str, Any]:
    """Options of a kernel of ``block`` warps a block, ``warps`` of which share a multiprocessor."""
    bounds = WARP * block, warps // block
    return {"module": "unique", "launch_bounds": bounds, "grid_stride": False}


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
class LanePixels:
    """Tile and pixels of a warp and a lane."""

    index: wp.int32  # of the warp's part among all tiles' parts
    lane: wp.int32
    image: wp.int32
    tile: wp.int32
    part: wp.int32  # which part of the tile
    px: wp.int32  # the lane's pixel in the first sub-tile
    py: wp.int32
    pixel: wp.int64  # its number in all images
    walk_row: wp.int64  # its number by tiles and sub-tiles; the next sub-tiles' are WARP apart
    x: wp.vec2  # centres of the lane's pixels, by columns of sub-tiles
    y: wp.vec4  # by rows of sub-tiles


@functools.cache
def pixels_of_lane(parts: int):
    """The function that finds a lane's ``LanePixels``, with tiles cut into that many parts."""
    pixels = SUB_TILES // parts

    @wp.func
    @no_type_check
    def lane_pixels(params: RasterParams, index: wp.int32, lane: wp.int32) -> LanePixels:
        p = LanePixels()
        p.index = index
        p.lane = lane
        p.tile = index // wp.static(parts)
        p.part = index % wp.static(parts)
        p.image = p.tile // (params.tiles_x * params.tiles_y)
        x = p.tile % params.tiles_x * TILE
        y = p.tile // params.tiles_x % params.tiles_y * TILE + p.part * wp.static(TILE // parts)
        p.px = x + lane % WIDTH
        p.py = y + lane // WIDTH
        line = p.image * params.height + p.py  # row among all images
        p.pixel = wp.int64(line) * wp.int64(params.width) + wp.int64(p.px)
        p.walk_row = wp.int64(index) * wp.int64(wp.static(pixels * WARP)) + wp.int64(lane)
        for i in range(2):
            p.x[i] = float(p.px + i * WIDTH) + 0.5
        for i in range(wp.static(pixels // 2)):
            p.y[i] = float(p.py + i * HEIGHT) + 0.5
        return p

    return lane_pixels


@functools.cache
def staging(size: int):
    """The function that copies a record to shared memory, with bits in the place of ``limit``."""
    memory = shared_memory(size)

    @wp.func
    @no_type_check
    def stage(
        arena: memory.arena,
        at: wp.int32,
        shape: wp.vec4,
        level: wp.vec4,
        color: wp.vec4,
        bits: wp.int32,
    ):
        level[2] = wp.cast(bits, wp.float32)
        memory.put4(arena, at, shape)
        memory.put4(arena, at + 4, level)
        memory.put4(arena, at + 8, color)

    return stage
