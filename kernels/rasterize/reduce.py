"""Sums of pair gradients by Gaussian, in emission order: bitwise repeatable, no atomics."""

from typing import NamedTuple, no_type_check

import warp as wp
from torch import Tensor

from ..runtime.launch import launch
from ..runtime.views import vectors
from .cpu.reduce import reduce_rows
from .project import room
from .tiles import Bins

wp.set_module_options({"enable_backward": False})


@wp.kernel
@no_type_check
def _reduce(
    offset: wp.int32,
    order_in: wp.array[wp.int32],
    offsets_in: wp.array[wp.int32],
    v_pairs_in: wp.array2d[wp.float32],
    written_in: wp.array[wp.uint8],
    conics_in: wp.array[wp.vec3],
    view_opacities_in: wp.array[wp.float32],
    v_means2d_out: wp.array[wp.vec2],
    v_conics_out: wp.array[wp.vec3],
    v_view_opacities_out: wp.array[wp.float32],
    v_colors_out: wp.array2d[wp.float32],
):
    j = offset + wp.tid()
    i = order_in[j]
    begin = offsets_in[j]
    end = offsets_in[j + 1]
    h = wp.float32(0.0)
    hu = wp.float32(0.0)
    hy = wp.float32(0.0)
    huu = wp.float32(0.0)
    huy = wp.float32(0.0)
    hyy = wp.float32(0.0)
    for c in range(v_colors_out.shape[1]):
        v_colors_out[i, c] = 0.0
    for p in range(begin, end):
        used = True
        if written_in:
            used = written_in[p] != wp.uint8(0)
        if used:
            for c in range(v_colors_out.shape[1]):
                v_colors_out[i, c] = v_colors_out[i, c] + v_pairs_in[p, 6 + c]
            h += v_pairs_in[p, 0]
            hu += v_pairs_in[p, 1]
            hy += v_pairs_in[p, 2]
            huu += v_pairs_in[p, 3]
            huy += v_pairs_in[p, 4]
            hyy += v_pairs_in[p, 5]
    if v_means2d_out:
        # README eq. 11: moments of h to the gradients
        conic = conics_in[i]
        a, k, e = conic[0], conic[1], conic[2]
        v_means2d_out[i] = wp.vec2(a * hu, a * k * hu + e * hy)
        v_conics_out[i] = wp.vec3(-0.5 * huu, -a * huy, -0.5 * hyy)
        v_opacity = wp.float32(0.0)
        if end > begin:
            v_opacity = h / view_opacities_in[i]
        v_view_opacities_out[i] = v_opacity


class PairGradients(NamedTuple):
    """Gradients of the compositor's inputs by (view, Gaussian).

    Attributes:
        means2d: ``[I, N, 2]``, or None if colours alone are asked for, like the next two.
        conics: ``[I, N, 3]`` or None.
        view_opacities: ``[I, N]`` or None.
        colors: ``[I, N, C]``.
    """

    means2d: Tensor | None
    conics: Tensor | None
    view_opacities: Tensor | None
    colors: Tensor


def _room(conics: Tensor, *size: int) -> Tensor:
    return room([*conics.shape[:-1], *size], conics.dtype, conics.device)


def reduce_pairs(
    v_pairs: Tensor,
    written: Tensor | None,
    bins: Bins,
    conics: Tensor,
    view_opacities: Tensor,
    geometry: bool,
) -> PairGradients:
    """Sums the rows of ``composite_backward`` by (view, Gaussian).

    Args:
        v_pairs: ``[P, 6 + C]``.
        written: ``[P]`` uint8, 0 where a row of ``v_pairs`` was not written; None: all were.
        bins: as forward.
        conics: ``[I, N, 3]``.
        view_opacities: ``[I, N]``.
        geometry: whether anything but colours is asked for.
    """
    v_means2d = v_conics = v_opacities = None
    if geometry:
        sizes = (2,), (3,), ()
        v_means2d, v_conics, v_opacities = (_room(conics, *size) for size in sizes)
    v_colors = _room(conics, v_pairs.shape[1] - 6)
    inputs = [
        bins.order,
        bins.offsets,
        v_pairs,
        written,
        vectors(conics, wp.vec3),
        view_opacities.view(-1),
    ]
    outputs = [
        vectors(v_means2d, wp.vec2),
        vectors(v_conics, wp.vec3),
        None if v_opacities is None else v_opacities.view(-1),
        v_colors.view(-1, v_colors.shape[-1]),
    ]
    if conics.device.type == "cpu" and bins.order.numel():
        reduce_rows(bins.order.numel(), inputs, outputs)
    else:
        launch(_reduce, bins.order.numel(), inputs, outputs, conics.device)
    return PairGradients(v_means2d, v_conics, v_opacities, v_colors)
