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
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool3d

from .cameras import Cameras
from .gaussians import Gaussians, quat_multiply
from .images import over_background
from .render import render

HULL_GRID = 96  # voxels a side of the unit cube
MAX_PSNR = 100.0  # of equal pictures, whose PSNR has no bound
_MIN_SCALE, _MAX_SCALE = 1e-3, 0.1  # object units
RasterizeMode = Literal["classic", "antialiased"]
_BETAS = (0.9, 0.99)  # a second moment that forgets in 100 steps: there are only hundreds


@dataclass(frozen=True)
class FitConfig:
    """How one object is fitted.

    Attributes:
        gaussians: N, fixed throughout.
        steps: of Adam; 0 returns the start.
        seconds: where given, stop there if ``steps`` are not done; the learning rates then fall
            with the time, so the result depends on the machine.
        views: rendered in each step.
        lr_means: first learning rate, object units a step.
        lr_scales: of the logarithms.
        lr_quats: of the quaternions.
        lr_opacities: of the logits.
        lr_colors: of the logits.
        lr_end: the last learning rates as a share of the first; they fall exponentially.
        weight_alpha: of the squared error of alpha, beside that of colour.
        weight_l1: of the absolute error of colour.
        relocate_every: steps between relocations; 0 for none.
        relocate_share: at most so much of the Gaussians at once.
        relocate_until: none after this share of the steps.
        min_weight: a Gaussian that has less blending weight than so many pixels in all views
            together is relocated.
        rasterize_mode: what renders the Gaussians, here and later: files do not hold it, and most
            viewers are classic; antialiased ones fit small pictures better.
        seed: of everything random.
    """

    gaussians: int = 8000
    steps: int = 600
    seconds: float | None = None
    views: int = 5
    lr_means: float = 2e-3
    lr_scales: float = 2e-2
    lr_quats: float = 2e-2
    lr_opacities: float = 5e-2
    lr_colors: float = 2e-2
    lr_end: float = 0.03
    weight_alpha: float = 0.5
    weight_l1: float = 0.3
    relocate_every: int = 25
    relocate_share: float = 0.2
    relocate_until: float = 0.7
    min_weight: float = 1.0
    rasterize_mode: RasterizeMode = "classic"
    seed: int = 0


