"""Sums of rows by Gaussian on CUDA: bitwise repeatable, no atomics. ``reduce.h`` has the code."""

from pathlib import Path

import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.native import native, native_kernel
from ...runtime.views import StructValue, as_struct, struct_of, view
from ..projection import Projected
from ..tiles import Bins, Splats2D
from .kernels import Rows

_INTS, _SPLATS = wp.array[wp.int32], struct_of(Projected)
_add_rows = native_kernel(
    "add_rows",
    "gamba::raster::add_rows",
    inputs={"order_in": _INTS, "offsets_in": _INTS, "rows_in": Rows, "splats_in": _SPLATS},
    outputs={
        "v_splats_out": _SPLATS,
        "v_colors_out": wp.array2d[wp.float32],
        "absolute_out": wp.array[wp.vec2],
    },
    header=native(Path(__file__).with_name("reduce.h")),
    grouped=True,
    grid_stride=False,
)


def reduce_rows(
    rows: StructValue, splats: Splats2D, bins: Bins, geometry: bool, absolute: Tensor | None
) -> Splats2D:
    """Sum rows by (view, Gaussian), as the CPU's; all rows are written.

    Args:
        rows: ``Rows`` of pairs.
        splats: as forward, like the lists.
        bins: of the pairs.
        geometry: True to compute more than the gradient of the colours.
        absolute: as backward.
    """
    _, conics, view_opacities, _ = splats
    v_means2d = v_conics = v_opacities = None
    if geometry:
        v_means2d = conics.new_empty(*conics.shape[:-1], 2)
        v_conics = conics.new_empty(conics.shape)
        v_opacities = conics.new_empty(conics.shape[:-1])
    channels = splats.colors.shape[1]
    v_colors = conics.new_empty(*conics.shape[:-1], channels)
    launch(
        _add_rows,
        bins.order.numel(),
        [
            *(bins.order, bins.offsets, rows),
            as_struct(Projected(conics=conics, view_opacities=view_opacities)),
        ],
        [
            as_struct(Projected(v_means2d, v_conics, view_opacities=v_opacities)),
            v_colors.view(-1, channels),
            None if absolute is None else view(absolute.view(-1, 2), wp.vec2),
        ],
        conics.device,
    )
    return Splats2D(v_means2d, v_conics, v_opacities, v_colors)
