"""A training step: losses, gradients, the update of the weights, and the model's health."""

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

from gamba_warp.conventions import over_background
from gamba_warp.devices import network_precision
from gamba_warp.gaussians import Gaussians
from gamba_warp.render import render
from gamba_warp.vision.lpips import LPIPS

from .data.samples import Batch
from .graphs import StepGraphs
from .objective.losses import LossInputs, loss_terms, rendered_psnr, total_loss
from .objective.radial_mask import NEAR, project_means
from .optim import Ema

CLIP = 1.0  # largest norm of the gradient (paper, §4.1)
VISIBLE_OPACITY = 0.01  # under this a Gaussian changes no 8-bit pixel by more than two steps


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
    """Result of ``forward``, without the rasterizer's lists.

    Attributes:
        loss: scalar, with its graph.
        terms: unweighted terms by name, each ``[B, V+1]``.
        gaussians: predicted Gaussians, ``[B]``.
        rgb: their images on the batch's background, ``[B, V+1, H, W, 3]``.
        alpha: alpha of these images, ``[B, V+1, H, W, 1]``.
        target: true images on the batch's background, ``[B, V+1, H, W, 3]``.
    """

    loss: Tensor
    terms: dict[str, Tensor]
    gaussians: Gaussians
    rgb: Tensor
    alpha: Tensor
    target: Tensor

    def detach(self) -> StepResult:
        """Return the same values, without the graph and what it holds."""
        terms = {name: term.detach() for name, term in self.terms.items()}
        images = self.rgb.detach(), self.alpha.detach(), self.target
        return StepResult(self.loss.detach(), terms, self.gaussians.detach(), *images)


def forward(model: Callable, batch: Batch, objective: Objective) -> StepResult:
    """Predict, render all V+1 views and compute the loss (paper eq. loss_train).

    Args:
        model: ``Gamba`` or a wrapper of it.
        batch: a batch on the model's device.
        objective: loss weights and LPIPS.
    """
    weights, lpips, crop, precision = objective
    with network_precision(batch.inputs.device, precision):
        optional = {} if batch.foreground is None else {"foreground": batch.foreground}
        gaussians = model(batch.inputs, batch.input_cameras, **optional)
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
    images = rendering.rgb, rendering.alpha, target
    return StepResult(total_loss(weighted, weights), terms, gaussians, *images)


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
    fractions = terms["rgb"].new_full((views,), novel * first)
    fractions[:1].fill_(first)
    whole = {name: term for name, term in terms.items() if term.ndim == 2}  # not LPIPS of crops
    return terms | {name: term * fractions for name, term in whole.items()}


class Gradients(NamedTuple):
    """Result of ``compute_gradients``; the gradients themselves are in the parameters.

    Attributes:
        loss: scalar, the mean over the batches, without a graph.
        norm: scalar, the norm of the gradient before clipping.
        batch: the last batch.
        result: result of ``forward`` on the last batch, detached.
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
    count: int = 1,
) -> Gradients:
    """Set the parameters' gradients to those of the mean loss over some batches, clipped to CLIP.

    Several processes exchange their gradients once, with the last batch.

    Args:
        model: ``Gamba`` or a wrapper of it.
        optimizer: the optimizer whose parameters get gradients; no step is made here.
        batches: ``count`` batches on the model's device.
        objective: as for ``forward``.
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
    norm = torch.nn.utils.clip_grad_norm_(parameters, CLIP)
    return Gradients(torch.stack(losses).mean(), norm, batch, result.detach())


def update(
    optimizer: torch.optim.Optimizer,
    ema: Ema | None,
    fraction: float | Tensor,
    grads: Gradients,
    model: Callable,
) -> Tensor:
    """Update the weights, unless loss or gradient is not finite on any process.

    The device itself skips such a step, so the host need not wait for it.

    Args:
        optimizer: fused AdamW.
        ema: the average of the weights, which is updated, too; or None.
        fraction: ``ema.next_fraction()``, or a scalar tensor of it on the device.
        grads: the gradients, which the parameters have.
        model: as for ``compute_gradients``.

    Returns:
        ``[3]``: loss, norm of the gradient, and 1 if the step was skipped.
    """
    stats = torch.stack([grads.loss, grads.norm])
    bad = 1 - stats.isfinite().all().float()
    if isinstance(model, DistributedDataParallel):  # all processes must act alike
        dist.all_reduce(bad, dist.ReduceOp.MAX, model.process_group)
    vars(optimizer)["found_inf"] = bad  # as torch.amp.GradScaler sets it
    optimizer.step()
    if ema is not None:
        ema.update((1 - bad) * fraction)
    return torch.cat([stats, bad[None]])


