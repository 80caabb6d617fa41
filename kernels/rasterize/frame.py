"""What the compositors of both devices share: launch scalars, saved state, colour rows."""

from typing import NamedTuple

import warp as wp
from torch import Tensor

from .tiles import tile_grid


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
