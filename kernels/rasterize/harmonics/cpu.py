"""The harmonics on the CPU: kernels and launches of what ``lanes.py`` says in C++.

A thread takes chunks of Gaussians with all views of them, so that no two add to the same place.
"""

import functools

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import parallel_launch
from ...runtime.memory import empty
from .lanes import CHUNK, backward_text, forward_text

_OPTIONS = {"enable_backward": False}


@functools.cache
def _forward_kernel(degree: int, channels: int, clamped: bool):
    @wp.func_native(forward_text(degree, channels, clamped))
    def forward(
        piece: wp.int32,
        num: wp.int32,
        views: wp.int32,
        per_view: wp.int32,
        coefficients: wp.array2d[wp.float32],
        means: wp.array[wp.float32],
        centers: wp.array[wp.float32],
        colors: wp.array[wp.float32],
    ): ...

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def harmonics(
        offset: wp.int32,
        num: wp.int32,
        views: wp.int32,
        per_view: wp.int32,
        coefficients_in: wp.array2d[wp.float32],
        means_in: wp.array[wp.float32],
        centers_in: wp.array[wp.float32],
        colors_out: wp.array[wp.float32],
    ):
        forward(
            offset + wp.tid(),
            num,
            views,
            per_view,
            coefficients_in,
            means_in,
            centers_in,
            colors_out,
        )

    return harmonics


@functools.cache
def _backward_kernel(degree: int, channels: int, clamped: bool):
    @wp.func_native(backward_text(degree, channels, clamped))
    def backward(
        piece: wp.int32,
        num: wp.int32,
        views: wp.int32,
        per_view: wp.int32,
        coefficients: wp.array2d[wp.float32],
        means: wp.array[wp.float32],
        centers: wp.array[wp.float32],
        colors: wp.array[wp.float32],
        v_colors: wp.array[wp.float32],
        v_coefficients: wp.array2d[wp.float32],
        v_means: wp.array[wp.float32],
        v_centers: wp.array[wp.float32],
    ): ...

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def harmonics_vjp(
        offset: wp.int32,
        num: wp.int32,
        views: wp.int32,
        per_view: wp.int32,
        coefficients_in: wp.array2d[wp.float32],
        means_in: wp.array[wp.float32],
        centers_in: wp.array[wp.float32],
        colors_in: wp.array[wp.float32],
        v_colors_in: wp.array[wp.float32],
        v_coefficients_out: wp.array2d[wp.float32],
        v_means_out: wp.array[wp.float32],
        v_centers_out: wp.array[wp.float32],
    ):
        backward(
            offset + wp.tid(),
            num,
            views,
            per_view,
            coefficients_in,
            means_in,
            centers_in,
            colors_in,
            v_colors_in,
            v_coefficients_out,
            v_means_out,
            v_centers_out,
        )

    return harmonics_vjp


def _launch(kernel, tensors: list[Tensor], outputs: list) -> None:
    # the tensors are coefficients, means, centers and what lies in the order of the colours
    coefficients, means, centers, *rest = tensors
    batch, num, _ = means.shape
    sizes = [num, centers.shape[1], int(coefficients.dim() == 5)]
    rows = coefficients.flatten(0, -3).flatten(1)
    inputs = [rows, means.view(-1), centers.view(-1), *(x.view(-1) for x in rest)]
    parallel_launch(kernel, batch * -(-num // CHUNK), [*sizes, *inputs], outputs)


def harmonics_forward(
    degree: int,
    clamped: bool,
    coefficients: Tensor,
    means: Tensor,
    centers: Tensor,
    colors: Tensor,
) -> None:
    """Fills the colours; float32, contiguous tensors.

    Args:
        degree: 0 to 4.
        clamped: whether a colour is max(0, ½ + sum), or the sum itself.
        coefficients: ``[B, N, K, D]`` or ``[B, V, N, K, D]``.
        means: ``[B, N, 3]``.
        centers: ``[B, V, 3]``.
        colors: written, ``[B, V, N, D]``.
    """
    kernel = _forward_kernel(degree, coefficients.shape[-1], clamped)
    _launch(kernel, [coefficients, means, centers], [colors.view(-1)])


def harmonics_backward(
    degree: int,
    clamped: bool,
    coefficients: Tensor,
    means: Tensor,
    centers: Tensor,
    colors: Tensor,
    v_colors: Tensor,
    wanted: list[bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Gradients of ``harmonics_forward`` by coefficients, means and centers; None if not wanted.

    Args:
        degree: as given forward, like the next four.
        clamped: as given forward.
        coefficients: as given forward.
        means: as given forward.
        centers: as given forward.
        colors: as forward wrote them.
        v_colors: ``[B, V, N, D]``.
        wanted: of which of the three the gradient is asked for.
    """
    (batch, views, _), num = centers.shape, means.shape[1]
    v_coefficients = empty(coefficients.shape, torch.float32) if wanted[0] else None
    v_means = torch.zeros_like(means) if wanted[1] else None
    v_centers = means.new_zeros(batch, views, -(-num // CHUNK), 3) if wanted[2] else None
    outputs = [
        None if v_coefficients is None else v_coefficients.flatten(0, -3).flatten(1),
        None if v_means is None else v_means.view(-1),
        None if v_centers is None else v_centers.view(-1),
    ]
    kernel = _backward_kernel(degree, coefficients.shape[-1], clamped)
    _launch(kernel, [coefficients, means, centers, colors, v_colors], outputs)
    return v_coefficients, v_means, None if v_centers is None else v_centers.sum(2)
