"""The training loss of the paper (eq. loss_train) as pure functions.

Every term has one value per view, ``[.., V]``; ``total_loss`` weighs and averages them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor


def mse(got: Tensor, want: Tensor) -> Tensor:
    """Mean squared error over height, width and channels: ``[.., H, W, C]`` to ``[..]``."""
    return (got - want).square().mean((-3, -2, -1))


def psnr(got: Tensor, want: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB of ``[.., H, W, C]`` pictures in [0, 1], ``[..]``."""
    return -10 * mse(got.clamp(0, 1), want).clamp_min(1e-10).log10()


def view_losses(
    rgb: Tensor,
    alpha: Tensor,
    target_rgb: Tensor,
    target_alpha: Tensor,
    lpips: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> dict[str, Tensor]:
    """The picture terms, each ``[.., V]``: ``rgb`` and ``mask`` (MSE), and ``lpips`` if given.

    Args:
        rgb: ``[.., V, H, W, 3]``, on the background of ``target_rgb``.
        alpha: ``[.., V, H, W, 1]``.
        target_rgb: as ``rgb``.
        target_alpha: as ``alpha``.
        lpips: ``(got, want) -> [.., V]``.
    """
    terms = {"rgb": mse(rgb, target_rgb), "mask": mse(alpha, target_alpha)}
    if lpips is not None:
        terms["lpips"] = lpips(rgb, target_rgb)
    return terms


def total_loss(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Weighted sum of the terms, averaged over all views and objects: a scalar.

    Raises:
        KeyError: a term has no weight.
    """
    return torch.stack([weights[name] * term.mean() for name, term in terms.items()]).sum()
