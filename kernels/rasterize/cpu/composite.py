"""Compositing on the CPU: threads take tile after tile, 16 lanes = the pixels of a 4 x 4 block.

A tile of 16 x 16 pixels is 16 such blocks. The gradient goes back to front and writes one row per
(tile, Gaussian) intersection; rows are summed by Gaussian afterwards, by one thread and without
atomics: the same bits every time. README.md §3 and §5 hold the maths, ``composite.h`` the code.
"""

from pathlib import Path

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ...runtime.native import constants, native, native_kernel
from ...runtime.views import StructValue, as_struct, struct, struct_of, view
from ..constants import BLOCKS, TILE
from ..skip import BLOCK_TEST, EMPTY_TILES, STOPPED, UNUSED, ZERO_UPSTREAM
from ..tiles import SLACK, SLACK_ABS, Bins, Pixels, RasterParams, Saved, Splats2D

_RUN = 1024  # Gaussians of a task of the sums
_PIECES_PER_THREAD = 8
_CONFIG = constants(
    "Config", TILE=TILE, SLACK=SLACK, SLACK_ABS=SLACK_ABS, BLOCK_TEST=BLOCK_TEST, STOPPED=STOPPED,
    EMPTY_TILES=EMPTY_TILES, ZERO_UPSTREAM=ZERO_UPSTREAM, UNUSED=UNUSED,
)  # fmt: skip
_HEADER = _CONFIG + native(Path(__file__).with_name("composite.h"))


@struct
class Workers:
    """State that a launch's workers share (the next tile to take), and memory of each worker."""

    counter: wp.array[wp.int32]
    workspace: wp.array[wp.float32]


@struct
class Rows:
    """The sums of each intersection: moments of h (README eq. 11, 14) and the colours."""

    sums: wp.array2d[wp.float32]  # [P, 6 + C], or with the absolute ones [P, 8 + C]
    written: wp.array[wp.uint8]  # [P], 0 where a row was not written and is not read
    skipped: wp.array[wp.int32]  # [tiles], raised to 1 where a tile is skipped, 2 where traversed
    geometry: int  # 0 for the gradient of the colours alone


_SPLATS = {"params": RasterParams, "splats": struct_of(Splats2D), "lists": struct_of(Bins)}
_SAVED = {"saved": struct_of(Saved), "pixels": Pixels}

_composite = native_kernel(
    "composite",
    "gamba::raster::composite<Config>",
    inputs=_SPLATS,
    outputs={**_SAVED, "workers": Workers},
    header=_HEADER,
)
# with the sums of absolute values, and with a gradient that passes the clamp of alpha, which cost
# nothing where they are not asked for
_composite_vjp = {
    (absolute, passes): native_kernel(
        "composite_vjp" + "_absolute" * absolute + "_passing" * passes,
        f"gamba::raster::composite_vjp<Config, {absolute:d}, {passes:d}>",
        inputs={**_SPLATS, **_SAVED},
        outputs={"workers": Workers, "rows": Rows},
        header=_HEADER,
    )
    for absolute in (False, True)
    for passes in (False, True)
}
_sum_rows = native_kernel(
    "sum_rows",
    f"gamba::raster::sum_rows<{_RUN}>",
    inputs={"splats": struct_of(Splats2D), "lists": struct_of(Bins), "rows": Rows},
    outputs={"v": struct_of(Splats2D), "absolute": wp.array[wp.vec2]},
    header=_HEADER,
)


def _workers(size: int) -> StructValue:
    """Room for ``size`` lanes of each worker."""
    workspace = torch.empty(torch.get_num_threads() * size * 16, dtype=torch.float32)
    return StructValue(Workers, torch.zeros(1, dtype=torch.int32), workspace)


