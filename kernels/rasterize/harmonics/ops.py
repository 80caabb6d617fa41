"""The registered operator of the harmonics, and its gradient.

They hold no arithmetic: they call the launchers of ``cpu.py`` and ``cuda.py``.
"""

from typing import List

import torch
from torch import Tensor

from ...runtime.start import without_compiler
from . import cpu, cuda

_OP = "gamba_warp::rasterize_harmonics"


def _kernels(device: torch.device):
    return cpu if device.type == "cpu" else cuda


def _empty_colors(coefficients: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    return means.new_empty(*centers.shape[:2], means.shape[1], coefficients.shape[-1])


@without_compiler
@torch.library.custom_op(_OP, mutates_args=())
def harmonics(
    degree: int, clamped: bool, coefficients: Tensor, means: Tensor, centers: Tensor
) -> Tensor:
    """``colors_seen_from`` if ``clamped``, else ``sums_seen_from``; contiguous float32 tensors."""
    colors = _empty_colors(coefficients, means, centers)
    if colors.numel():
        _kernels(means.device).harmonics_forward(
            degree, clamped, coefficients, means, centers, colors
        )
    return colors


@harmonics.register_fake
def _(degree, clamped, coefficients, means, centers):
    return _empty_colors(coefficients, means, centers)


@without_compiler
@torch.library.custom_op(_OP + "_vjp", mutates_args=())
def _harmonics_vjp(
    degree: int,
    clamped: bool,
    coefficients: Tensor,
    means: Tensor,
    centers: Tensor,
    colors: Tensor,
    v_colors: Tensor,
    wanted: List[bool],
) -> List[Tensor]:
    inputs = coefficients, means, centers
    if not colors.numel():
        return [torch.zeros_like(x) for x, want in zip(inputs, wanted) if want]
    launch = _kernels(means.device).harmonics_backward
    grads = launch(degree, clamped, *inputs, colors, v_colors, wanted)
    return [g for g in grads if g is not None]


@_harmonics_vjp.register_fake
def _(degree, clamped, coefficients, means, centers, colors, v_colors, wanted):
    inputs = coefficients, means, centers
    return [torch.empty_like(x) for x, want in zip(inputs, wanted) if want]


def _setup(ctx, inputs, output):
    ctx.degree, ctx.clamped, *tensors = inputs
    ctx.save_for_backward(*tensors, output)


def _backward(ctx, v_colors):
    wanted = list(ctx.needs_input_grad[2:])
    each = ctx.degree, ctx.clamped, *ctx.saved_tensors
    grads = iter(_harmonics_vjp(*each, v_colors.contiguous(), wanted))
    return None, None, *(next(grads) if want else None for want in wanted)


harmonics.register_autograd(_backward, setup_context=_setup)
