"""Sums of rows by Gaussian on CUDA: bitwise repeatable, no atomics, the same without lists.

Rows are added up first, then the parts of a tile and the chunks of channels: so the bits are
the same for rows written pair by pair and for rows that the compositor has added.
"""

from typing import no_type_check

import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.views import as_struct, struct_of, view
from ..projection import Projected
from ..tiles import Bins, Drawn
from . import leaves as L
from .backward import moments_of
from .records import LOG2_E_HALF

wp.set_module_options({"enable_backward": False})


@wp.kernel
@no_type_check
def _add_rows(
    offset: wp.int32,
    offsets_in: wp.array[wp.int32],
    count_in: wp.array[wp.int64],
    v_pairs_in: wp.array2d[wp.float32],
    sums_out: wp.array2d[wp.float32],
):
    # a thread has a column: those of a warp read one row, or few, that lie together
    k, column = wp.tid()
    j = offset + k
    begin = offsets_in[j]
    end = offsets_in[j + 1]
    if count_in[0] > wp.int64(v_pairs_in.shape[0]):
        # rows of Gaussians, written where they have pairs
        end = j + wp.where(end != begin, 1, 0)
        begin = j
    total = wp.float32(0.0)
    columns = wp.int64(v_pairs_in.shape[1])
    row = wp.int64(begin) * columns
    for _ in range(begin, end):
        total += L.load(v_pairs_in, row, column)
        row += columns
    L.store(sums_out, wp.int64(j) * columns, column, total)


@wp.func
@no_type_check
def _over_parts(sums: wp.array3d[wp.float32], j: wp.int32, column: wp.int32) -> wp.float32:
    total = wp.float32(0.0)
    for part in range(sums.shape[1]):
        total += sums[j, part, column]
    return total


@wp.kernel
@no_type_check
def _finish(
    offset: wp.int32,
    order_in: wp.array[wp.int32],
    offsets_in: wp.array[wp.int32],
    sums_in: wp.array3d[wp.float32],
    sets: wp.int32,
    moments: wp.int32,
    splats_in: struct_of(Projected),
    v_splats_out: struct_of(Projected),
    v_colors_out: wp.array2d[wp.float32],
    absolute_out: wp.array[wp.vec2],
):
    j = offset + wp.tid()
    i = order_in[j]
    first = sets * moments
    for c in range(v_colors_out.shape[1]):
        v_colors_out[i, c] = _over_parts(sums_in, j, first + c)
    if v_splats_out.means2d:
        h = wp.float32(0.0)
        hu = wp.float32(0.0)
        hy = wp.float32(0.0)
        huu = wp.float32(0.0)
        huy = wp.float32(0.0)
        hyy = wp.float32(0.0)
        for at in range(0, first, moments):
            h += _over_parts(sums_in, j, at)
            hu += _over_parts(sums_in, j, at + 1)
            hy += _over_parts(sums_in, j, at + 2)
            huu += _over_parts(sums_in, j, at + 3)
            huy += _over_parts(sums_in, j, at + 4)
            hyy += _over_parts(sums_in, j, at + 5)
        # README eq. 11: moments of h to the gradients
        conic = splats_in.conics[i]
        a, k, e = conic[0], conic[1], conic[2]
        v_splats_out.means2d[i] = wp.vec2(a * hu, a * k * hu + e * hy)
        v_splats_out.conics[i] = wp.vec3(-0.5 * huu, -a * huy, -0.5 * hyy)
        v_opacity = wp.float32(0.0)
        if offsets_in[j + 1] != offsets_in[j]:
            v_opacity = h / splats_in.view_opacities[i]
        v_splats_out.view_opacities[i] = v_opacity
        if absolute_out:
            # README eq. 14, of which the compositor has the second times a factor
            along = _over_parts(sums_in, j, 7) / LOG2_E_HALF
            absolute_out[i] = wp.vec2(a * _over_parts(sums_in, j, 6), along)


def reduce_rows(
    v_pairs: Tensor, splats: Drawn, bins: Bins, geometry: bool, absolute: Tensor | None
) -> Drawn:
    """Sum rows by (view, Gaussian), as the CPU's; all rows are written.

    Args:
        v_pairs: ``[P, parts, columns of moments + C]``, or where the lists were too short, rows of
            Gaussians in the order of ``bins.order``.
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
    count, (_, parts, columns) = bins.order.numel(), v_pairs.shape
    channels = splats.colors.shape[1]
    sets, moments = moments_of(channels, absolute is not None)
    v_colors = conics.new_empty(*conics.shape[:-1], channels)
    sums = conics.new_empty(count, parts, columns)
    launch(
        _add_rows,
        (count, parts * columns),
        [bins.offsets, bins.count.view(1), v_pairs.flatten(1)],
        [sums.flatten(1)],
        conics.device,
    )
    launch(
        _finish,
        count,
        [
            *(bins.order, bins.offsets, sums, sets, moments),
            as_struct(Projected(conics=conics, view_opacities=view_opacities)),
        ],
        [
            as_struct(Projected(v_means2d, v_conics, view_opacities=v_opacities)),
            v_colors.view(-1, channels),
            None if absolute is None else view(absolute.view(-1, 2), wp.vec2),
        ],
        conics.device,
    )
    return Drawn(v_means2d, v_conics, v_opacities, v_colors)
