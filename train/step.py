"""Computations on batches: losses, gradients, the model's health, and the validation."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from gamba_warp.cameras import view_angles
from gamba_warp.conventions import GROUNDS, WHITE, over_another, over_background
from gamba_warp.devices import network_precision
from gamba_warp.gaussians import Gaussians
from gamba_warp.image_metrics import all_figures, mask_iou, measure
from gamba_warp.model.gamba import Gamba
from gamba_warp.render import Rendering, render
from gamba_warp.vision.lpips import LPIPS

from .data.samples import Batch
from .objective.losses import LossInputs, loss_terms, rendered_psnr, total_loss, translucency
from .objective.radial_mask import NEAR, project_means
from .optim import Ema

VISIBLE_OPACITY = 0.01  # under this a Gaussian changes no 8-bit pixel by more than two steps
FAR_VIEW, CLEAR = 60.0, 0.02  # degrees; alpha: see ``_far_figures``
STRIP_VIEWS, STRIP_OBJECTS = 6, 4  # views and objects of a validation's sample pictures


class Objective(NamedTuple):
    """Objective of the training.

    Attributes:
        weights: result of ``term_weights``; missing names have weight 0, except ``novel``, the
            weight of each novel view relative to the input view in all terms with one value per
            view, which defaults to 1. A weight other than ``novel`` may be a scalar tensor on the
            device, whose value is not looked at.
        lpips: ``(got, want) -> [.., V]``, used if its weight is not 0.
        lpips_crop: as for ``LossInputs``.
        precision: dtype of the products in the network, and of those in LPIPS that tolerate it;
            everything else is float32.
    """

    weights: Mapping[str, Any]
    lpips: Callable[[Tensor, Tensor], Tensor] | None = None
    lpips_crop: int = 0
    precision: torch.dtype = torch.float32


@dataclass
class StepResult:
    """Result of ``forward``.

    Attributes:
        loss: scalar, with its graph.
        terms: unweighted terms by name, each ``[B, V+1]``.
        gaussians: predicted Gaussians, ``[B]``.
        rendering: their pictures, ``[B, V+1]``.
        target: true pictures on the batch's background, ``[B, V+1, H, W, 3]``.
    """

    loss: Tensor
    terms: dict[str, Tensor]
    gaussians: Gaussians
    rendering: Rendering
    target: Tensor


def forward(model: Callable, batch: Batch, objective: Objective) -> StepResult:
    """Predict, render all V+1 views and compute the loss (paper eq. loss_train).

    Args:
        model: ``Gamba`` or a wrapper of it.
        batch: a batch on the model's device.
        objective: loss weights and LPIPS.
    """
    weights, lpips, crop, precision = objective
    with network_precision(batch.inputs.device, precision):
        own = {} if batch.foreground is None else {"foreground": batch.foreground}
        gaussians = model(batch.inputs, batch.input_cameras, **own)
    rendering = render(gaussians, batch.cameras, batch.background)
    target = over_background(batch.targets, batch.background[..., None, None, :])
    inputs = LossInputs(
        rendering.rgb,
        rendering.alpha,
        target,
        batch.targets[..., 3:],
        partial(lpips, precision=precision) if isinstance(lpips, LPIPS) else lpips,
        crop,
        gaussians,
        batch.cameras,
        batch.input_cameras,
        batch.surfaces,
        getattr(getattr(model, "module", model), "config", None),  # DDP wraps the model
    )
    terms = loss_terms(inputs, weights)
    weighted = weigh_views(terms, weights.get("novel", 1.0), target.shape[1])
    return StepResult(total_loss(weighted, weights), terms, gaussians, rendering, target)


def weigh_views(terms: dict[str, Tensor], novel: float, views: int) -> dict[str, Tensor]:
    """Scale the terms so that their mean over the views is a weighted one.

    Args:
        terms: by name, ``[B, V+1]`` with the input view first; other shapes are unchanged.
        novel: weight of each novel view against the input view, >= 0.
        views: V+1.
    """
    if novel == 1:
        return terms
    first = views / (1 + novel * (views - 1))  # the later mean divides by the number of views
    shares = terms["rgb"].new_full((views,), novel * first)
    shares[:1].fill_(first)
    whole = {name: term for name, term in terms.items() if term.ndim == 2}  # not LPIPS of crops
    return terms | {name: term * shares for name, term in whole.items()}


class Gradients(NamedTuple):
    """Result of ``compute_gradients``; the gradients themselves are in the parameters.

    Attributes:
        loss: scalar, the mean over the batches, without a graph.
        norm: scalar, the norm of the gradient before clipping.
        batch: the last batch.
        result: result of ``forward`` on the last batch.
    """

    loss: Tensor
    norm: Tensor
    batch: Batch
    result: StepResult


def compute_gradients(
    model: Callable,
    optimizer: torch.optim.Optimizer,
    batches: Iterable[Batch],
    objective: Objective,
    *,
    clip: float,
    count: int = 1,
) -> Gradients:
    """Set the parameters' gradients to the gradients of the mean loss over some batches; clip them.

    Several processes exchange their gradients once, with the last batch.

    Args:
        model: ``Gamba`` or a wrapper of it.
        optimizer: the optimizer whose parameters get gradients; no step is made here.
        batches: ``count`` batches on the model's device.
        objective: as for ``forward``.
        clip: largest norm of the gradient.
        count: number of batches, >= 1.
    """
    optimizer.zero_grad(set_to_none=True)
    losses = []
    for number, batch in enumerate(batches):
        hold = contextlib.nullcontext()
        if number < count - 1 and isinstance(model, DistributedDataParallel):
            hold = model.no_sync()
        with hold:
            result = forward(model, batch, objective)
            (result.loss / count).backward()
        losses.append(result.loss.detach())
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    norm = torch.nn.utils.clip_grad_norm_(parameters, clip)
    return Gradients(torch.stack(losses).mean(), norm, batch, result)


def update(
    optimizer: torch.optim.Optimizer,
    ema: Ema | None,
    share: float | Tensor,
    made: Gradients,
    model: Callable,
) -> Tensor:
    """Update the weights, unless loss or gradient is not finite on any process.

    The device itself skips such a step, so the host need not wait for it.

    Args:
        optimizer: fused AdamW.
        ema: the average of the weights, which is updated, too; or None.
        share: ``ema.next_share()``, or a scalar tensor of it on the device.
        made: the gradients, which the parameters have.
        model: as for ``compute_gradients``.

    Returns:
        ``[3]``: loss, norm of the gradient, and 1 if the step was skipped.
    """
    numbers = torch.stack([made.loss, made.norm])
    bad = 1 - numbers.isfinite().all().float()
    if isinstance(model, DistributedDataParallel):  # all processes must act alike
        dist.all_reduce(bad, dist.ReduceOp.MAX, model.process_group)
    vars(optimizer)["found_inf"] = bad  # as torch.amp.GradScaler sets it
    optimizer.step()
    if ema is not None:
        ema.update((1 - bad) * share)
    return torch.cat([numbers, bad[None]])


@torch.no_grad()
def health(result: StepResult, batch: Batch) -> dict[str, Tensor]:
    """Compute scalars that show a collapse before the loss does.

    Returns:
        ``psnr`` of the batch in dB; ``mean_alpha`` of the rendered and ``target_alpha`` of the true
        pictures, both in [0, 1]; ``visible_share``, the share of Gaussians that are not transparent
        and project into some view; ``spread``, the rms distance of the centres from their mean in
        object units.
    """
    means = result.gaussians.means
    positions, depths = project_means(means, batch.cameras)
    size = positions.new_tensor([batch.cameras.width, batch.cameras.height])
    seen = ((positions >= 0) & (positions <= size)).all(-1) & (depths > NEAR)
    visible = seen.any(-2) & (result.gaussians.opacities > VISIBLE_OPACITY)
    centred = means - means.mean(-2, keepdim=True)
    return {
        "psnr": rendered_psnr(result.rendering.rgb, result.target).mean(),
        "mean_alpha": result.rendering.alpha.mean(),
        "target_alpha": batch.targets[..., 3].mean(),
        "visible_share": visible.float().mean(),
        "spread": centred.square().sum(-1).mean(-1).sqrt().mean(),
    }


def collapse_reason(figures: Mapping[str, float]) -> str | None:
    """Describe a collapse by the figures of ``health`` in one line; None without one."""
    if figures["target_alpha"] > 0 and figures["mean_alpha"] < 0.1 * figures["target_alpha"]:
        return f"the pictures are almost empty (mean alpha {figures['mean_alpha']:.2g})"
    if figures["visible_share"] < 0.02:
        return f"almost no Gaussian is visible (share {figures['visible_share']:.2g})"
    if figures["spread"] < 0.01:
        return f"the Gaussians sit in one point (spread {figures['spread']:.2g})"
    return None


@torch.no_grad()
def validate(
    model: Gamba, batches: Iterable[Batch], objective: Objective, device: torch.device
) -> tuple[dict[str, float], list[Tensor]]:
    """Compute the validation's figures, as means over objects in float32.

    Args:
        model: the model; switched to eval mode, and back.
        batches: batches of one object each on white, the input view first, from
            ``fixed_batches``.
        objective: as for ``forward``.
        device: the model's device.

    Returns:
        Figures: ``loss``; ``psnr`` (dB), ``ssim``, ``mask_iou`` and, if given, ``lpips`` of whole
        pictures on white; ``psnr_black`` and ``psnr_grey`` on these backgrounds (LPIPS on them
        would nearly triple the time). All but ``loss`` end in ``_input`` for the input view and
        ``_novel`` for the mean over the others, if any; pictures under 11x11 have no ``ssim``.
        And rows ``[V, H, W, 3]`` for ``strip_of``, true above predicted for the first objects.
    """
    was_training = model.training
    model.eval()
    sums: dict[str, list[float]] = {}
    rows: list[Tensor] = []
    for batch in batches:
        batch = batch.to(device)
        result = forward(model, batch, objective)
        measures = _measures(result, batch, objective.lpips)
        figures = {"loss": result.loss.item()}
        for key, values in measures.items():
            figures[f"{key}_input"] = values[0].item()
            if len(values) > 1:
                figures[f"{key}_novel"] = values[1:].mean().item()
        figures |= _far_figures(result, batch, objective.lpips)
        for name, value in figures.items():
            sums.setdefault(name, []).append(value)
        if len(rows) < 2 * STRIP_OBJECTS:
            rows += [result.target[0, :STRIP_VIEWS], result.rendering.rgb[0, :STRIP_VIEWS]]
    model.train(was_training)
    return {name: sum(values) / len(values) for name, values in sums.items()}, rows


def _far_figures(
    result: StepResult, batch: Batch, lpips: Callable[[Tensor, Tensor], Tensor] | None
) -> dict[str, float]:
    """Figures of views of one object more than ``FAR_VIEW`` degrees from the input; may be empty.

    ``translucency_far`` is the mean over pixels that are not clear: of rendered alpha, which shows
    a body of many faint Gaussians, and for scale of true alpha. LPIPS is on grey and on black.
    """
    far = view_angles(batch.cameras)[0] > FAR_VIEW
    if not far.any():
        return {}
    rgb, alpha, true = (
        result.rendering.rgb[0][far],
        result.rendering.alpha[0][far],
        batch.targets[0][far],
    )
    figures = {
        "mask_iou_far": mask_iou(alpha[..., 0] > 0.5, true[..., 3] > 0.5).mean().item(),
        "translucency_far": _mean_translucency(alpha[..., 0]),
        "translucency_far_true": _mean_translucency(true[..., 3]),
    }
    if lpips is not None:
        for name, grey in GROUNDS.items():
            got = over_another(rgb, alpha, WHITE, grey).clamp(0, 1)
            figures[f"lpips_{name}_far"] = lpips(got, over_background(true, grey)).mean().item()
    return figures


def _mean_translucency(alphas: Tensor) -> float:
    """Mean over views ``[V, H, W]`` of the mean over pixels that are not clear."""
    values = [translucency(a[a > CLEAR]).mean().item() for a in alphas if (a > CLEAR).any()]
    return sum(values) / max(1, len(values))


def _measures(
    result: StepResult, batch: Batch, lpips: Callable[[Tensor, Tensor], Tensor] | None
) -> dict[str, Tensor]:
    """Metrics of a validation object, each ``[V+1]``."""
    rgb, alpha, true = result.rendering.rgb[0], result.rendering.alpha[0], batch.targets[0]
    got, want = rgb.clamp(0, 1), result.target[0]

    def pictures(grey: float) -> tuple[Tensor, Tensor]:
        if grey == WHITE:
            return got, want
        return over_another(rgb, alpha, WHITE, grey).clamp(0, 1), over_background(true, grey)

    masks = alpha[..., 0] > 0.5, true[..., 3] > 0.5
    side = min(want.shape[-3:-1])
    keys = [key for key, metric in all_figures().items() if side >= metric.least_side]
    measures = measure(pictures, masks, keys)
    if lpips is not None:
        terms = result.terms
        measures["lpips"] = terms["lpips"][0] if "lpips" in terms else lpips(got, want)
    return measures
