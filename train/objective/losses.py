"""The training loss of the paper (eq. loss_train).

Every term has one value per view, ``[.., V]``; ``total_loss`` weighs and averages them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad, smooth_l1_loss
from torch.profiler import record_function

from gamba_warp.cameras import Cameras
from gamba_warp.devices import float32_products
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import SSIM_SIGMA, SSIM_WINDOW, psnr
from gamba_warp.kernels.ssim import dissimilarity
from gamba_warp.vision.lpips import LPIPS, load_lpips
from gamba_warp.vision.weights import lpips_available

from ..config import TrainConfig
from .radial_mask import project_means

DEPTH_BEND = 0.02  # object units; see ``depth_loss``
_C1, _C2 = 0.01**2, 0.03**2  # of SSIM, for pictures in [0, 1]
_TILE = 32  # columns of a banded product of SSIM
_CACHED = 1 << 17  # numbers of the pictures that a CPU takes together for SSIM, two of 128²


def mse(got: Tensor, want: Tensor) -> Tensor:
    """Averages the squared error over height, width, channels: ``[.., H, W, C]`` to ``[..]``."""
    return (got - want).square().mean((-3, -2, -1))


def structure(got: Tensor, want: Tensor) -> Tensor:
    """Computes 1 - SSIM, as ``image_metrics.ssim`` defines it.

    With s = got + want and d = got - want, SSIM needs the windowed means of s, d, s² and d² alone:
    2ab = (s² - d²) / 2 and a² + b² = (s² + d²) / 2, for the means and for the variances alike. The
    gradient reaches ``got`` only, and has no gradient of its own.

    Args:
        got: ``[.., H, W, C]``, H and W at least 11.
        want: the same shape, values in [0, 1].

    Returns:
        ``[..]``, mean over channels and whole windows, in the dtype of the pictures.
    """
    return _Structure.apply(got, want)


class _Structure(torch.autograd.Function):
    """``structure``, whose gradient is computed with its value.

    A picture's value depends on no other picture, so its gradient is a factor times its slope. On a
    CPU float32 has a kernel of its own (``kernels/ssim``); the rest of this file's SSIM is for GPUs
    and other dtypes.
    """

    @staticmethod
    def forward(ctx: Any, got: Tensor, want: Tensor) -> Tensor:
        lead, shape = got.shape[:-3], got.shape[-3:]
        if got.device.type == "cpu" and got.dtype == want.dtype == torch.float32:
            a, b = (x.detach().reshape(-1, *shape) for x in (got, want))
            made, slope = dissimilarity(a, b, ctx.needs_input_grad[0])
            if slope is not None:
                ctx.save_for_backward(slope.view(got.shape))
            return made.reshape(lead)
        pictures, truths = (
            x.detach().reshape(-1, *shape).movedim(-1, 1).contiguous() for x in (got, want)
        )
        band = _band(pictures)
        slopes = torch.zeros_like(pictures) if ctx.needs_input_grad[0] else None
        size = max(1, len(pictures))
        if pictures.device.type == "cpu":
            size = max(1, _CACHED // max(1, math.prod(pictures.shape[1:])))
        values = []
        with float32_products():  # a variance is the small difference of two means of products
            for i in range(0, len(pictures), size):
                part = slice(i, i + size)
                slope = None if slopes is None else slopes[part]
                values.append(_unequal(pictures[part], truths[part], band, slope))
        if slopes is not None:
            ctx.save_for_backward(slopes.movedim(1, -1).reshape(got.shape))
        return torch.cat(values).reshape(lead) if values else pictures.new_zeros(lead)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None]:
        return cotangents[0][..., None, None, None] * ctx.saved_tensors[0], None


def _unequal(got: Tensor, want: Tensor, band: Tensor, slope: Tensor | None) -> Tensor:
    """1 - SSIM of ``[n, C, H, W]``: ``[n]``; its derivative goes into ``slope``, if that is given.

    Windows in which the pictures are equal, as they are on the background, add 0 and have no
    slope. A CPU leaves out the rows and columns that lie in no other window.
    """
    count = got.shape[1] * (got.shape[2] - SSIM_WINDOW + 1) * (got.shape[3] - SSIM_WINDOW + 1)
    if got.device.type == "cpu":
        box = _box((got != want).flatten(0, 1).any(0))
        if box is None:
            return got.new_zeros(len(got))
        got, want = got[..., box[0], box[1]], want[..., box[0], box[1]]
        slope = None if slope is None else slope[..., box[0], box[1]]
    # The variances do not depend on a constant. Without the background, which a corner has as a
    # rule, those of flat regions are no differences of large numbers.
    shift = 2 * want[..., :1, :1]
    maps = got.new_empty(4, *got.shape)
    torch.sub(torch.add(got, want, out=maps[0]), shift, out=maps[0])
    torch.sub(got, want, out=maps[1])
    torch.mul(maps[:2], maps[:2], out=maps[2:])
    means = _window_means(maps, band)
    s, d = means[0] + shift, means[1]
    variances = means[2:] - means[:2].square()
    bright, dark = s.square() + _C1 * 2, d.square()
    rough, odd = variances[0] + _C2 * 2, variances[1]
    light, shape = (bright - dark) / (bright + dark), (rough - odd) / (rough + odd)
    if slope is not None:
        # of the value by the means of s and d together, of s², and of d²
        by = torch.empty_like(means[:3])
        factor = light * (-2 / count) / (rough + odd).square()
        torch.mul(factor, odd, out=by[1])
        torch.mul(factor, -rough, out=by[2])
        factor = shape * (-4 / count) / (bright + dark).square()
        by[0] = factor * (dark * s - bright * d) - 2 * (by[1] * means[0] + by[2] * d)
        edge = SSIM_WINDOW - 1  # the window is symmetric, so its transpose is itself, padded
        back = _window_means(pad(by, (edge,) * 4), band)
        slope.copy_(back[0] + 2 * (maps[0] * back[1] + maps[1] * back[2]))
    return (1 - light * shape).sum((1, 2, 3)) / count


def _box(unequal: Tensor) -> tuple[slice, slice] | None:
    """The rows and columns of all windows that hold a True of ``[H, W]``; None if there is none."""
    sides = []
    for axis in (1, 0):
        places = unequal.any(axis).nonzero()[:, 0].tolist()
        if not places:
            return None
        reach = SSIM_WINDOW - 1
        sides.append(slice(max(0, places[0] - reach), places[-1] + reach + 1))
    return sides[0], sides[1]


def _band(like: Tensor) -> Tensor:
    """SSIM's Gaussian window as the band of a matrix: ``[_TILE + 10, _TILE]``."""
    rows = torch.arange(_TILE + SSIM_WINDOW - 1, device=like.device)  # no copy from the host
    places = (rows[:, None] - rows[:_TILE]).double()
    weights = torch.exp(-(places - SSIM_WINDOW // 2).square() / (2 * SSIM_SIGMA**2))
    weights = torch.where((places >= 0) & (places < SSIM_WINDOW), weights, 0.0)
    return (weights / weights[:SSIM_WINDOW, 0].sum()).to(like.dtype)


def _window_means(maps: Tensor, band: Tensor) -> Tensor:
    """Means over SSIM's window, ``[.., H, W]`` to ``[.., H - 10, W - 10]``, by products.

    A matrix for whole rows would be zeros but for its band, so a product makes ``_TILE`` columns.
    """
    edge, lead = SSIM_WINDOW - 1, maps.shape[:-2]
    planes = maps.reshape(-1, *maps.shape[-2:])
    for axis in (2, 1):
        total = planes.shape[axis] - edge
        parts = []
        for start in range(0, total, _TILE):
            size = min(_TILE, total - start)
            piece, tile = planes.narrow(axis, start, size + edge), band[: size + edge, :size]
            parts.append(piece @ tile if axis == 2 else tile.mT @ piece)
        planes = torch.cat(parts, axis)
    return planes.unflatten(0, lead)


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
