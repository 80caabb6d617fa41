"""Which tiles a Gaussian's ellipse touches: row by row of tiles, by exact intervals of columns.

README.md §2 proves the test. Counting and writing call the same functions.
"""

from typing import NamedTuple

import warp as wp
from torch import Tensor

from .cpu.tuning import current
from .skip import TILE_TEST

wp.set_module_options({"enable_backward": False})

# Rounding of q, relative and absolute; the test may keep too much, never too little.
SLACK = 1.0 + 1e-4
SLACK_ABS = 1e-4
_SLACK = wp.constant(SLACK)
_SLACK_ABS = wp.constant(SLACK_ABS)
_TILE_TEST = wp.constant(TILE_TEST)


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles."""
    tile = current().tile
    return -(-width // tile), -(-height // tile)


@wp.struct
class Grid:
    """Per launch: the picture and its tiles."""

    num: wp.int32
    width: wp.int32
    height: wp.int32
    tiles_x: wp.int32
    tiles_y: wp.int32
    shift: wp.int32  # a tile has 2^shift pixels in a row
    alpha_min: wp.float32
    skip: wp.int32


def make_grid(num: int, width: int, height: int, alpha_min: float, skip: int) -> Grid:
    """The scalars of a binning launch as one kernel argument."""
    grid = Grid()
    grid.num, grid.width, grid.height = num, width, height
    grid.alpha_min, grid.skip = alpha_min, skip
    grid.tiles_x, grid.tiles_y = tile_grid(width, height)
    grid.shift = current().tile.bit_length() - 1
    return grid


@wp.struct
class Ellipse:
    """q <= limit around a mean, with what the rows of tiles share."""

    mean: wp.vec2
    k: wp.float32
    e: wp.float32
    limit: wp.float32
    over_a: wp.float32
    reach: wp.float32
    top: wp.float32


@wp.func
def to_tile(grid: Grid, x: wp.float32, size: wp.int32) -> wp.int32:
    # clamped before the cast: a footprint may be larger than an int32
    return wp.int32(wp.clamp(x, 0.0, float(size - 1))) >> grid.shift


@wp.func
def tile_rows(grid: Grid, y: wp.float32, extent: wp.float32) -> wp.vec2i:
    # first and last row with a pixel centre (at +0.5) in reach, with a pixel to spare
    top = to_tile(grid, y - extent - 1.0, grid.height)
    return wp.vec2i(top, to_tile(grid, y + extent + 1.0, grid.height))


@wp.func
def q_limit(opacity: wp.float32, alpha_min: wp.float32) -> wp.float32:
    return 2.0 * wp.log(opacity / alpha_min) * _SLACK + _SLACK_ABS


@wp.func
def make_ellipse(mean: wp.vec2, conic: wp.vec3, limit: wp.float32) -> Ellipse:
    a, k, e = conic[0], conic[1], conic[2]
    ellipse = Ellipse()
    ellipse.mean = mean
    ellipse.k = k
    ellipse.e = e
    ellipse.limit = limit
    ellipse.over_a = 1.0 / a
    ellipse.reach = wp.sqrt(limit / e)
    # the ellipse is rightmost at y = top, leftmost at -top
    ellipse.top = -k * a * wp.sqrt(limit / (a * (a * k * k + e) * e))
    return ellipse


@wp.func
def _box_columns(grid: Grid, x: wp.float32, extent: wp.float32) -> wp.vec2i:
    return wp.vec2i(to_tile(grid, x - extent, grid.width), to_tile(grid, x + extent, grid.width))


@wp.func
def tile_columns(grid: Grid, ellipse: Ellipse, extent: wp.vec2, ty: wp.int32) -> wp.vec2i:
    # README eq. 6: columns of row ty that the ellipse touches; first > last: none
    if (grid.skip & _TILE_TEST) == 0:
        return _box_columns(grid, ellipse.mean[0], extent[0])
    # exact numbers first, the mean once: rounding must not turn one row of pixels into none
    y0 = wp.max(float(ty << grid.shift) + 0.5 - ellipse.mean[1], -ellipse.reach)
    end = float(wp.min((ty + 1) << grid.shift, grid.height)) - 0.5
    y1 = wp.min(end - ellipse.mean[1], ellipse.reach)
    if y0 > y1:
        return wp.vec2i(0, -1)
    # convex, so clamping finds the extremes
    right = wp.clamp(ellipse.top, y0, y1)
    left = wp.clamp(-ellipse.top, y0, y1)
    e = ellipse.e
    x1 = wp.sqrt(wp.max(ellipse.limit - e * right * right, 0.0) * ellipse.over_a)
    x0 = wp.sqrt(wp.max(ellipse.limit - e * left * left, 0.0) * ellipse.over_a)
    x1 = ellipse.mean[0] - ellipse.k * right + x1
    x0 = ellipse.mean[0] - ellipse.k * left - x0
    if x1 < 0.5 or x0 > float(grid.width) - 0.5:
        return wp.vec2i(0, -1)
    # a tile spans pixel centres 0.5 to 15.5; a gap between two tiles belongs to neither
    return wp.vec2i(to_tile(grid, x0 + 0.5, grid.width), to_tile(grid, x1 - 0.5, grid.width))


@wp.func
def box_pairs(grid: Grid, mean: wp.vec2, extent: wp.vec2) -> wp.int64:
    # pairs of a Gaussian if tiles were tested against its box alone
    rows = tile_rows(grid, mean[1], extent[1])
    columns = _box_columns(grid, mean[0], extent[0])
    return wp.int64(rows[1] - rows[0] + 1) * wp.int64(columns[1] - columns[0] + 1)


class Bins(NamedTuple):
    """P pairs of I views; everything int32.

    Attributes:
        order: ``[I * N]`` view-major Gaussian indices, front to back within each view.
        offsets: ``[I * N + 1]`` where the pairs of ``order[j]`` begin, in emission order.
        pairs: ``[P]`` view-major Gaussian index of each pair, in tile order.
        rows: ``[P]`` emission number of each pair, in tile order.
        starts: ``[I * tiles + 1]`` where each tile begins in ``pairs``.
        box_pairs: ``[]`` int64, number of pairs if tiles were tested against boxes only.
    """

    order: Tensor
    offsets: Tensor
    pairs: Tensor
    rows: Tensor
    starts: Tensor
    box_pairs: Tensor


@wp.struct
class Frame:
    """Per launch: picture and list sizes."""

    width: wp.int32
    height: wp.int32
    tiles_x: wp.int32
    tiles_y: wp.int32
    views: wp.int32
    num: wp.int32
    colors_per_view: wp.int32
    alpha_min: wp.float32
    alpha_max: wp.float32
    t_min: wp.float32
    skip: wp.int32


@wp.func
def color_row(frame: Frame, g: int) -> int:
    # of view-major Gaussian g; shared colours have one row per object
    row = g
    if frame.colors_per_view == 0:
        row = g // (frame.views * frame.num) * frame.num + g % frame.num
    return row


class Walk(NamedTuple):
    """What forward leaves for backward, by tiles and blocks.

    Attributes:
        transmittances: ``[tiles * 16, 16]`` final T; negative where the pixel stopped early.
        stops: ``[tiles * 16, 16]`` int32, the pair at which the pixel stopped.
        blocks: ``[P]`` int32, one bit per 4 x 4 block to which the pair contributed.
        walked: ``[tiles]`` int32, pairs walked until every pixel had stopped.
        blocks_walked: ``[tiles]`` int64, blocks evaluated in them.
    """

    transmittances: Tensor
    stops: Tensor
    blocks: Tensor
    walked: Tensor
    blocks_walked: Tensor


def make_frame(
    width: int,
    height: int,
    views: int,
    num: int,
    colors_per_view: bool,
    alpha_min: float,
    alpha_max: float,
    t_min: float,
    skip: int,
) -> Frame:
    """The scalars of a composite launch as one kernel argument."""
    frame = Frame()
    frame.width, frame.height = width, height
    frame.tiles_x, frame.tiles_y = tile_grid(width, height)
    frame.views, frame.num, frame.colors_per_view = views, num, int(colors_per_view)
    frame.alpha_min, frame.alpha_max = alpha_min, alpha_max
    frame.t_min, frame.skip = t_min, skip
    return frame
