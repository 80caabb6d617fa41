"""Validation: picture quality on fixed views of held-out objects, and a strip of sample renders."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import torch
from torch import Tensor

from gamba_warp.model import Gamba

from .batches import Batch
from .losses import psnr
from .step import forward

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
