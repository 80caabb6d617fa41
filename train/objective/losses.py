"""Training loss of the paper (eq. loss_train).

Every term has one value per view, ``[.., V]``; ``total_loss`` weights and averages them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F
from torch.profiler import record_function

from gamba_warp.cameras import Cameras, view_angles
from gamba_warp.devices import float32_products
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import psnr
from gamba_warp.kernels.ssim import dissimilarity
from gamba_warp.vision.lpips import LPIPS, load_lpips
from gamba_warp.vision.weights import lpips_available

from ..config import LossConfig, TrainConfig
from .radial_mask import contour_distances, project_means, radial_mask_loss

DEPTH_BETA = 0.02  # object units; see ``depth_loss``
# Of the radial mask constraint: its weight at the start and the epochs over which it falls to 0
# (paper, §4.1), but over this fraction of a run at most, so that short runs end without it.
RDIST_WEIGHT, RDIST_EPOCHS, RDIST_SHARE = 0.1, 10.0, 0.25
SLOPE_STEPS, SLOPE_WEIGHT = (1, 2, 4, 8), 1.0  # pixels; beside the distances
NEAR_VIEW = 20.0  # degrees; see ``excess_translucency``


def mse(got: Tensor, want: Tensor) -> Tensor:
    """Average the squared error over height, width, channels: ``[.., H, W, C]`` to ``[..]``."""
    return (got - want).square().mean((-3, -2, -1))


def structure(got: Tensor, want: Tensor) -> Tensor:
    """Compute 1 - SSIM, as defined by ``image_metrics.ssim``, with ``kernels/ssim``.

    Differentiable once, with respect to ``got`` only.

    Args:
        got: ``[.., H, W, C]``, H and W at least 11.
        want: the same shape, values in [0, 1].

    Returns:
        ``[..]``, mean over channels and whole windows, in the dtype of the images.
    """
    return _Structure.apply(got, want)


class _Structure(torch.autograd.Function):
    """Autograd function of ``structure``; the forward pass also computes the slope.

    An image's value depends on no other image, so its gradient is a factor times its slope.
    """

    @staticmethod
    def forward(ctx: Any, got: Tensor, want: Tensor) -> Tensor:
        a, b = (x.reshape(-1, *got.shape[-3:]) for x in (got, want))
        with float32_products():  # a variance is a small difference of two means of products
            values, slope = dissimilarity(a, b, ctx.needs_input_grad[0])
        if slope is not None:
            ctx.save_for_backward(slope.reshape(got.shape))
        return values.reshape(got.shape[:-3])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None]:
        return cotangents[0][..., None, None, None] * ctx.saved_tensors[0], None


def rendered_psnr(got: Tensor, want: Tensor) -> Tensor:
    """PSNR of rendered images, clamped to [0, 1] first.

    Args:
        got: ``[.., H, W, C]``, rendered.
        want: ``[.., H, W, C]`` in [0, 1].

    Returns:
        ``[..]`` float64, dB.
    """
    return psnr(got.clamp(0, 1), want)


def depth_loss(gaussians: Gaussians, layers: int, cameras: Cameras, surfaces: Tensor) -> Tensor:
    """Depth error of the first layer of ``rays`` at the first surface, and of the last at the last.

    A Gaussian is compared at the pixel of its projected centre, by the smooth L1 distance along the
    optical axis: quadratic up to ``DEPTH_BETA`` object units, linear beyond. The same applies to
    the differences between two pixels of a row or a column ``SLOPE_STEPS`` apart, which measure the
    shape of a surface independently of its distance (after the gradient term of Ranftl et al. 2020,
    "Towards Robust Monocular Depth Estimation").

    Args:
        gaussians: ``[B, N]`` of the decoder ``rays``, with adjacent layers.
        layers: number of layers.
        cameras: ``[B]`` of the inputs.
        surfaces: ``[B, 2, h, w]`` depth of the first and of the last surface, 0 where unknown, at
            the size of the cameras' images.

    Returns:
        ``[B]``, the sum over both layers of the mean distance and ``SLOPE_WEIGHT`` times the mean
        difference; 0 where no depth is known.
    """
    height, width = surfaces.shape[-2:]

    def ends(values: Tensor) -> Tensor:
        """First and last layer ``[B, 2, T, ..]`` of values ``[B, N, ..]``."""
        values = values.unflatten(1, (-1, layers))[:, :, :: max(1, layers - 1)].transpose(1, 2)
        return values.expand(-1, 2, *values.shape[2:])

    projected = project_means(ends(gaussians.means).flatten(1, 2), cameras[:, None])
    positions, depths = (x[:, 0].unflatten(1, (2, -1)) for x in projected)
    column, row = positions.detach().floor().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    true = surfaces.flatten(2).gather(2, pixel)
    known = inside & (ends(gaussians.opacities) > 0) & (true > 0)
    errors = (depths - true) * known
    total = _smooth_l1_mean(errors, known, 1)
    empty = torch.zeros_like(surfaces).flatten(2)
    count = empty.scatter_add(2, pixel, known.to(errors.dtype))
    error = empty.scatter_add(2, pixel, errors) / count.clamp_min(1)
    error, valid = (x.unflatten(2, (height, width)) for x in (error, count))
    slopes = _shifted(error) - error[:, :, None]
    both = (_shifted(valid) > 0) & (valid > 0)[:, :, None]
    fraction = SLOPE_WEIGHT / (2 * len(SLOPE_STEPS))
    total = total + fraction * _smooth_l1_mean(slopes, both, 2).sum(-1)
    return total.sum(1)


def _shifted(maps: Tensor) -> Tensor:
    """Return the values ``SLOPE_STEPS`` further down, and to the right; 0 beyond the map.

    Args:
        maps: ``[B, 2, h, w]``.

    Returns:
        ``[B, 2, S, h, w]``.
    """
    height, width = maps.shape[2:]
    padded = F.pad(maps, (0, SLOPE_STEPS[-1], 0, SLOPE_STEPS[-1]))
    down = [padded[:, :, step : step + height, :width] for step in SLOPE_STEPS]
    right = [padded[:, :, :height, step : step + width] for step in SLOPE_STEPS]
    return torch.stack(down + right, 2)


def _smooth_l1_mean(errors: Tensor, known: Tensor, axis: int) -> Tensor:
    """Mean smooth L1 of the known errors, beta ``DEPTH_BETA``, over the axes after ``axis``."""
    zero = errors.new_zeros(()).expand_as(errors)
    losses = F.smooth_l1_loss(errors, zero, beta=DEPTH_BETA, reduction="none")
    sums = ((losses * known).flatten(axis + 1).sum(-1), known.flatten(axis + 1).sum(-1))
    return sums[0] / sums[1].clamp_min(1)


def random_crops(got: Tensor, want: Tensor, alpha: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Crop from both the same square around a random pixel of the object, in a random novel view.

    Uses torch's global generator, whose state is in the checkpoints.

    Args:
        got: ``[B, V, H, W, C]``, the input view first; it is taken if there is no other.
        want: the same shape.
        alpha: ``[B, V, H, W, 1]``, true; without an object in a view any pixel is taken.
        size: side of the squares, pixels; at most H and W.

    Returns:
        Two ``[B, size, size, C]``.
    """
    batch, views, height, width = got.shape[:4]
    each = torch.arange(batch, device=got.device)
    view = torch.randint(min(1, views - 1), views, (batch,), device=got.device)
    inside = (alpha[each, view].flatten(1) > 0.5).float() + 1e-9
    # One draw of each row by its weights, as by torch.multinomial, which reads the device back.
    pixel = (inside / torch.empty_like(inside).exponential_()).argmax(1)
    steps = torch.arange(size, device=got.device)
    rows = (pixel // width - size // 2).clamp(0, height - size)[:, None] + steps
    columns = (pixel % width - size // 2).clamp(0, width - size)[:, None] + steps
    at = each[:, None, None], view[:, None, None], rows[:, :, None], columns[:, None]
    return got[at], want[at]


def translucency(alpha: Tensor) -> Tensor:
    """Compute ``4 alpha (1 - alpha)``: 0 for clear and opaque pixels, 1 for half-transparent ones.

    Args:
        alpha: any shape, in [0, 1].
    """
    return 4 * alpha * (1 - alpha)


def excess_translucency(alpha: Tensor, target: Tensor, cameras: Cameras) -> Tensor:
    """Average the translucency beyond the true one, whose boundaries are half transparent too.

    Args:
        alpha: ``[B, V, H, W, 1]``, rendered; the input view first.
        target: the same shape, true.
        cameras: ``[B, V]``.

    Returns:
        ``[B, V]``; 0 for views at most ``NEAR_VIEW`` degrees from the input.
    """
    excess = (translucency(alpha) - translucency(target)).clamp_min(0).mean((-3, -2, -1))
    return excess * (view_angles(cameras) > NEAR_VIEW)


class LossInputs(NamedTuple):
    """Inputs of the loss terms of a batch.

    Attributes:
        rgb: ``[B, V+1, H, W, 3]``, rendered on the background of ``target``; the input view first.
        alpha: ``[B, V+1, H, W, 1]``, rendered.
        target: as ``rgb``, true.
        target_alpha: as ``alpha``, true.
        lpips: ``(got, want) -> [..]``; None omits this term.
        lpips_crop: if not 0, side of the squares of ``random_crops`` that LPIPS compares.
        gaussians: predicted, ``[B]``.
        cameras: ``[B, V+1]``.
        input_cameras: ``[B]``.
        surfaces: as for ``depth_loss``; None omits this term.
        config: of the model.
    """

    rgb: Tensor
    alpha: Tensor
    target: Tensor
    target_alpha: Tensor
    lpips: Callable[[Tensor, Tensor], Tensor] | None = None
    lpips_crop: int = 0
    gaussians: Any = None
    cameras: Any = None
    input_cameras: Any = None
    surfaces: Tensor | None = None
    config: Any = None

    def compared(self) -> tuple[Tensor, Tensor]:
        """Return the rendered and true images for LPIPS; each call draws new crops."""
        if not self.lpips_crop:
            return self.rgb, self.target
        return random_crops(self.rgb, self.target, self.target_alpha, self.lpips_crop)


class Progress(NamedTuple):
    """Progress of a run.

    Attributes:
        step: optimizer steps done.
        epochs: the same in passes over the objects.
        done: fraction of the run that is done, 0 to 1.
        validates: True for a validation, whose weights are constant: LPIPS from the start, neither
            the radial mask constraint nor depth.
    """

    step: int
    epochs: float
    done: float
    validates: bool = False


class Term(NamedTuple):
    """Term of the loss.

    Attributes:
        weight: by the options and the progress.
        value: ``[B, V+1]``, or ``[B]`` if not per view; None if it cannot be computed.
        label: its name in a profile.
        always: also compute it at weight 0, for the log.
    """

    weight: Callable[[LossConfig, Progress], float]
    value: Callable[[LossInputs], Tensor | None]
    label: str
    always: bool = False


def radial_weight(loss: LossConfig, at: Progress) -> float:
    """Return the radial mask constraint's weight, which falls linearly to 0.

    It falls over ``RDIST_EPOCHS``, but over ``RDIST_SHARE`` of the run at most; 0 without the
    constraint, and in a validation.
    """
    left = 1.0 - max(at.epochs / RDIST_EPOCHS, at.done / RDIST_SHARE)
    return RDIST_WEIGHT * max(0.0, left) if loss.radial_mask and not at.validates else 0.0


# In the order of summation. A script may add to it (docs/train-your-own.md).
TERMS: dict[str, Term] = {
    "rgb": Term(lambda loss, at: 1.0, lambda s: mse(s.rgb, s.target), "MSE and mask", True),
    "mask": Term(
        lambda loss, at: 1.0,
        lambda s: mse(s.alpha, s.target_alpha),
        "MSE and mask",
        True,
    ),
    "lpips": Term(
        lambda loss, at: loss.lpips_weight if at.validates or at.step >= loss.lpips_after else 0.0,
        lambda s: None if s.lpips is None else s.lpips(*s.compared()),
        "LPIPS",
    ),
    "ssim": Term(lambda loss, at: loss.ssim_weight, lambda s: structure(s.rgb, s.target), "SSIM"),
    "depth": Term(
        lambda loss, at: 0.0 if at.validates else loss.depth_weight,
        lambda s: (
            None
            if s.surfaces is None
            else depth_loss(s.gaussians, s.config.ray_layers, s.input_cameras, s.surfaces)
        ),
        "depth",
    ),
    "mask_l1": Term(
        lambda loss, at: 0.0 if at.validates else loss.mask_l1_weight,
        lambda s: (s.alpha - s.target_alpha).abs().mean((-3, -2, -1)),
        "mask L1",
    ),
    "translucency": Term(
        lambda loss, at: 0.0 if at.validates else loss.translucency_weight,
        lambda s: excess_translucency(s.alpha, s.target_alpha, s.cameras),
        "translucency",
    ),
    "rdist": Term(
        radial_weight,
        lambda s: radial_mask_loss(
            s.gaussians.means, s.cameras, contour_distances(s.target_alpha[..., 0])
        ),
        "radial mask",
    ),
}


def term_weights(loss: LossConfig, at: Progress) -> dict[str, float]:
    """Return the weight of each of ``TERMS``, and as ``novel`` the novel views' weight."""
    weights = {name: term.weight(loss, at) for name, term in TERMS.items()}
    return weights | {"novel": loss.novel_weight}


def loss_terms(inputs: LossInputs, weights: Mapping[str, Any]) -> dict[str, Tensor]:
    """Compute the terms with a nonzero weight or a tensor's, and those always computed."""
    terms = {}
    for name, term in TERMS.items():
        weight = weights.get(name)
        if term.always or isinstance(weight, Tensor) or weight:
            with record_function(term.label):
                value = term.value(inputs)
            if value is not None:
                terms[name] = value
    return terms


def total_loss(terms: Mapping[str, Tensor], weights: Mapping[str, Any]) -> Tensor:
    """Sum the weighted terms, averaged over all views and objects, to a scalar.

    Raises:
        KeyError: a term has no weight.
    """
    return torch.stack([weights[name] * term.mean() for name, term in terms.items()]).sum()


# Measured in docs/train-your-own.md, with the command.
COST = (
    "LPIPS of whole images makes a step on a CPU 5 to 15 times as long: --lpips off leaves "
    "it out, --lpips-crop 64 compares a part"
)


def open_lpips(config: TrainConfig, device: str) -> tuple[LPIPS | None, str | None]:
    """Load LPIPS according to ``--lpips``; also return a note about "auto" for the user.

    Args:
        config: of the run.
        device: type of the training device, ``cpu`` or ``cuda``.

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
    lpips, slow = load_lpips(), loss.lpips == "auto" and device == "cpu" and not loss.lpips_crop
    return lpips, COST if slow else None