def composite_forward(
    splats: Splats2D, bins: Bins, params: RasterParams
) -> tuple[Tensor, Tensor, Saved]:
    """Blend I views; float32, contiguous tensors on the CPU.

    Args:
        splats: Gaussians to draw.
        bins: from ``bin_views``.
        params: from ``raster_params``.

    Returns:
        ``renders [.., H, W, C]``, transmittances ``[.., H, W, 1]`` and a ``Saved``.
    """
    colors = splats.colors
    images, channels = splats.means2d.shape[:-2], colors.shape[1]
    tiles = images.numel() * params.tiles_x * params.tiles_y
    renders = colors.new_zeros(*images, params.height, params.width, channels)
    transmittances = colors.new_ones(*images, params.height, params.width, 1)
    saved = Saved(
        transmittances=colors.new_empty(tiles * BLOCKS, 16),
        stops=bins.pairs.new_empty(tiles * BLOCKS, 16),
        blocks=torch.zeros_like(bins.pairs),
        traversed=bins.pairs.new_empty(tiles),
        blocks_traversed=bins.pairs.new_empty(tiles, dtype=torch.int64),
        records=colors.new_empty(0, 0),
    )
    arguments = [
        params,
        as_struct(splats),
        as_struct(bins),
        as_struct(saved),
        StructValue(Pixels, renders, transmittances),
        _workers(BLOCKS * channels),
    ]
    parallel_launch(_composite, torch.get_num_threads(), arguments)
    return renders, transmittances, saved


def composite_backward(
    splats: Splats2D,
    bins: Bins,
    params: RasterParams,
    saved: Saved,
    v_pixels: list[Tensor],
    skipped: Tensor,
    geometry: bool,
    absolute: Tensor | None = None,
    passes: bool = False,
) -> Splats2D:
    """Gradients of ``composite_forward`` by (view, Gaussian), from a row of sums for each pair.

    Args:
        splats: as forward.
        bins: as forward.
        params: as forward.
        saved: as returned forward.
        v_pixels: gradients of the renders and the transmittances.
        skipped: ``[tiles]`` int32, raised to 1 for a tile that is skipped and 2 for one traversed.
        geometry: True to compute more than the gradient of the colours.
        absolute: ``[.., N, 2]``, set to the pixels' absolute gradients of means2d, summed; or None.
            With it ``geometry`` is True.
        passes: the gradient passes the clamp of alpha.
    """
    channels = splats.colors.shape[1]
    moments = 6 if absolute is None else 8
    sums = empty([bins.pairs.numel(), moments + channels], torch.float32)
    written = bins.pairs.new_zeros(bins.pairs.numel(), dtype=torch.uint8)
    arguments = [
        params,
        as_struct(splats),
        as_struct(bins),
        as_struct(saved),
        StructValue(Pixels, *v_pixels),
        _workers(channels + BLOCKS * (channels + 1)),
        StructValue(Rows, sums, written, skipped, int(geometry)),
    ]
    kernel = _composite_vjp[absolute is not None, passes]
    parallel_launch(kernel, torch.get_num_threads(), arguments)
    return reduce_rows(sums, written, splats, bins, geometry, absolute)


def reduce_rows(
    sums: Tensor,
    written: Tensor,
    splats: Splats2D,
    bins: Bins,
    geometry: bool,
    absolute: Tensor | None,
) -> Splats2D:
    """Sum rows by (view, Gaussian), in the order in which intersections are numbered.

    Args:
        sums: ``[P, 6 + C]``, or with ``absolute`` ``[P, 8 + C]``: moments of h, then the colours.
        written: ``[P]`` uint8, 0 where a row was not written and is not read.
        splats: as forward, like the lists.
        bins: of the intersections.
        geometry: True to compute more than the gradient of the colours.
        absolute: as backward.
    """
    _, conics, view_opacities, _ = splats
    lead, channels = view_opacities.shape, sums.shape[1] - (6 if absolute is None else 8)
    v_means2d, v_conics, v_opacities = (
        empty([*lead, *size], torch.float32) if geometry else None for size in ((2,), (3,), ())
    )
    v = Splats2D(v_means2d, v_conics, v_opacities, empty([*lead, channels], torch.float32))
    arguments = [
        as_struct(Splats2D(conics=conics, view_opacities=view_opacities)),
        as_struct(bins),
        StructValue(Rows, sums, written, None, int(geometry)),
        as_struct(v),
        None if absolute is None else view(absolute.view(-1, 2), wp.vec2),
    ]
    tasks = -(-bins.order.numel() // _RUN)
    pieces = min(tasks, _PIECES_PER_THREAD * torch.get_num_threads())
    parallel_launch(_sum_rows, tasks, arguments, pieces=pieces)
    return v
