"""Fits the Gaussians of one object to posed views, by gradient descent through the rasterizer.

Points start at random in the visual hull of the pictures. Every step renders a few views in one
call on random backgrounds, and Adam follows the gradient of the error. At intervals the Gaussians
that are hardly visible in any view are moved to where the pictures still differ, and their number
stays; or a strategy of gsplat adds, moves and removes Gaussians (``densify``). No prior is learned:
the quality on held-out views shows the limit of the representation and of the views.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..cameras import Cameras
from ..conventions import over_background
from ..gaussians import Gaussians
from .config import MAX_SCALE, MIN_SCALE, FitConfig
from .densify import Densified, start_count
from .relocate import Fixed
from .start import activate, random_start


@dataclass
class Fit:
    """Result of ``fit``.

    Attributes:
        gaussians: ``[N]``, in the world of the cameras.
        losses: the loss of each step.
        relocated: number of Gaussians moved by ``relocate`` in all steps; 0 with a strategy of
            gsplat.
    """

    gaussians: Gaussians
    losses: list[float]
    relocated: int


def fit(
    images: Tensor,
    cameras: Cameras,
    config: FitConfig = FitConfig(),  # noqa: B008 (frozen)
    progress: Callable[[float, float], None] | None = None,
) -> Fit:
    """Fit Gaussians to the views of one object.

    Args:
        images: ``[V, H, W, 4]`` float32 straight RGBA in [0, 1].
        cameras: V cameras on the same device; the object lies in the unit cube about the origin.
        config: options of the fit.
        progress: called after each step with the share done in [0, 1] and the loss.

    Returns:
        The Gaussians, bit-identical for the same seed, device and number of threads, unless
        ``config.seconds`` limits the time.

    Raises:
        ValueError: no silhouette meets the unit cube.
        FloatingPointError: a loss is not finite.
    """
    rng = torch.Generator(images.device).manual_seed(config.seed)
    model: Fixed | Densified
    if config.strategy == "fixed":
        start = random_start(images, cameras, config.gaussians, rng)
        model = Fixed(start, images, cameras, config, rng)
    else:
        start = random_start(images, cameras, start_count(config), rng)
        model = Densified(start, config, rng)
    result = Fit(activate(model.parameters).detach(), [], 0)
    began, done, pending = time.perf_counter(), 0.0, []
    while len(result.losses) < config.steps and done < 1:
        for optimizer in model.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = getattr(config, f"lr_{group['name']}") * config.lr_end**done
        if len(pending) < min(config.views, len(images)):
            pending = torch.randperm(len(images), generator=rng, device=images.device).tolist()
        views, pending = pending[: config.views], pending[config.views :]
        result.losses.append(_step(model, images[views], cameras[views], config, rng))
        step = len(result.losses)
        result.relocated += model.after(step, done)
        done = step / config.steps
        if config.seconds is not None:
            done = max(done, (time.perf_counter() - began) / config.seconds)
        if progress is not None:
            progress(min(done, 1.0), result.losses[-1])
    result.gaussians = activate(model.parameters).detach()
    return result


def _step(
    model: Fixed | Densified,
    images: Tensor,
    cameras: Cameras,
    config: FitConfig,
    rng: torch.Generator,
) -> float:
    """Make one step of Adam; return the loss before it."""
    # A random background distinguishes transparency from the background's colour.
    backgrounds = torch.rand(len(images), 3, generator=rng, device=images.device)
    rgb, alpha = model.draw(cameras, backgrounds)
    difference = rgb - over_background(images, backgrounds[:, None, None])
    loss = difference.square().mean() + config.weight_l1 * difference.abs().mean()
    loss = loss + config.weight_alpha * (alpha - images[..., 3:]).square().mean()
    value = loss.item()
    for optimizer in model.optimizers.values():
        optimizer.zero_grad()
    (loss + model.penalty()).backward()
    for optimizer in model.optimizers.values():
        optimizer.step()
    with torch.no_grad():
        model.parameters["scales"].clamp_(math.log(MIN_SCALE), math.log(MAX_SCALE))
    if not math.isfinite(value):
        raise FloatingPointError("the loss is not finite")
    return value
