"""Sums of pair gradients by Gaussian on the CPU: a row of a pair as lanes, in emission order.

The rows of a Gaussian are added by one thread, without atomics: the same bits every time.
"""

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from ...runtime.views import vectors
from ..tiles import Bins, PairGradients
from .lanes import TYPES

wp.set_module_options({"enable_backward": False})

_RUN = wp.constant(1024)  # Gaussians of a task
_PIECES_PER_THREAD = 8

# A row has 6 moments and the colours. Where rows are of 16 numbers or fewer, the sums are lanes;
# those past the end of a row are not read but for a last row, which is read number by number.
_SUM = (
    TYPES
    + """
const int width = v_pairs.shape[1], channels = width - 6;
const long long all = (long long)v_pairs.shape[0] * width;
for (int j = begin; j < end; ++j) {
    const int i = order.data[j], from = offsets.data[j], to = offsets.data[j + 1];
    float sums[16] = {};
    float* const colors = v_colors.data + (size_t)i * channels;
    if (width <= 16) {
        F sum = F{};
        for (int p = from; p < to; ++p) {
            if (!written.data[p]) continue;
            const float* const row = v_pairs.data + (size_t)p * width;
            if ((long long)p * width + 16 <= all) sum += *(const F*)row;
            else {
                F part = F{};
                for (int c = 0; c < width; ++c) part[c] = row[c];
                sum += part;
            }
        }
        *(F*)sums = sum;
        for (int c = 0; c < channels; ++c) colors[c] = sums[6 + c];
    } else {
        for (int c = 0; c < channels; ++c) colors[c] = 0.0f;
        for (int p = from; p < to; ++p) {
            if (!written.data[p]) continue;
            const float* const row = v_pairs.data + (size_t)p * width;
            for (int c = 0; c < 6; ++c) sums[c] += row[c];
            for (int c = 0; c < channels; ++c) colors[c] += row[6 + c];
        }
    }
    if (!v_means2d.data) continue;
    // README eq. 11: moments of h to the gradients; products are stored before they are added
    const float* const conic = (const float*)conics.data + (size_t)i * 3;
    const float a = conic[0], k = conic[1], e = conic[2], ak = a * k;
    const float across = ak * sums[1], along = e * sums[2];
    float* const mean = (float*)v_means2d.data + (size_t)i * 2;
    mean[0] = a * sums[1];
    mean[1] = across + along;
    float* const v = (float*)v_conics.data + (size_t)i * 3;
    v[0] = -0.5f * sums[3];
    v[1] = -a * sums[4];
    v[2] = -0.5f * sums[5];
    v_opacities.data[i] = to > from ? sums[0] / opacities.data[i] : 0.0f;
}
"""
)


@wp.func_native(_SUM)
def _sum_run(
    begin: int,
    end: int,
    order: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    v_pairs: wp.array2d[wp.float32],
    written: wp.array[wp.uint8],
    conics: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    v_means2d: wp.array[wp.vec2],
    v_conics: wp.array[wp.vec3],
    v_opacities: wp.array[wp.float32],
    v_colors: wp.array2d[wp.float32],
):
    """Sums the rows of the Gaussians ``order[begin:end]``."""
    ...


@wp.kernel
def _reduce_rows(
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
    begin = (offset + wp.tid()) * _RUN
    _sum_run(
        begin,
        wp.min(begin + _RUN, order_in.shape[0]),
        order_in,
        offsets_in,
        v_pairs_in,
        written_in,
        conics_in,
        view_opacities_in,
        v_means2d_out,
        v_conics_out,
        v_view_opacities_out,
        v_colors_out,
    )


def reduce_rows(
    v_pairs: Tensor,
    written: Tensor,
    bins: Bins,
    conics: Tensor,
    view_opacities: Tensor,
    geometry: bool,
) -> PairGradients:
    """Sums rows of pairs by (view, Gaussian); float32, contiguous tensors on the CPU.

    Args:
        v_pairs: ``[P, 6 + C]``: six moments of h (README eq. 11), then the colours.
        written: ``[P]`` uint8, 0 where a row of ``v_pairs`` was not written and is not read.
        bins: as forward.
        conics: ``[I, N, 3]``.
        view_opacities: ``[I, N]``.
        geometry: whether anything but colours is asked for.
    """
    lead, channels = view_opacities.shape, v_pairs.shape[1] - 6
    v_means2d = v_conics = v_opacities = None
    if geometry:
        v_means2d, v_conics, v_opacities = (
            empty([*lead, *size], torch.float32) for size in ((2,), (3,), ())
        )
    v_colors = empty([*lead, channels], torch.float32)
    tasks = -(-bins.order.numel() // _RUN)
    parallel_launch(
        _reduce_rows,
        tasks,
        [
            bins.order,
            bins.offsets,
            v_pairs,
            written,
            vectors(conics, wp.vec3),
            view_opacities.view(-1),
        ],
        [
            vectors(v_means2d, wp.vec2),
            vectors(v_conics, wp.vec3),
            None if v_opacities is None else v_opacities.view(-1),
            v_colors.view(-1, channels),
        ],
        pieces=min(tasks, _PIECES_PER_THREAD * torch.get_num_threads()),
    )
    return PairGradients(v_means2d, v_conics, v_opacities, v_colors)
