"""The training loss of the paper (eq. loss_train).

Every term has one value per view, ``[.., V]``; ``total_loss`` weighs and averages them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import smooth_l1_loss
from torch.profiler import record_function

from gamba_warp.cameras import Cameras
from gamba_warp.devices import float32_products
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import psnr
from gamba_warp.kernels.ssim import dissimilarity
from gamba_warp.vision.lpips import LPIPS, load_lpips
from gamba_warp.vision.weights import lpips_available

from ..config import TrainConfig
from .radial_mask import project_means

DEPTH_BEND = 0.02  # object units; see ``depth_loss``


def mse(got: Tensor, want: Tensor) -> Tensor:
    """Averages the squared error over height, width, channels: ``[.., H, W, C]`` to ``[..]``."""
    return (got - want).square().mean((-3, -2, -1))


def structure(got: Tensor, want: Tensor) -> Tensor:
    """Computes 1 - SSIM, as ``image_metrics.ssim`` defines it, by ``kernels/ssim``.

    The gradient reaches ``got`` only, and has no gradient of its own.

    Args:
        got: ``[.., H, W, C]``, H and W at least 11.
        want: the same shape, values in [0, 1].

    Returns:
        ``[..]``, mean over channels and whole windows, in the dtype of the pictures.
    """
    return _Structure.apply(got, want)


class _Structure(torch.autograd.Function):
    """``structure``, whose gradient is computed with its value.

    A picture's value depends on no other picture, so its gradient is a factor times its slope.
    """

    @staticmethod
    def forward(ctx: Any, got: Tensor, want: Tensor) -> Tensor:
        a, b = (x.reshape(-1, *got.shape[-3:]) for x in (got, want))
        with float32_products():  # a variance is the small difference of two means of products
            values, slope = dissimilarity(a, b, ctx.needs_input_grad[0])
        if slope is not None:
            ctx.save_for_backward(slope.reshape(got.shape))
        return values.reshape(got.shape[:-3])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None]:
        return cotangents[0][..., None, None, None] * ctx.saved_tensors[0], None


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

    Each is ``[.., V]``, but ``lpips`` of crops is ``[..]``. The marks are for a profile.

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
    with record_function("MSE and mask"):
        terms = {"rgb": mse(rgb, target_rgb), "mask": mse(alpha, target_alpha)}
    if lpips is not None:
        with record_function("LPIPS"):
            pair = random_crops(rgb, target_rgb, lpips_crop) if lpips_crop else (rgb, target_rgb)
            terms["lpips"] = lpips(*pair)
    if ssim:
        with record_function("SSIM"):
            terms["ssim"] = structure(rgb, target_rgb)
    return terms


def depth_loss(gaussians: Gaussians, layers: int, cameras: Cameras, surfaces: Tensor) -> Tensor:
    """How far the first layer of ``rays`` is from the first surface, and the last from the last.

    A Gaussian is compared at the pixel that its centre falls on, by the distance along the optical
    axis: quadratically up to ``DEPTH_BEND`` object units, and linearly beyond.

    Args:
        gaussians: ``[B, N]``, as the decoder ``rays`` makes them: its layers lie side by side.
        layers: number of these.
        cameras: ``[B]`` of the inputs.
        surfaces: ``[B, 2, h, w]`` depth of the first and of the last surface, 0 where none is
            known; pictures of the size that the cameras have.

    Returns:
        ``[B]``, the sum of the means over both layers; 0 where no depth is known.
    """
    height, width = surfaces.shape[-2:]
    places, depths = project_means(gaussians.means, cameras[:, None])
    column, row = places[:, 0].detach().floor().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    means = []
    for layer, surface in zip((0, layers - 1), surfaces.unbind(1)):
        of = (slice(None), slice(layer, None, layers))
        true = surface.flatten(1).gather(1, pixel[of])
        known = inside[of] & (gaussians.opacities[of] > 0) & (true > 0)
        gaps = smooth_l1_loss(depths[:, 0][of], true, beta=DEPTH_BEND, reduction="none")
        means.append((gaps * known).sum(1) / known.sum(1).clamp_min(1))
    return means[0] + means[1]


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


# From docs/train-your-own.md, which has the command.
COST = (
    "LPIPS of whole pictures makes a step on a CPU 5 to 15 times as long: --lpips off leaves "
    "it out, --lpips-crop 64 compares a part"
)


def open_lpips(config: TrainConfig, device: str) -> tuple[LPIPS | None, str | None]:
    """Loads LPIPS as ``--lpips`` says; the second value tells the user what "auto" came to.

    Args:
        config: of the run.
        device: type of the device that trains, ``cpu`` or ``cuda``.

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
    found, slow = load_lpips(), loss.lpips == "auto" and device == "cpu" and not loss.lpips_crop
    return found, COST if slow else None