@dataclass
class Fit:
    """What ``fit`` returns.

    Attributes:
        gaussians: ``[N]``, in the world of the cameras.
        losses: of each step taken.
        relocated: how many Gaussians were moved, in all.
    """

    gaussians: Gaussians
    losses: list[float]
    relocated: int


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Peak signal-to-noise ratio over the whole picture in dB, at most ``MAX_PSNR``.

    Args:
        a: ``[.., H, W, C]`` in [0, 1].
        b: the same shape.

    Returns:
        ``[..]`` float64; the definition of ``gamba eval-views``.
    """
    error = (a.double() - b.double()).square().mean((-3, -2, -1))
    return -10 * torch.log10(error.clamp(min=10 ** (-MAX_PSNR / 10)))


def sample_views(images: Tensor, cameras: Cameras, points: Tensor) -> Tensor:
    """Reads pictures where points project.

    Args:
        images: ``[V, H, W, C]``.
        cameras: V cameras.
        points: ``[N, 3]``.

    Returns:
        ``[V, N, C]``, bilinear; 0 outside the picture and behind the camera.
    """
    local = points @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]
    projected = local @ cameras.Ks.mT
    depth = projected[..., 2:]
    size = points.new_tensor([cameras.width, cameras.height])
    where = projected[..., :2] / depth.clamp_min(1e-6) / size * 2 - 1
    where = torch.where(depth > 1e-6, where, 2.0)
    samples = grid_sample(images.permute(0, 3, 1, 2), where[:, None], align_corners=False)
    return samples[:, :, 0].mT


def visual_hull(alphas: Tensor, cameras: Cameras, grid: int = HULL_GRID) -> Tensor:
    """The voxels of the unit cube about the origin that project into the object in every view.

    Where no voxel does (one picture is empty, or the poses are a little off), those that do so in
    the most views.

    Args:
        alphas: ``[V, H, W]`` in [0, 1].
        cameras: V cameras.
        grid: voxels a side.

    Returns:
        ``[grid, grid, grid]`` bool, indexed x, y, z.

    Raises:
        ValueError: no voxel projects into any silhouette.
    """
    axis = (torch.arange(grid, device=alphas.device) + 0.5) / grid - 0.5
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    votes = torch.zeros(len(points), device=alphas.device)
    for view in range(len(alphas)):
        part = slice(view, view + 1)
        # below one half, so that bars of a pixel's width stay
        votes += sample_views(alphas[part, ..., None], cameras[part], points)[0, :, 0] > 0.25
    most = votes.max()
    if most == 0:
        raise ValueError("no silhouette meets the unit cube about the origin")
    return (votes == most).view(grid, grid, grid)


def random_start(
    images: Tensor, cameras: Cameras, num: int, rng: torch.Generator
) -> dict[str, Tensor]:
    """Parameters before activation: random points in the hull, half of them in its outer voxels.

    Concave parts lie inside the hull, hence the other half. Colours are the views' mean.

    Args:
        images: ``[V, H, W, 4]`` straight RGBA in [0, 1].
        cameras: V cameras.
        num: N.
        rng: on the images' device.

    Returns:
        ``means [N, 3]``, ``quats [N, 4]``, ``scales [N, 3]`` (logarithms), ``opacities [N]`` and
        ``colors [N, 3]`` (logits).

    Raises:
        ValueError: see ``visual_hull``.
    """
    device = images.device
    hull = visual_hull(images[..., 3], cameras)
    empty = torch.nn.functional.pad((~hull).float()[None], (1,) * 6, value=1.0)
    shell = (hull & (max_pool3d(empty, 3, stride=1)[0] > 0)).nonzero()
    cells = []
    for places, count in ((shell, num // 2), (hull.nonzero(), num - num // 2)):
        chosen = torch.randint(len(places), (count,), generator=rng, device=device)
        cells.append(places[chosen])
    offsets = torch.rand(num, 3, generator=rng, device=device)
    means = (torch.cat(cells) + offsets) / HULL_GRID - 0.5
    rgba = sample_views(images, cameras, means)
    weights = rgba[..., 3:].clamp_min(1e-3)
    colors = (rgba[..., :3] * weights).sum(0) / weights.sum(0)
    # half the side of the square that each would have to itself, were all spread over the surface
    scale = 0.5 * (len(shell) / num) ** 0.5 / HULL_GRID
    scale = min(max(scale, 2 * _MIN_SCALE), 0.5 * _MAX_SCALE)
    return {
        "means": means,
        "quats": torch.randn(num, 4, generator=rng, device=device),
        "scales": torch.full((num, 3), math.log(scale), device=device),
        "opacities": torch.zeros(num, device=device),
        "colors": colors.clamp(0.02, 0.98).logit(),
    }


def activate(parameters: dict[str, Tensor]) -> Gaussians:
    """Gaussians from what ``random_start`` returns."""
    return Gaussians(
        means=parameters["means"],
        quats=parameters["quats"],
        scales=parameters["scales"].exp(),
        opacities=parameters["opacities"].sigmoid(),
        colors=parameters["colors"].sigmoid(),
    )


def shares(
    gaussians: Gaussians, images: Tensor, cameras: Cameras, mode: RasterizeMode = "classic"
) -> tuple[Tensor, Tensor]:
    """What each Gaussian has to do with the pictures, from one backward pass.

    A rendered channel is linear in the colours, so the gradient of ``Σ_p u_p C_p`` to a colour is
    ``Σ_p u_p w_p``, w being the blending weight: with u = 1 its weight, with u = the squared error
    of the pixel its share in the error.

    Args:
        gaussians: ``[N]``.
        images: ``[V, H, W, 4]``.
        cameras: V cameras.
        mode: of ``rasterization``.

    Returns:
        Weight in pixels, and share in the squared error: two ``[N]``, over all views.
    """
    gaussians = gaussians.detach()
    gaussians.colors.requires_grad_()
    rgb = render(gaussians, cameras, images.new_ones(3), rasterize_mode=mode).rgb
    error = (rgb.detach() - over_background(images, 1.0)).square().mean(-1)
    upstream = torch.stack([torch.ones_like(error), error, torch.zeros_like(error)], -1)
    (gradient,) = torch.autograd.grad(rgb, gaussians.colors, upstream)
    return gradient[:, 0], gradient[:, 1]


@torch.no_grad()
def relocate(
    parameters: dict[str, Tensor],
    optimizer: torch.optim.Adam,
    weight: Tensor,
    error: Tensor,
    config: FitConfig,
    rng: torch.Generator,
) -> int:
    """Moves Gaussians of too little weight onto others, drawn by their share in the error.

    The ones moved become copies, set off by a draw from the Gaussian itself. All copies of one
    together are about as opaque as it was (Kheradmand et al. 2024, with a fixed shrinking of the
    scales) and start with empty moments.

    Args:
        parameters: changed in place.
        optimizer: of the parameters; its state is changed in place.
        weight: ``[N]``, see ``shares``.
        error: ``[N]``, see ``shares``.
        config: ``min_weight`` and ``relocate_share``.
        rng: on the parameters' device.

    Returns:
        How many were moved.
    """
    order = weight.argsort()
    least = order[: int(config.relocate_share * len(order))]
    moved = least[weight[least] < config.min_weight]
    stay = torch.ones_like(weight, dtype=torch.bool)
    stay[moved] = False
    chances = torch.where(stay, error, 0.0)
    if len(moved) == 0 or not chances.sum() > 0:
        return 0
    onto = torch.multinomial(chances, len(moved), replacement=True, generator=rng)
    chosen, copies = onto.unique(return_counts=True)
    clear = 1 - parameters["opacities"][chosen].sigmoid()
    opacity = 1 - clear ** (1.0 / (copies + 1))
    parameters["opacities"][chosen] = opacity.clamp(0.005, 0.995).logit()
    parameters["scales"][chosen] -= math.log(1.25)
    for value in parameters.values():
        value[moved] = value[onto]
        for moment in ("exp_avg", "exp_avg_sq"):
            optimizer.state[value][moment][moved] = 0
            optimizer.state[value][moment][chosen] = 0
    draw = torch.randn(len(moved), 3, generator=rng, device=weight.device)
    parameters["means"][moved] += _rotate(
        parameters["quats"][moved], draw * parameters["scales"][moved].exp()
    )
    return len(moved)


def _rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """``vectors [N, 3]`` turned by ``quats [N, 4]`` of any length > 0."""
    unit = torch.nn.functional.normalize(quats, dim=-1)
    inverse = unit * unit.new_tensor([1.0, -1.0, -1.0, -1.0])
    pure = torch.cat([torch.zeros_like(vectors[:, :1]), vectors], -1)
    return quat_multiply(quat_multiply(unit, pure), inverse)[:, 1:]


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
        config: how.
        progress: called after each step with the share done in [0, 1] and the loss.

    Returns:
        The same bits for the same seed, device and number of threads, unless ``config.seconds``.

    Raises:
        ValueError: no silhouette meets the unit cube.
        FloatingPointError: a loss is not finite.
    """
    rng = torch.Generator(images.device).manual_seed(config.seed)
    parameters = random_start(images, cameras, config.gaussians, rng)
    rates = {name: getattr(config, f"lr_{name}") for name in parameters}
    groups = [{"params": [p.requires_grad_()], "name": name} for name, p in parameters.items()]
    # gradients of single Gaussians are far below Adam's usual eps
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
    # a background that changes tells a see-through object from one of the background's colour
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
        parameters["scales"].clamp_(math.log(_MIN_SCALE), math.log(_MAX_SCALE))
    value = loss.item()
    if not math.isfinite(value):
        raise FloatingPointError("the loss is not finite")
    return value
