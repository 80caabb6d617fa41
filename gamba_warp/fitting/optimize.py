"""Fits the Gaussians of one object to posed views, by gradient descent through the rasterizer.

Points start at random in the visual hull of the pictures. Every step renders a few views in one
call on random backgrounds, and Adam follows the gradient of the error. Now and then the Gaussians
that hardly show in any view are moved to where the pictures still differ; their number stays.
Nothing is learned beforehand: what this reaches on held-out views is what the representation and
the views allow.
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
from .config import MAX_SCALE, MIN_SCALE, FitConfig
from .relocate import relocate, shares
from .start import random_start

_BETAS = (0.9, 0.99)  # the second moment forgets in 100 steps, because there are only hundreds


@dataclass
class Fit:
    """What ``fit`` returns.

    Attributes:
        gaussians: ``[N]``, in the world of the cameras.
        losses: the loss of each step taken.
        relocated: number of Gaussians that were moved, in all steps together.
    """

    gaussians: Gaussians
    losses: list[float]
    relocated: int


def activate(parameters: dict[str, Tensor]) -> Gaussians:
    """Makes Gaussians of parameters as ``random_start`` returns them."""
    return Gaussians(
        means=parameters["means"],
        quats=parameters["quats"],
        scales=parameters["scales"].exp(),
        opacities=parameters["opacities"].sigmoid(),
        colors=parameters["colors"].sigmoid(),
    )


def fit(
    images: Tensor,
    cameras: Cameras,
    config: FitConfig = FitConfig(),  # noqa: B008 (frozen)
    progress: Callable[[float, float], None] | None = None,
) -> Fit:
    """Fits Gaussians to the views of one object.

    Args:
        images: ``[V, H, W, 4]`` float32 straight RGBA in [0, 1].
        cameras: V cameras on the same device; the object lies in the unit cube about the origin.
        config: settings of the fit.
        progress: called after each step with the share done in [0, 1] and the loss.

    Returns:
        The Gaussians. They have the same bits for the same seed, device and number of threads,
        unless ``config.seconds`` limits the time.

    Raises:
        ValueError: no silhouette meets the unit cube.
        FloatingPointError: a loss is not finite.
    """
    rng = torch.Generator(images.device).manual_seed(config.seed)
    parameters = random_start(images, cameras, config.gaussians, rng)
    rates = {name: getattr(config, f"lr_{name}") for name in parameters}
    groups = [{"params": [p.requires_grad_()], "name": name} for name, p in parameters.items()]
    # The gradients of single Gaussians are far below Adam's usual eps.
    optimizer = torch.optim.Adam(groups, betas=_BETAS, eps=1e-15)
    result = Fit(activate(parameters).detach(), [], 0)
    began, done, pending = time.perf_counter(), 0.0, []
    while len(result.losses) < config.steps and done < 1:
        for group in optimizer.param_groups:
            group["lr"] = rates[group["name"]] * config.lr_end**done
        if len(pending) < min(config.views, len(images)):
            pending = torch.randperm(len(images), generator=rng, device=images.device).tolist()
        views, pending = pending[: config.views], pending[config.views :]
        result.losses.append(
            _step(parameters, optimizer, images[views], cameras[views], config, rng)
        )
        step = len(result.losses)
        if config.relocate_every and step % config.relocate_every == 0:
            if done < config.relocate_until:
                now = activate(parameters)
                weight, error = shares(now, images, cameras, config.rasterize_mode)
                moved = relocate(parameters, optimizer, weight, error, config, rng)
                result.relocated += moved
        done = step / config.steps
        if config.seconds is not None:
            done = max(done, (time.perf_counter() - began) / config.seconds)
        if progress is not None:
            progress(min(done, 1.0), result.losses[-1])
    result.gaussians = activate(parameters).detach()
    return result


def _step(
    parameters: dict[str, Tensor],
    optimizer: torch.optim.Adam,
    images: Tensor,
    cameras: Cameras,
    config: FitConfig,
    rng: torch.Generator,
) -> float:
    """One step of Adam; returns the loss before it."""
    # A background that changes tells a see-through object from one of the background's colour.
    backgrounds = torch.rand(len(images), 3, generator=rng, device=images.device)
    mode = config.rasterize_mode
    picture = render(activate(parameters), cameras, backgrounds, rasterize_mode=mode)
    difference = picture.rgb - over_background(images, backgrounds[:, None, None])
    loss = difference.square().mean() + config.weight_l1 * difference.abs().mean()
    loss = loss + config.weight_alpha * (picture.alpha - images[..., 3:]).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    with torch.no_grad():
        parameters["scales"].clamp_(math.log(MIN_SCALE), math.log(MAX_SCALE))
    value = loss.item()
    if not math.isfinite(value):
        raise FloatingPointError("the loss is not finite")
    return value
