"""The training loss of the paper (eq. loss_train).

Every term has one value per view, ``[.., V]``; ``total_loss`` weighs and averages them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

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

from ..config import LossConfig, TrainConfig
from .radial_mask import contour_distances, project_means, radial_mask_loss

DEPTH_BEND = 0.02  # object units; see ``depth_loss``
SLOPE_STEPS, SLOPE_WEIGHT = (1, 2, 4, 8), 1.0  # pixels; beside the distances


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


def depth_loss(gaussians: Gaussians, layers: int, cameras: Cameras, surfaces: Tensor) -> Tensor:
    """How far the first layer of ``rays`` is from the first surface, and the last from the last.

    A Gaussian is compared at the pixel that its centre falls on, by the distance along the optical
    axis: quadratically up to ``DEPTH_BEND`` object units, and linearly beyond. So are the
    differences between two pixels of a row or a column that lie ``SLOPE_STEPS`` apart: they tell
    the form of a surface apart from its distance (after the gradient term of Ranftl et al. 2020,
    "Towards Robust Monocular Depth Estimation").

    Args:
        gaussians: ``[B, N]``, as the decoder ``rays`` makes them: its layers lie side by side.
        layers: number of these.
        cameras: ``[B]`` of the inputs.
        surfaces: ``[B, 2, h, w]`` depth of the first and of the last surface, 0 where none is
            known; pictures of the size that the cameras have.

    Returns:
        ``[B]``, over both layers the mean of the distances and ``SLOPE_WEIGHT`` times that of the
        differences; 0 where no depth is known.
    """
    height, width = surfaces.shape[-2:]
    places, depths = project_means(gaussians.means, cameras[:, None])
    column, row = places[:, 0].detach().floor().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    total = surfaces.new_zeros(len(surfaces))
    for layer, surface in zip((0, layers - 1), surfaces.flatten(2).unbind(1)):
        of = (slice(None), slice(layer, None, layers))
        true = surface.gather(1, pixel[of])
        known = inside[of] & (gaussians.opacities[of] > 0) & (true > 0)
        gaps = (depths[:, 0][of] - true) * known
        total = total + _bent_mean(gaps, known)
        empty = torch.zeros_like(surface)
        count = empty.scatter_add(1, pixel[of], known.to(gaps.dtype)).view(-1, height, width)
        gap = empty.scatter_add(1, pixel[of], gaps).view(-1, height, width) / count.clamp_min(1)
        seen = count > 0
        for step in SLOPE_STEPS:
            for axis in (1, 2):
                rest = gap.shape[axis] - step
                rises = gap.narrow(axis, step, rest) - gap.narrow(axis, 0, rest)
                both = seen.narrow(axis, step, rest) & seen.narrow(axis, 0, rest)
                share = SLOPE_WEIGHT / (2 * len(SLOPE_STEPS))
                total = total + share * _bent_mean(rises, both)
    return total


def _bent_mean(gaps: Tensor, known: Tensor) -> Tensor:
    """The mean of the known errors, quadratic up to ``DEPTH_BEND``: ``[B, ..]`` to ``[B]``."""
    bent = smooth_l1_loss(gaps, torch.zeros_like(gaps), beta=DEPTH_BEND, reduction="none")
    return (bent * known).flatten(1).sum(1) / known.flatten(1).sum(1).clamp_min(1)


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


class Seen(NamedTuple):
    """What the terms of a batch are computed from.

    Attributes:
        rgb: ``[B, V+1, H, W, 3]``, rendered on the background of ``target``; the input view first.
        alpha: ``[B, V+1, H, W, 1]``, rendered.
        target: as ``rgb``, true.
        target_alpha: as ``alpha``, true.
        lpips: ``(got, want) -> [..]``; None leaves this term out.
        lpips_crop: if not 0, side of the square that it sees, of one view of each object; see
            ``random_crops``.
        gaussians: predicted, ``[B]``.
        cameras: ``[B, V+1]``.
        input_cameras: ``[B]``.
        surfaces: as for ``depth_loss``; None leaves this term out.
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
        """The pictures that LPIPS compares, rendered and true; each call draws other crops."""
        pair = self.rgb, self.target
        return random_crops(*pair, self.lpips_crop) if self.lpips_crop else pair


class Moment(NamedTuple):
    """Where a run stands.

    Attributes:
        step: optimizer steps done.
        epochs: the same in passes over the objects.
        done: share of the run that is done, 0 to 1.
        validates: whether it is asked for a validation, whose weights are the same all along:
            LPIPS from the start, neither the radial mask constraint nor depth.
    """

    step: int
    epochs: float
    done: float
    validates: bool = False


class Term(NamedTuple):
    """A term of the loss.

    Attributes:
        weight: by the options, at a moment.
        value: ``[B, V+1]``, or ``[B]`` where it is not of views; None where it cannot be computed.
        mark: its name in a profile.
        always: whether it is computed at weight 0, too, for the log.
    """

    weight: Callable[[LossConfig, Moment], float]
    value: Callable[[Seen], Tensor | None]
    mark: str
    always: bool = False


def radial_weight(loss: LossConfig, at: Moment) -> float:
    """Returns the radial mask constraint's weight, which falls linearly to 0.

    It falls over ``rdist_steps``, or else over ``rdist_epochs``, but in ``rdist_share`` of the run
    at most; 0 without the constraint, and in a validation.
    """
    spans = [(at.epochs, loss.rdist_epochs), (at.done, loss.rdist_share)]
    if loss.rdist_steps is not None:
        spans = [(at.step, loss.rdist_steps)]
    left = min(1.0 - now / span if span > 0 else 0.0 for now, span in spans)
    return loss.rdist_weight * max(0.0, left) if loss.radial_mask and not at.validates else 0.0


# In the order in which they are added up. A new term is one entry here, and its weight an option.
TERMS: dict[str, Term] = {
    "rgb": Term(lambda loss, at: 1.0, lambda s: mse(s.rgb, s.target), "MSE and mask", True),
    "mask": Term(
        lambda loss, at: loss.mask_weight,
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
    "rdist": Term(
        radial_weight,
        lambda s: radial_mask_loss(
            s.gaussians.means, s.cameras, contour_distances(s.target_alpha[..., 0])
        ),
        "radial mask",
    ),
}


def term_weights(loss: LossConfig, at: Moment) -> dict[str, float]:
    """Returns the weight of each of ``TERMS``, and as ``novel`` that of the novel views."""
    weights = {name: term.weight(loss, at) for name, term in TERMS.items()}
    return weights | {"novel": loss.novel_weight}


def loss_terms(seen: Seen, weights: Mapping[str, float]) -> dict[str, Tensor]:
    """Computes the terms whose weight is not 0, and those that are always computed."""
    found = {}
    for name, term in TERMS.items():
        if term.always or weights.get(name):
            with record_function(term.mark):
                value = term.value(seen)
            if value is not None:
                found[name] = value
    return found


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