class Step(NamedTuple):
    """Outcome of an optimizer step.

    Attributes:
        stats: ``[3]``, see ``update``.
        batch: the last batch.
        result: of ``forward`` on the last batch, detached; the next step of a graph overwrites it.
    """

    stats: Tensor
    batch: Batch
    result: StepResult


def make_step(
    model: Callable,
    optimizer: torch.optim.Optimizer,
    ema: Ema | None,
    objective: Objective,
    accumulate: int = 1,
    graphs: StepGraphs | None = None,
) -> Callable[[Iterable[Batch], Mapping[str, float], float], Step]:
    """Return the function of an optimizer step: ``(batches, weights, learning rate) -> Step``.

    Args:
        model: ``Gamba`` or a wrapper of it.
        optimizer: fused AdamW.
        ema: the average of the weights, or None.
        objective: of the steps, but for its weights.
        accumulate: number of batches of a step.
        graphs: if given, a step of one batch is captured and repeated as a CUDA graph.
    """

    def eager(
        batches: Iterable[Batch],
        weights: Mapping[str, Any],
        rate: float | Tensor,
        fraction: float | Tensor,
    ) -> Step:
        for group in optimizer.param_groups:
            group["lr"] = rate
        weighted = objective._replace(weights=weights)
        grads = compute_gradients(model, optimizer, batches, weighted, count=accumulate)
        return Step(update(optimizer, ema, fraction, grads, model), grads.batch, grads.result)

    def run(batches: Iterable[Batch], weights: Mapping[str, float], rate: float) -> Step:
        fraction = ema.next_fraction() if ema else 1.0
        if graphs is None:
            return eager(batches, weights, rate, fraction)
        (batch,) = batches
        number, key = graphs.number, tuple(sorted(n for n, w in weights.items() if w))
        graph_weights = {n: w if n == "novel" else number(n, w) for n, w in weights.items() if w}
        rates = number("learning rate", rate), number("fraction of the average", fraction)
        step = graphs.run(batch, key, lambda static: eager([static], graph_weights, *rates))
        return step._replace(stats=step.stats.clone())  # the next step of a graph overwrites it

    return run


@torch.no_grad()
def health(result: StepResult, batch: Batch) -> dict[str, Tensor]:
    """Compute scalars that show a collapse before the loss does.

    Returns:
        ``psnr`` of the batch in dB; ``mean_alpha`` of the rendered and ``target_alpha`` of the true
        images, both in [0, 1]; ``visible_share``, the fraction of Gaussians that are not
        transparent and project into some view; ``spread``, the rms distance of the centres from
        their mean in object units.
    """
    means = result.gaussians.means
    positions, depths = project_means(means, batch.cameras)
    size = positions.new_tensor([batch.cameras.width, batch.cameras.height])
    seen = ((positions >= 0) & (positions <= size)).all(-1) & (depths > NEAR)
    visible = seen.any(-2) & (result.gaussians.opacities > VISIBLE_OPACITY)
    centred = means - means.mean(-2, keepdim=True)
    return {
        "psnr": rendered_psnr(result.rgb, result.target).mean(),
        "mean_alpha": result.alpha.mean(),
        "target_alpha": batch.targets[..., 3].mean(),
        "visible_share": visible.float().mean(),
        "spread": centred.square().sum(-1).mean(-1).sqrt().mean(),
    }


def means(step: Step) -> dict[str, float]:
    """Read the means of the loss terms of a step's last batch, and its ``health``."""
    terms = {f"loss_{n}": term.mean() for n, term in step.result.terms.items()}
    tensors = terms | health(step.result, step.batch)
    values = torch.stack([value.double() for value in tensors.values()]).tolist()
    return dict(zip(tensors, values))


def collapse_reason(figures: Mapping[str, float]) -> str | None:
    """Describe a collapse by the figures of ``health`` in one line; None without one."""
    if figures["target_alpha"] > 0 and figures["mean_alpha"] < 0.1 * figures["target_alpha"]:
        return f"the images are almost empty (mean alpha {figures['mean_alpha']:.2g})"
    if figures["visible_share"] < 0.02:
        return f"almost no Gaussian is visible (fraction {figures['visible_share']:.2g})"
    if figures["spread"] < 0.01:
        return f"the Gaussians sit in one point (spread {figures['spread']:.2g})"
    return None
