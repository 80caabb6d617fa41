"""The ellipse of a Gaussian and the tiles that it touches: an exact interval of columns a row.

README.md §2 proves the test. On CUDA roots, reciprocals and logarithms are off by about 2^-22,
which the slack of the limit covers.
"""

from typing import no_type_check

import warp as wp

from ...runtime.views import struct
from ..skip import SQUARES, TILE_TEST
from ..tiles import SLACK, SLACK_ABS, Grid
from . import leaves as L

wp.set_module_options({"enable_backward": False})

_TWICE_LN2 = 1.3862943611198906
# From the end of an ellipse to the last pixel centre in it, with a quarter of a pixel to spare.
_TO_CENTER = 0.25


@struct
class Ellipse:
    """The set q <= limit around a mean, with values that the rows of tiles share."""

    mean: wp.vec2
    k: wp.float32
    e: wp.float32
    limit: wp.float32
    over_a: wp.float32
    reach: wp.float32
    top: wp.float32
    box: wp.vec2  # half sides, where tiles are tested against boxes or README eq. 16's squares


@wp.func
@no_type_check
def make_ellipse(
    mean: wp.vec2, conic: wp.vec3, opacity: wp.float32, alpha_min: wp.float32
) -> Ellipse:
    a, k, e = conic[0], conic[1], conic[2]
    ellipse = Ellipse()
    ellipse.mean = mean
    ellipse.k = k
    ellipse.e = e
    level = L.log2(opacity * L.reciprocal(alpha_min))
    ellipse.limit = _TWICE_LN2 * level * SLACK + SLACK_ABS
    ellipse.over_a = L.reciprocal(a)
    ellipse.reach = L.root(ellipse.limit * L.reciprocal(e))
    # it is rightmost at y = top = -k a sqrt(limit / (a e (a k² + e))), leftmost at -top
    slope = L.root(ellipse.over_a * L.reciprocal(a * k * k + e))
    ellipse.top = -k * a * ellipse.reach * slope
    return ellipse


@wp.func
@no_type_check
def _to_tile(grid: Grid, x: wp.float32, size: wp.int32) -> wp.int32:
    # clamped before the cast: a footprint may be larger than an int32
    return wp.int32(wp.clamp(x, 0.0, float(size - 1))) >> grid.shift


@wp.func
@no_type_check
def _box_rows(grid: Grid, y: wp.float32, extent: wp.float32) -> wp.vec2i:
    # first and last row with a pixel centre (at +0.5) in the box, with a pixel to spare
    top = _to_tile(grid, y - extent - 1.0, grid.height)
    return wp.vec2i(top, _to_tile(grid, y + extent + 1.0, grid.height))


@wp.func
@no_type_check
def _box_columns(grid: Grid, x: wp.float32, extent: wp.float32) -> wp.vec2i:
    return wp.vec2i(_to_tile(grid, x - extent, grid.width), _to_tile(grid, x + extent, grid.width))


@wp.func
@no_type_check
def _in_square(
    grid: Grid, tiles: wp.vec2i, x: wp.float32, radius: wp.float32, size: wp.int32
) -> wp.vec2i:
    # first and last tile, cut to README eq. 16's square; last is first - 1 at the least
    if (grid.skip & SQUARES) == 0:
        return tiles
    first = wp.max(tiles[0], _to_tile(grid, x - radius - 0.5, size))
    last = wp.min(tiles[1], _to_tile(grid, x + radius - 1.5, size))
    return wp.vec2i(first, wp.max(last, first - 1))


@wp.func
@no_type_check
def tile_rows(grid: Grid, ellipse: Ellipse) -> wp.vec2i:
    # first and last row that may have columns; first > last: none
    if (grid.skip & TILE_TEST) == 0:
        return _box_rows(grid, ellipse.mean[1], ellipse.box[1])
    y, reach = ellipse.mean[1], ellipse.reach
    top = _to_tile(grid, y - reach + _TO_CENTER, grid.height)
    rows = wp.vec2i(top, _to_tile(grid, y + reach - _TO_CENTER, grid.height))
    return _in_square(grid, rows, y, ellipse.box[1], grid.height)


@wp.func
@no_type_check
def tile_columns(grid: Grid, ellipse: Ellipse, ty: wp.int32) -> wp.vec2i:
    # README eq. 6: columns of row ty that the ellipse touches; first > last: none
    if (grid.skip & TILE_TEST) == 0:
        return _box_columns(grid, ellipse.mean[0], ellipse.box[0])
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
    x1 = L.root(wp.max(ellipse.limit - e * right * right, 0.0) * ellipse.over_a)
    x0 = L.root(wp.max(ellipse.limit - e * left * left, 0.0) * ellipse.over_a)
    x1 = ellipse.mean[0] - ellipse.k * right + x1
    x0 = ellipse.mean[0] - ellipse.k * left - x0
    if x1 < 0.5 or x0 > float(grid.width) - 0.5:
        return wp.vec2i(0, -1)
    # a tile spans pixel centres 0.5 to 15.5; a gap between two tiles belongs to neither
    first = _to_tile(grid, x0 + 0.5, grid.width)
    columns = wp.vec2i(first, _to_tile(grid, x1 - 0.5, grid.width))
    return _in_square(grid, columns, ellipse.mean[0], ellipse.box[0], grid.width)
