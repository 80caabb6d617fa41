"""One record for each Gaussian of a view: what the compositor reads of it, 16 bytes at a time."""

from typing import no_type_check

import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.views import as_struct, struct, struct_of
from ..tiles import CHUNK, RasterParams, Splats2D, color_row, record_size
from . import leaves as L
from .ellipse import make_ellipse

wp.set_module_options({"enable_backward": False})

LOG2_E_HALF = 0.72134752044  # exp(-q/2) = 2^(-this q)


@struct
class Gaussians:
    """Gaussians to composite, in view-major order.

    A record has mean x, y, a', k; e', log2 of opacity, limit, top; then the colours, in chunks of
    four. a', e' and the limit of q are README §1's times log2(e)/2, the first two with a
    minus; ``top`` is y* of eq. 6.
    """

    records: wp.array2d[wp.float32]
    channels: int
    first: int  # the first channel of this launch


@wp.kernel(grid_stride=False)
@no_type_check
def _record(
    offset: wp.int32,
    params: RasterParams,
    splats_in: struct_of(Splats2D),
    records_out: wp.array2d[wp.float32],
):
    g = offset + wp.tid()
    mean = splats_in.means2d[g]
    conic = splats_in.conics[g]
    opacity = splats_in.view_opacities[g]
    a, k, e = conic[0], conic[1], conic[2]
    ellipse = make_ellipse(mean, conic, opacity, params.alpha_min)
    at = wp.int64(g) * wp.int64(records_out.shape[1])
    L.store4(records_out, at, wp.vec4(mean[0], mean[1], -LOG2_E_HALF * a, k))
    level = wp.vec4(-LOG2_E_HALF * e, wp.log2(opacity), LOG2_E_HALF * ellipse.limit, ellipse.top)
    L.store4(records_out, at + wp.int64(4), level)
    row = color_row(params, g)
    channels = splats_in.colors.shape[1]
    for first in range(0, channels, CHUNK):
        color = wp.vec4()
        for c in range(CHUNK):
            if first + c < channels:
                color[c] = splats_in.colors[row, first + c]
        L.store4(records_out, at + wp.int64(8 + first), color)


def make_records(splats: Splats2D, params: RasterParams) -> Tensor:
    """Records ``[I * N, record_size(C)]`` of all Gaussians."""
    opacities, colors = splats.view_opacities, splats.colors
    records = colors.new_empty(opacities.numel(), record_size(colors.shape[1]))
    launch(_record, len(records), [params, as_struct(splats)], [records], colors.device)
    return records
