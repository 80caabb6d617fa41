"""The public functions: they choose between the operator and the formula in torch."""

from __future__ import annotations

import torch
from torch import Tensor

from .formula import colors_by_formula, sums_by_formula
from .ops import harmonics
from .polynomials import MOST_CHANNELS


def colors_from_harmonics(
    degree: int, coefficients: Tensor, means: Tensor, viewmats: Tensor
) -> Tensor:
    """Colours seen from each camera, ``max(0, ½ + Σ_k Y_k(direction) coefficient_k)``.

    Args:
        degree: as for ``colors_seen_from``, like ``coefficients`` and ``means``.
        viewmats: ``[B, V, 4, 4]``, rigid.

    Returns:
        as ``colors_seen_from``.
    """
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    centers = -(rotation.mT @ translation[..., None])[..., 0]
    return colors_seen_from(degree, coefficients, means, centers)


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
    if not _fits(coefficients, means, centers):
        formula = colors_by_formula if clamped else sums_by_formula
        return formula(degree, coefficients, means, centers)
    each = (x.contiguous() for x in (coefficients, means, centers))
    return harmonics(degree, clamped, *each)


def _fits(coefficients: Tensor, means: Tensor, centers: Tensor) -> bool:
    """Whether the kernels take these tensors."""
    tensors = coefficients, means, centers
    batch, num, _ = means.shape
    views = (centers.shape[1],) if coefficients.dim() == 5 else ()
    return (
        all(x.dtype == torch.float32 and x.device == means.device for x in tensors)
        and means.device.type in ("cpu", "cuda", "meta")
        and centers.shape[0] == batch
        and coefficients.shape[:-2] == (batch, *views, num)
        and coefficients.shape[-1] <= MOST_CHANNELS
    )
