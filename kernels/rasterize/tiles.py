"""Tiles: how an image is cut into them, their lists, and the scalars of launches.

In this order: ``Tiling``, the cut; ``Bins`` and ``Saved``, the results of binning and compositing
for later steps; ``Splats2D``, the Gaussians to composite; ``Grid`` and ``Image``, the scalars
that the launches of these two steps take.
"""

from typing import Annotated, Any, NamedTuple

import warp as wp

from ..runtime.views import filled, struct
from .constants import TILE

# Rounding of q, relative and absolute; the test may keep too much, never too little.
SLACK, SLACK_ABS = 1.0 + 1e-4, 1e-4


class Tiling(NamedTuple):
    """Grid of square tiles over an image, ``TILE`` pixels a side.

    Attributes:
        width: of the image, pixels.
        height: of the image, pixels.
    """

    width: int
    height: int

    @property
    def tiles_x(self) -> int:
        """Tiles in a row; the last one may reach beyond the image."""
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        """Rows of tiles."""
        return -(-self.height // TILE)

    @property
    def count(self) -> int:
        """Tiles of one image."""
        return self.tiles_x * self.tiles_y


class Bins(NamedTuple):
    """The lists of tiles: P pairs of (tile, Gaussian) in I views; int32 unless stated.

    In a CUDA graph the lists may be longer: ``count`` says how many pairs there are, and entries
    behind them belong to no tile. If they are more than P, all lists are empty and images NaN.

    Attributes:
        order: ``[I * N]`` view-major Gaussian indices in the order in which pairs are numbered:
            front to back within each view, or by index where views have many Gaussians on a CPU.
        offsets: ``[I * N + 1]`` where the pairs of ``order[j]`` begin, in emission order.
        pairs: ``[P]`` view-major Gaussian index of each pair, in tile order.
        rows: ``[P]`` emission number of each pair, in tile order.
        starts: ``[I * tiles + 1]`` where each tile begins in ``pairs``.
        count: ``[]`` int64, number of pairs.
    """

    order: Annotated[Any, wp.array[wp.int32]] = None
    offsets: Annotated[Any, wp.array[wp.int32]] = None
    pairs: Annotated[Any, wp.array[wp.int32]] = None
    rows: Annotated[Any, wp.array[wp.int32]] = None
    starts: Annotated[Any, wp.array[wp.int32]] = None
    count: Annotated[Any, wp.array[wp.int64]] = None


class Saved(NamedTuple):
    """Values that the compositor saves for its gradient, by tiles and by blocks of 4 x 4 pixels.

    Attributes:
        transmittances: ``[blocks, 16]`` final T; negative where the pixel stopped early.
        stops: ``[blocks, 16]`` int32, the pair at which the pixel stopped.
        blocks: ``[P]`` int32, one bit for each block of the tile to which the pair contributed.
        traversed: ``[tiles]`` int32, pairs until every pixel had stopped.
        blocks_traversed: ``[tiles]`` int64, blocks evaluated for these pairs.
        records: ``[I * N, record_size(C)]``, what CUDA reads of a Gaussian; empty on a CPU.
    """

    transmittances: Annotated[Any, wp.array2d[wp.float32]]
    stops: Annotated[Any, wp.array2d[wp.int32]]
    blocks: Annotated[Any, wp.array[wp.int32]]
    traversed: Annotated[Any, wp.array[wp.int32]]
    blocks_traversed: Annotated[Any, wp.array[wp.int64]]
    records: Annotated[Any, wp.array2d[wp.float32]]


CHUNK = 4  # channels that a launch on CUDA has at most
MAX_PAIRS = 2**31 - 1  # pairs are numbered in int32


def record_size(channels: int) -> int:
    """Floats of a Gaussian's record: its geometry, and the channels in whole chunks."""
    return 8 + -(-channels // CHUNK) * CHUNK


@struct
class Pixels:
    """The images, or the gradient that comes from them; by pixels of all of them."""

    renders: wp.array2d[wp.float32]
    transmittances: wp.array2d[wp.float32]  # the final ones


class Splats2D(NamedTuple):
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
    """The scalars of a binning launch: the image and its tiles."""

    num: int
    width: int
    height: int
    tiles_x: int
    tiles_y: int
    shift: int  # a tile has 2^shift pixels in a row
    alpha_min: float
    skip: int


def make_grid(tiling: Tiling, *, num: int, alpha_min: float, skip: int) -> Grid:
    """The scalars of a binning launch as one kernel argument, which is shared: do not modify it.

    Args:
        tiling: the cut of each view's image.
        num: Gaussians of a view.
        alpha_min: fainter contributions are not drawn.
        skip: from ``Skip.bits``.
    """
    sizes = tiling.width, tiling.height, tiling.tiles_x, tiling.tiles_y, TILE.bit_length() - 1
    return filled(Grid, num, *sizes, alpha_min, skip)


class Size(NamedTuple):
    """Sizes that a call of the compositor is given.

    Attributes:
        width: of an image, pixels.
        height: of an image, pixels.
        views: of an object.
        colors_per_view: True if each view has its own colours, not those of its object.
        skip: from ``Skip.bits``.
    """

    width: int
    height: int
    views: int
    colors_per_view: bool
    skip: int


class Limits(NamedTuple):
    """The thresholds that a call of the compositor is given, as ``rasterization`` has them.

    Attributes:
        alpha_min: as ``rasterization``.
        alpha_max: as ``rasterization``.
        t_min: as ``rasterization``.
        straight_through: True for a gradient that passes the clamp at ``alpha_max`` (README.md §7).
    """

    alpha_min: float
    alpha_max: float
    t_min: float
    straight_through: bool = False


@struct
class RasterParams:
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


def raster_params(size: Size, limits: Limits, *, num: int) -> RasterParams:
    """The scalars of a compositing launch as one kernel argument; do not modify it either.

    Args:
        size: the sizes.
        limits: the thresholds.
        num: Gaussians of a view.
    """
    tiling = Tiling(size.width, size.height)
    sizes = *tiling, tiling.tiles_x, tiling.tiles_y, size.views, num, size.colors_per_view
    return filled(RasterParams, *sizes, *limits[:3], size.skip)
