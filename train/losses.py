"""The training loss of the paper (eq. loss_train).

Every term has one value per view, ``[.., V]``; ``total_loss`` weighs and averages them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from gamba_warp.data.vgg_weights import lpips_available
from gamba_warp.image_metrics import SSIM_SIGMA, SSIM_WINDOW, psnr
from gamba_warp.model.lpips import LPIPS, load_lpips

from .config import TrainConfig

_C1, _C2 = 0.01**2, 0.03**2  # of SSIM, for pictures in [0, 1]


def mse(got: Tensor, want: Tensor) -> Tensor:
    """Averages the squared error over height, width, channels: ``[.., H, W, C]`` to ``[..]``."""
    return (got - want).square().mean((-3, -2, -1))


def structure(got: Tensor, want: Tensor) -> Tensor:
    """Computes 1 - SSIM, as ``image_metrics.ssim`` defines it.

    With s = got + want and d = got - want, SSIM needs the windowed means of s, d, s² and d² alone:
    2ab = (s² - d²) / 2 and a² + b² = (s² + d²) / 2, for the means and for the variances alike.

    Args:
        got: ``[.., H, W, C]``, H and W at least 11.
        want: the same shape, values in [0, 1].

    Returns:
        ``[..]``, mean over channels and whole windows, in the dtype of the pictures.
    """
    lead, channels = got.shape[:-3], got.shape[-1]
    # The variances do not depend on a constant. Without the background, which a corner has as a
    # rule, those of flat regions are no differences of large numbers.
    corner = want[..., :1, :1, :]
    sums, differences = got + want - 2 * corner, got - want
    planes = torch.stack([sums, differences]).movedim(-1, 1).reshape(-1, 1, *got.shape[-3:-1])
    found = _window_means(torch.cat([planes, planes.square()])).unflatten(0, (2, 2, channels, -1))
    means, squares = found
    variances = squares - means.square()
    shift = 2 * corner.reshape(-1, channels, 1, 1).transpose(0, 1)
    s, d = (means[0] + shift).square(), means[1].square()
    light = (s - d + 2 * _C1) / (s + d + 2 * _C1)
    shape = (variances[0] - variances[1] + 2 * _C2) / (variances[0] + variances[1] + 2 * _C2)
    return 1 - (light * shape).mean((0, 2, 3)).reshape(lead)


def _window_means(planes: Tensor) -> Tensor:
    """Means over SSIM's Gaussian window: ``[M, 1, H, W]`` to ``[M, H - 10, W - 10]``."""
    places = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    weights = torch.exp(-places.square() / (2 * SSIM_SIGMA**2))
    weights = (weights / weights.sum()).to(planes)
    # As channels of one picture the planes take the fast path for depthwise convolutions.
    planes, count = planes.transpose(0, 1), len(planes)
    for kernel in (weights[None], weights[:, None]):
        planes = conv2d(planes, kernel.expand(count, 1, -1, -1), groups=count)
    return planes[0]


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
    lpips_crop: int = 0,
    ssim: bool = False,
) -> dict[str, Tensor]:
    """Computes the terms of pictures: ``rgb`` and ``mask`` (MSE), ``lpips``, ``ssim`` (1 - SSIM).

    Each is ``[.., V]``, but ``lpips`` of crops is ``[..]``.

    Args:
        rgb: ``[.., V, H, W, 3]``, on the background of ``target_rgb``.
        alpha: ``[.., V, H, W, 1]``.
        target_rgb: as ``rgb``.
        target_alpha: as ``alpha``.
        lpips: ``(got, want) -> [.., V]``, or None to leave this term out.
        lpips_crop: if not 0, side of the square that it sees, of one view of each object; see
            ``random_crops``.
        ssim: whether that term is computed.
    """
    terms = {"rgb": mse(rgb, target_rgb), "mask": mse(alpha, target_alpha)}
    if lpips is not None:
        pair = random_crops(rgb, target_rgb, lpips_crop) if lpips_crop else (rgb, target_rgb)
        terms["lpips"] = lpips(*pair)
    if ssim:
        terms["ssim"] = structure(rgb, target_rgb)
    return terms


def random_crops(got: Tensor, want: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The same random square of the same random view of each object, from both.

    Chance is torch's own, whose state a checkpoint holds.

    Args:
        got: ``[B, V, H, W, C]``.
        want: the same shape.
        size: side of the squares, pixels; at most H and W.

    Returns:
        Two ``[B, size, size, C]``.
    """
    batch, views, height, width = got.shape[:4]
    limits = torch.tensor([views, height - size + 1, width - size + 1])
    places = (torch.rand(batch, 3) * limits).long().tolist()
    crops = [
        torch.stack([p[i, v, y : y + size, x : x + size] for i, (v, y, x) in enumerate(places)])
        for p in (got, want)
    ]
    return crops[0], crops[1]


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
    if loss.lpips == "auto" and config.views.size < 16:
        return None, "training without LPIPS, which needs --size 16 or more"
    if loss.lpips == "auto" and not lpips_available():
        return None, "no LPIPS weights: training without (gamba weights lpips fetches them)"
    return load_lpips(), None
