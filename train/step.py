"""One forward pass of the training: a batch to its losses, and to figures of the model's health."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from gamba_warp.gaussians import Gaussians
from gamba_warp.images import over_background
from gamba_warp.model.gamba import Gamba
from gamba_warp.render import Rendering, render

from .batches import Batch
from .losses import psnr, total_loss, view_losses
from .radial_mask import NEAR, contour_distances, project_means, radial_mask_loss

VISIBLE_OPACITY = 0.01  # under this a Gaussian changes no 8-bit pixel by more than two steps


@dataclass
class Forward:
    """What ``forward`` returns.

    Attributes:
        loss: scalar, with its graph.
        terms: each unweighted term, ``[B, V+1]``.
        gaussians: ``[B]``.
        rendering: ``[B, V+1]``.
        target: ``[B, V+1, H, W, 3]``, the true pictures on the batch's background.
    """

    loss: Tensor
    terms: dict[str, Tensor]
    gaussians: Gaussians
    rendering: Rendering
    target: Tensor


def forward(
    model: Callable,
    batch: Batch,
    weights: Mapping[str, float],
    lpips: Callable[[Tensor, Tensor], Tensor] | None = None,
    precision: torch.dtype = torch.float32,
) -> Forward:
    """Predicts, renders all V+1 views and compares (paper eq. loss_train).

    Args:
        model: ``Gamba`` or a wrapper of it.
        batch: on the model's device.
        weights: of the terms ``rgb``, ``mask``, ``lpips`` and ``rdist``; a term of weight 0 is not
            computed.
        lpips: ``(got, want) -> [.., V]``, used if its weight is not 0.
        precision: of the network's matrix products; rendering and losses are float32.
    """
    kind = batch.inputs.device.type
    with torch.autocast(kind, precision, enabled=precision != torch.float32):
        gaussians = model(batch.inputs, batch.input_cameras)
    rendering = render(gaussians, batch.cameras, batch.background)
    target = over_background(batch.targets, batch.background[..., None, None, :])
    target_alpha = batch.targets[..., 3:]
    terms = view_losses(
        rendering.rgb,
        rendering.alpha,
        target,
        target_alpha,
        lpips if weights.get("lpips") else None,
    )
    if weights.get("rdist"):
        contours = contour_distances(target_alpha[..., 0])
        terms["rdist"] = radial_mask_loss(gaussians.means, batch.cameras, contours)
    return Forward(total_loss(terms, weights), terms, gaussians, rendering, target)


@torch.no_grad()
def health(result: Forward, batch: Batch) -> dict[str, Tensor]:
    """Scalars that show a collapse before the loss does.

    ``psnr`` of the batch in dB; ``mean_alpha`` rendered and ``target_alpha`` true, both in [0, 1];
    ``visible_share`` of the Gaussians that are not transparent and project into some view;
    ``spread``, the rms distance of the centres from their mean, object units.
    """
    means = result.gaussians.means
    positions, depths = project_means(means, batch.cameras)
    size = positions.new_tensor([batch.cameras.width, batch.cameras.height])
    seen = ((positions >= 0) & (positions <= size)).all(-1) & (depths > NEAR)
    visible = seen.any(-2) & (result.gaussians.opacities > VISIBLE_OPACITY)
    centred = means - means.mean(-2, keepdim=True)
    return {
        "psnr": psnr(result.rendering.rgb, result.target).mean(),
        "mean_alpha": result.rendering.alpha.mean(),
        "target_alpha": batch.targets[..., 3].mean(),
        "visible_share": visible.float().mean(),
        "spread": centred.square().sum(-1).mean(-1).sqrt().mean(),
    }


def collapse_reason(figures: Mapping[str, float]) -> str | None:
    """One line on what has collapsed, from the figures of ``health``; None while all is well."""
    if figures["target_alpha"] > 0 and figures["mean_alpha"] < 0.1 * figures["target_alpha"]:
        return f"the pictures are almost empty (mean alpha {figures['mean_alpha']:.2g})"
    if figures["visible_share"] < 0.02:
        return f"almost no Gaussian is visible (share {figures['visible_share']:.2g})"
    if figures["spread"] < 0.01:
        return f"the Gaussians sit in one point (spread {figures['spread']:.2g})"
    return None


STRIP_VIEWS, STRIP_OBJECTS = 6, 4


@torch.no_grad()
def validate(
    model: Gamba,
    batches: Iterable[Batch],
    weights: Mapping[str, float],
    lpips: Callable[[Tensor, Tensor], Tensor] | None,
    device: torch.device,
) -> tuple[dict[str, float], list[Tensor]]:
    """Means over objects, in float32, on white.

    Args:
        model: switched to eval mode, and back.
        batches: one object each, the input view first.
        weights: of the loss terms.
        lpips: as ``forward``.
        device: the model's.

    Returns:
        ``loss``, ``psnr_input`` and ``psnr_novel`` (mean over views, then over objects, whole
        picture, dB; ``psnr_novel`` is left out where there are no novel views); and rows
        ``[V, H, W, 3]`` for ``save_strip``, true above predicted for the first objects.
    """
    was_training = model.training
    model.eval()
    sums: dict[str, list[float]] = {}
    rows: list[Tensor] = []
    for batch in batches:
        batch = batch.to(device)
        result = forward(model, batch, weights, lpips)
        quality = psnr(result.rendering.rgb, result.target)[0]
        figures = {"loss": result.loss.item(), "psnr_input": quality[0].item()}
        if len(quality) > 1:
            figures["psnr_novel"] = quality[1:].mean().item()
        for name, value in figures.items():
            sums.setdefault(name, []).append(value)
        if len(rows) < 2 * STRIP_OBJECTS:
            rows += [result.target[0, :STRIP_VIEWS], result.rendering.rgb[0, :STRIP_VIEWS]]
    model.train(was_training)
    return {name: sum(values) / len(values) for name, values in sums.items()}, rows
