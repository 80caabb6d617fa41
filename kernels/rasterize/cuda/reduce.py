"""Sums of rows by Gaussian on CUDA: bitwise repeatable, no atomics."""

from typing import no_type_check

import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.views import StructValue, as_struct, struct_of, view
from ..projection import Projected
from ..tiles import CHUNK, Bins, Splats2D
from . import leaves as L
from .backward import Rows
from .records import LOG2_E_HALF

wp.set_module_options({"enable_backward": False})


@wp.kernel(grid_stride=False)
@no_type_check
def _add_rows(
    offset: wp.int32,
    order_in: wp.array[wp.int32],
    offsets_in: wp.array[wp.int32],
    rows_in: Rows,
    splats_in: struct_of(Projected),
    v_splats_out: struct_of(Projected),
    v_colors_out: wp.array2d[wp.float32],
    absolute_out: wp.array[wp.vec2],
):
    j = offset + wp.tid()
    i = order_in[j]
    begin = offsets_in[j]
    end = offsets_in[j + 1]
    drawn = begin != end
    low = wp.vec4()  # h, hu, hy, huu
    high = wp.vec4()  # huy, hyy, and the sums of absolute values or colours
    tail_at = wp.int32(0)
    for first in range(0, v_colors_out.shape[1], CHUNK):
        head_at = wp.int64(2) * wp.int64(first)
        low_of = wp.vec4()
        high_of = wp.vec4()
        tail = wp.vec4()
        tails = wp.min(v_colors_out.shape[1] - first, CHUNK)
        if not absolute_out:
            tails -= 2  # as the head has two colours, in place of the sums of absolute values
        for p in range(begin, end):
            if (L.load_int(rows_in.written, p >> 5) >> (p & 31) & 1) == 0:
                continue
            at = wp.int64(p) * wp.int64(rows_in.heads.shape[1]) + head_at
            low_of += L.load4(rows_in.heads, at)
            high_of += L.load4(rows_in.heads, at + wp.int64(4))
            at = wp.int64(p) * wp.int64(rows_in.tails.shape[1]) + wp.int64(tail_at)
            tail += L.load_some(rows_in.tails, at, tails)
        tail_at += tails
        color = tail
        if not absolute_out:
            color = wp.vec4(high_of[2], high_of[3], tail[0], tail[1])
        low += low_of
        high += high_of
        for c in range(CHUNK):
            if first + c < v_colors_out.shape[1]:
                v_colors_out[i, first + c] = color[c]
    if v_splats_out.means2d:
        h, hu, hy, huu = low[0], low[1], low[2], low[3]
        huy, hyy = high[0], high[1]
        # README eq. 11: moments of h to the gradients
        conic = splats_in.conics[i]
        a, k, e = conic[0], conic[1], conic[2]
        v_splats_out.means2d[i] = wp.vec2(a * hu, a * k * hu + e * hy)
        v_splats_out.conics[i] = wp.vec3(-0.5 * huu, -a * huy, -0.5 * hyy)
        v_opacity = wp.float32(0.0)
        if drawn:
            v_opacity = h / splats_in.view_opacities[i]
        v_splats_out.view_opacities[i] = v_opacity
        if absolute_out:
            # README eq. 14; the compositor's second sum has a factor
            absolute_out[i] = wp.vec2(a * high[2], high[3] / LOG2_E_HALF)


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
