"""Fits the Gaussians of one object to posed views, by gradient descent through the rasterizer.

Points start at random in the visual hull of the pictures. Every step renders a few views in one
call on random backgrounds, and Adam follows the gradient of the error. No prior is learned: the
quality on held-out views shows the limit of the representation and of the views.
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
from ..render import render
from .config import BETAS, MAX_SCALE, MIN_SCALE, FitConfig
from .start import activate, random_start


@dataclass
class Fit:
    """Result of ``fit``.

    Attributes:
        gaussians: ``[N]``, in the world of the cameras.
        losses: the loss of each step.
    """

    gaussians: Gaussians
    losses: list[float]


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
    parameters = random_start(images, cameras, config.gaussians, rng)
    groups = [{"params": [p.requires_grad_()], "name": name} for name, p in parameters.items()]
    # The gradients of single Gaussians are far below Adam's default eps.
    optimizer = torch.optim.Adam(groups, betas=BETAS, eps=1e-15)
    result = Fit(activate(parameters).detach(), [])
    began, done, pending = time.perf_counter(), 0.0, []
    while len(result.losses) < config.steps and done < 1:
        for group in optimizer.param_groups:
            group["lr"] = getattr(config, f"lr_{group['name']}") * config.lr_end**done
        if len(pending) < min(config.views, len(images)):
            pending = torch.randperm(len(images), generator=rng, device=images.device).tolist()
        views, pending = pending[: config.views], pending[config.views :]
        loss = _loss(parameters, images[views], cameras[views], config, rng)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            parameters["scales"].clamp_(math.log(MIN_SCALE), math.log(MAX_SCALE))
        result.losses.append(loss.item())
        if not math.isfinite(result.losses[-1]):
            raise FloatingPointError("the loss is not finite")
        done = len(result.losses) / config.steps
        if config.seconds is not None:
            done = max(done, (time.perf_counter() - began) / config.seconds)
        if progress is not None:
            progress(min(done, 1.0), result.losses[-1])
    result.gaussians = activate(parameters).detach()
    return result


def _loss(
    parameters: dict[str, Tensor],
    images: Tensor,
    cameras: Cameras,
    config: FitConfig,
    rng: torch.Generator,
) -> Tensor:
    """Return the loss on some views, on random backgrounds: they tell clear from coloured."""
    backgrounds = torch.rand(len(images), 3, generator=rng, device=images.device)
    mode = config.rasterize_mode
    picture = render(activate(parameters), cameras, backgrounds, rasterize_mode=mode)
    difference = picture.rgb - over_background(images, backgrounds[:, None, None])
    loss = difference.square().mean() + config.weight_l1 * difference.abs().mean()
    return loss + config.weight_alpha * (picture.alpha - images[..., 3:]).square().mean()
