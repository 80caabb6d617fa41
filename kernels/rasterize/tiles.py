"""Tiles: how a picture is cut into them, their lists, and which of them an ellipse touches.

In this order: ``Tiling``, the cut; ``Bins`` and ``Walk``, the results of binning and compositing
for later steps; ``Drawn``, the Gaussians to composite; ``Grid`` and ``Picture``, the scalars that
the launches of these two steps take; the test of an ellipse, row by row of tiles, by exact
intervals of columns. README.md §2 proves the test. Counting and writing call the same functions.
"""

from typing import Annotated, Any, NamedTuple, no_type_check

import warp as wp

from ..runtime.views import filled, struct
from .constants import TILE
from .skip import TILE_TEST

wp.set_module_options({"enable_backward": False})

# Rounding of q, relative and absolute; the test may keep too much, never too little.
SLACK, SLACK_ABS = 1.0 + 1e-4, 1e-4


class Tiling(NamedTuple):
    """Grid of square tiles over a picture, ``TILE`` pixels a side.

    Attributes:
        width: of the picture, pixels.
        height: of the picture, pixels.
    """

    width: int
    height: int

    @property
    def tiles_x(self) -> int:
        """Tiles in a row; the last one may reach beyond the picture."""
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        """Rows of tiles."""
        return -(-self.height // TILE)

    @property
    def count(self) -> int:
        """Tiles of one picture."""
        return self.tiles_x * self.tiles_y


class Bins(NamedTuple):
    """The lists of tiles: P pairs of (tile, Gaussian) in I views; int32 unless it is said.

    On CUDA the lists may be longer: ``count`` says how many pairs there are, and entries behind
    them belong to no tile. If they are more than P, all lists are empty, and pictures are made of
    ``order``, in which only Gaussians count that have pairs by ``offsets``. Then P >= I * N.

    Attributes:
        order: ``[I * N]`` view-major Gaussian indices in the order in which pairs are numbered:
            front to back within each view, or by index where views have many Gaussians on a CPU.
        offsets: ``[I * N + 1]`` where the pairs of ``order[j]`` begin, in emission order.
        pairs: ``[P]`` view-major Gaussian index of each pair, in tile order.
        rows: ``[P]`` emission number of each pair, in tile order.
        starts: ``[I * tiles + 1]`` where each tile begins in ``pairs``.
        box_pairs: ``[]`` int64, number of pairs if tiles were tested against boxes only.
        count: ``[]`` int64, number of pairs.
    """

    order: Annotated[Any, wp.array[wp.int32]] = None
    offsets: Annotated[Any, wp.array[wp.int32]] = None
    pairs: Annotated[Any, wp.array[wp.int32]] = None
    rows: Annotated[Any, wp.array[wp.int32]] = None
    starts: Annotated[Any, wp.array[wp.int32]] = None
    box_pairs: Annotated[Any, wp.array[wp.int64]] = None
    count: Annotated[Any, wp.array[wp.int64]] = None


class Walk(NamedTuple):
    """Values that the compositor saves for its gradient, by tiles and by blocks of 4 x 4 pixels.

    Attributes:
        transmittances: ``[blocks, 16]`` final T; negative where the pixel stopped early.
        stops: ``[blocks, 16]`` int32, the pair at which the pixel stopped.
        blocks: ``[P]`` int32, one bit for each block of the tile to which the pair contributed.
        walked: ``[tiles]`` int32, pairs walked until every pixel had stopped; on CUDA, where the
            lists were too short, with a minus, and of all Gaussians of the view.
        blocks_walked: ``[tiles]`` int64, blocks evaluated for these pairs.
        records: ``[I * N, record_size(C)]``, what CUDA reads of a Gaussian; empty on a CPU.
    """

    transmittances: Annotated[Any, wp.array2d[wp.float32]]
    stops: Annotated[Any, wp.array2d[wp.int32]]
    blocks: Annotated[Any, wp.array[wp.int32]]
    walked: Annotated[Any, wp.array[wp.int32]]
    blocks_walked: Annotated[Any, wp.array[wp.int64]]
    records: Annotated[Any, wp.array2d[wp.float32]]


CHUNK = 4  # channels that a launch on CUDA has at most


def record_size(channels: int) -> int:
    """Floats of a Gaussian's record: its geometry, and the channels in whole chunks."""
    return 8 + -(-channels // CHUNK) * CHUNK


@struct
class Pixels:
    """The pictures, or the gradient that comes from them; by pixels of all of them."""

    renders: wp.array2d[wp.float32]
    alphas: wp.array2d[wp.float32]


class Drawn(NamedTuple):
    """Gaussians to composite, or their gradients: of each (view, Gaussian), the sum over its pairs.

    Attributes:
        means2d: ``[I, N, 2]``; a gradient is None if colours alone are asked for, so are the next.
        conics: ``[I, N, 3]``.
        view_opacities: ``[I, N]``.
        colors: ``[rows, C]``, rows = B * N, or I * N if each view has its own; their gradient is
            ``[I, N, C]``.
    """

    means2d: Annotated[Any, wp.array[wp.vec2]] = None
    conics: Annotated[Any, wp.array[wp.vec3]] = None
    view_opacities: Annotated[Any, wp.array[wp.float32]] = None
    colors: Annotated[Any, wp.array2d[wp.float32]] = None


@struct
class Grid:
    """The scalars of a binning launch: the picture and its tiles."""

    num: int
    width: int
    height: int
    tiles_x: int
    tiles_y: int
    shift: int  # a tile has 2^shift pixels in a row
    alpha_min: float
    skip: int


def make_grid(tiling: Tiling, *, num: int, alpha_min: float, skip: int) -> Grid:
    """The scalars of a binning launch as one kernel argument, which is shared: not to be changed.

    Args:
        tiling: the cut of each view's picture.
        num: Gaussians of a view.
        alpha_min: fainter contributions are not drawn.
        skip: from ``Skip.bits``.
    """
    sizes = tiling.width, tiling.height, tiling.tiles_x, tiling.tiles_y, TILE.bit_length() - 1
    return filled(Grid, num, *sizes, alpha_min, skip)


class Size(NamedTuple):
    """The integers that a call of the compositor is given.

    Attributes:
        width: of a picture, pixels.
        height: of a picture, pixels.
        views: of an object.
        colors_per_view: 1 if each view has colours of its own, 0 if an object's views share them.
        skip: from ``Skip.bits``.
    """

    width: int
    height: int
    views: int
    colors_per_view: int
    skip: int


class Limits(NamedTuple):
    """The thresholds that a call of the compositor is given, as ``rasterization`` has them."""

    alpha_min: float
    alpha_max: float
    t_min: float


@struct
class Picture:
    """The scalars of a compositing launch: sizes, thresholds and switches."""

    width: int
    height: int
    tiles_x: int
    tiles_y: int
    views: int
    num: int
    colors_per_view: int
    alpha_min: float
    alpha_max: float
    t_min: float
    skip: int


def make_picture(size: Size, limits: Limits, *, num: int) -> Picture:
    """The scalars of a compositing launch as one kernel argument, not to be changed either.

    Args:
        size: the integers.
        limits: the thresholds.
        num: Gaussians of a view.
    """
    tiling = Tiling(size.width, size.height)
    sizes = *tiling, tiling.tiles_x, tiling.tiles_y, size.views, num, size.colors_per_view
    return filled(Picture, *sizes, *limits, size.skip)


@wp.func
def color_row(picture: Picture, g: int) -> int:
    # the row of view-major Gaussian g; shared colours have one row for each object's Gaussian
    row = g
    if picture.colors_per_view == 0:
        row = g // (picture.views * picture.num) * picture.num + g % picture.num
    return row


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


@wp.func
@no_type_check
def to_tile(grid: Grid, x: wp.float32, size: wp.int32) -> wp.int32:
    # clamped before the cast: a footprint may be larger than an int32
    return wp.int32(wp.clamp(x, 0.0, float(size - 1))) >> grid.shift


@wp.func
@no_type_check
def tile_rows(grid: Grid, y: wp.float32, extent: wp.float32) -> wp.vec2i:
    # first and last row with a pixel centre (at +0.5) in reach, with a pixel to spare
    top = to_tile(grid, y - extent - 1.0, grid.height)
    return wp.vec2i(top, to_tile(grid, y + extent + 1.0, grid.height))


@wp.func
@no_type_check
def q_limit(opacity: wp.float32, alpha_min: wp.float32) -> wp.float32:
    return 2.0 * wp.log(opacity / alpha_min) * SLACK + SLACK_ABS


@wp.func
@no_type_check
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
@no_type_check
def _box_columns(grid: Grid, x: wp.float32, extent: wp.float32) -> wp.vec2i:
    return wp.vec2i(to_tile(grid, x - extent, grid.width), to_tile(grid, x + extent, grid.width))


@wp.func
@no_type_check
def tile_columns(grid: Grid, ellipse: Ellipse, extent: wp.vec2, ty: wp.int32) -> wp.vec2i:
    # README eq. 6: columns of row ty that the ellipse touches; first > last: none
    if (grid.skip & TILE_TEST) == 0:
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
@no_type_check
def box_pairs(grid: Grid, mean: wp.vec2, extent: wp.vec2) -> wp.int64:
    # pairs of a Gaussian if tiles were tested against its box alone
    rows = tile_rows(grid, mean[1], extent[1])
    columns = _box_columns(grid, mean[0], extent[0])
    return wp.int64(rows[1] - rows[0] + 1) * wp.int64(columns[1] - columns[0] + 1)
