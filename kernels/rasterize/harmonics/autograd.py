"""The public functions of the harmonics, over a registered operator or the formula in torch."""

from typing import List

import torch
from torch import Tensor

from ...runtime import gpu
from ...runtime.launch import launch
from ...runtime.operator import operator
from ...runtime.views import StructValue
from ..projection import empty_on
from . import cpu, cuda
from .formula import colors_by_formula, sums_by_formula
from .shared import Arrays, Size

_OP = "gamba_warp::rasterize_harmonics"
MOST_CHANNELS = 64  # of the kernels: on a CPU the rows of coefficients are on a thread's stack


def _kernels(device: torch.device):
    return cpu if gpu.kind_of(device) == "cpu" else cuda


def _launch(kernel, chunk: int, tensors: list, outputs: list) -> None:
    """Run a kernel on chunks of Gaussians; ``tensors`` are the fields of ``Arrays``."""
    coefficients, means, centers, _ = tensors
    size = StructValue(Size, means.shape[1], centers.shape[1], int(coefficients.dim() == 5))
    tasks = means.shape[0] * -(-means.shape[1] // chunk)
    launch(kernel, tasks, [size, StructValue(Arrays, *tensors)], outputs, means.device)


def _empty_colors(coefficients: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    return means.new_empty(*centers.shape[:2], means.shape[1], coefficients.shape[-1])


@torch.library.custom_op(_OP, mutates_args=())
def harmonics(
    degree: int, clamped: bool, coefficients: Tensor, means: Tensor, centers: Tensor
) -> Tensor:
    """``colors_seen_from`` if ``clamped``, else ``sums_seen_from``; contiguous float32 tensors."""
    inputs, kernels = [coefficients, means, centers], _kernels(means.device)
    colors = _empty_colors(*inputs)
    if colors.numel():
        kernel = kernels.forward_kernel(degree, coefficients.shape[-1], clamped)
        _launch(kernel, kernels.CHUNK, [*inputs, colors], [])
    return colors


@harmonics.register_fake
def _(degree, clamped, coefficients, means, centers):
    return _empty_colors(coefficients, means, centers)


@torch.library.custom_op(_OP + "_vjp", mutates_args=())
def _harmonics_vjp(
    degree: int, clamped: bool, arrays: List[Tensor], v_colors: Tensor, wanted: List[bool]
) -> List[Tensor]:
    # ``arrays`` are the inputs and the colours as forward wrote them
    coefficients, means, centers, colors = arrays
    if not colors.numel():
        return [torch.zeros_like(x) for x, want in zip(arrays, wanted) if want]
    (batch, views, _), num, kernels = centers.shape, means.shape[1], _kernels(means.device)
    shape = coefficients.shape
    v_coefficients = empty_on(means.device, shape, torch.float32) if wanted[0] else None
    v_means = torch.zeros_like(means) if wanted[1] else None
    chunks = -(-num // kernels.CHUNK)
    v_centers = means.new_zeros(batch, views, chunks, 3) if wanted[2] else None
    v_arrays = StructValue(Arrays, v_coefficients, v_means, v_centers, v_colors)
    kernel = kernels.backward_kernel(degree, shape[-1], clamped)
    _launch(kernel, kernels.CHUNK, arrays, [v_arrays])
    grads = v_coefficients, v_means, None if v_centers is None else v_centers.sum(2)
    return [g for g in grads if g is not None]


@_harmonics_vjp.register_fake
def _(degree, clamped, arrays, v_colors, wanted):
    return [torch.empty_like(x) for x, want in zip(arrays, wanted) if want]


def _setup(ctx, inputs, output):
    ctx.degree, ctx.clamped, *tensors = inputs
    ctx.save_for_backward(*tensors, output)


def _backward(ctx, v_colors):
    wanted, arrays = list(ctx.needs_input_grad[2:]), list(ctx.saved_tensors)
    grads = iter(_harmonics_vjp(ctx.degree, ctx.clamped, arrays, v_colors.contiguous(), wanted))
    return None, None, *(next(grads) if want else None for want in wanted)


harmonics = operator(harmonics, "spherical harmonics", _setup, _backward)
_harmonics_vjp = operator(_harmonics_vjp, "spherical harmonics")


def colors_from_harmonics(
    degree: int, coefficients: Tensor, means: Tensor, viewmats: Tensor
) -> Tensor:
    """Colours seen from each camera, ``max(0, ½ + Σ_k Y_k(direction) coefficient_k)``.

    Args:
        degree: as for ``colors_seen_from``.
        coefficients: ``[.., N, K, D]``.
        means: ``[.., N, 3]``.
        viewmats: ``[.., V, 4, 4]``, rigid.

    Returns:
        ``[.., V, N, D]``.
    """
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    centers = -(rotation.mT @ translation[..., None])[..., 0]
    lead, batch = means.shape[:-2], means.shape[:-2].numel()
    rows = (x.reshape(batch, *x.shape[len(lead) :]) for x in (coefficients, means, centers))
    colors = colors_seen_from(degree, *rows)
    return colors.view(*lead, *colors.shape[1:])


def colors_seen_from(degree: int, coefficients: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    """Colours seen from each point, ``max(0, ½ + Σ_k Y_k(direction) coefficient_k)``.

    Differentiable once in coefficients, means and centers, and the same input gives the same bits.
    (Other dtypes than float32, and more than 64 channels, take the formula in torch.)

    Args:
        degree: 0 to 4; coefficients beyond it are not used.
        coefficients: ``[B, N, K, D]``, or ``[B, V, N, K, D]`` for each point its own.
        means: ``[B, N, 3]``.
        centers: ``[B, V, 3]``, of the cameras.

    Returns:
        ``[B, V, N, D]``; NaN without a gradient where the mean or a used coefficient is not finite.
    """
    return _seen_from(degree, True, coefficients, means, centers)


def sums_seen_from(degree: int, coefficients: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    """The sums in ``colors_seen_from``, ``Σ_k Y_k(direction) coefficient_k``, and no clamp."""
    return _seen_from(degree, False, coefficients, means, centers)


def _seen_from(
    degree: int, clamped: bool, coefficients: Tensor, means: Tensor, centers: Tensor
) -> Tensor:
    tensors = coefficients, means, centers
    views = (centers.shape[1],) if coefficients.dim() == 5 else ()
    fits = (
        all(x.dtype == torch.float32 and x.device == means.device for x in tensors)
        and means.device.type in ("cpu", "cuda", "meta")
        and centers.shape[0] == means.shape[0]
        and coefficients.shape[:-2] == (means.shape[0], *views, means.shape[1])
        and coefficients.shape[-1] <= MOST_CHANNELS
    )
    if not fits:
        formula = colors_by_formula if clamped else sums_by_formula
        return formula(degree, *tensors)
    return harmonics(degree, clamped, *(x.contiguous() for x in tensors))
