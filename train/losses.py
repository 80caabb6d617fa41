"""The training loss of the paper (eq. loss_train).

Every term has one value per view, ``[.., V]``; ``total_loss`` weighs and averages them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from gamba_warp.data.vgg_weights import lpips_available
from gamba_warp.image_metrics import psnr
from gamba_warp.model.lpips import LPIPS, load_lpips

from .config import TrainConfig


def mse(got: Tensor, want: Tensor) -> Tensor:
    """Averages the squared error over height, width, channels: ``[.., H, W, C]`` to ``[..]``."""
    return (got - want).square().mean((-3, -2, -1))


def rendered_psnr(got: Tensor, want: Tensor) -> Tensor:
    """``psnr`` of rendered pictures, whose values are clamped to [0, 1] first.

    Args:
        got: ``[.., H, W, C]``, rendered.
        want: ``[.., H, W, C]`` in [0, 1].

    Returns:
        ``[..]`` float64, dB.
    """
    return psnr(got.clamp(0, 1), want)


def view_losses(
    rgb: Tensor,
    alpha: Tensor,
    target_rgb: Tensor,
    target_alpha: Tensor,
    lpips: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> dict[str, Tensor]:
    """Computes the terms of pictures, each ``[.., V]``: ``rgb`` and ``mask`` (MSE), ``lpips``.

    Args:
        rgb: ``[.., V, H, W, 3]``, on the background of ``target_rgb``.
        alpha: ``[.., V, H, W, 1]``.
        target_rgb: as ``rgb``.
        target_alpha: as ``alpha``.
        lpips: ``(got, want) -> [.., V]``, or None to leave this term out.
    """
    terms = {"rgb": mse(rgb, target_rgb), "mask": mse(alpha, target_alpha)}
    if lpips is not None:
        terms["lpips"] = lpips(rgb, target_rgb)
    return terms


def total_loss(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Sums the weighted terms, averaged over all views and objects, to a scalar.

    Raises:
        KeyError: a term has no weight.
    """
    return torch.stack([weights[name] * term.mean() for name, term in terms.items()]).sum()


def open_lpips(config: TrainConfig) -> tuple[LPIPS | None, str | None]:
    """Loads LPIPS as ``--lpips`` says; the second value tells the user if it is missing.

    Raises:
        UserError: ``--lpips on`` was given and the weights are missing.
    """
    loss = config.loss
    if loss.lpips == "off" or loss.lpips_weight == 0:
        return None, None
    if loss.lpips == "auto" and not lpips_available():
        return None, "no LPIPS weights: training without (gamba weights lpips fetches them)"
    return load_lpips(), None
