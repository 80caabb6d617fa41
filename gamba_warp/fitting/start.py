"""Initialization of a fit: random points in the visual hull; activation of the parameters."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool3d

from ..cameras import Cameras
from ..gaussians import Gaussians
from .config import MAX_SCALE, MIN_SCALE

HULL_GRID = 96  # voxels a side of the unit cube


def activate(parameters: dict[str, Tensor]) -> Gaussians:
    """Activate parameters of ``random_start`` to Gaussians."""
    return Gaussians(
        means=parameters["means"],
        quats=parameters["quats"],
        scales=parameters["scales"].exp(),
        opacities=parameters["opacities"].sigmoid(),
        colors=parameters["colors"].sigmoid(),
    )


def sample_views(images: Tensor, cameras: Cameras, points: Tensor) -> Tensor:
    """Sample pictures at projected points.

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
    """Voxels of the unit cube about the origin that project into the object in every view.

    Without any (one picture is empty, or the poses are slightly off), the voxels that do so in the
    most views.

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
        # Below one half, so that bars one pixel wide remain.
        votes += sample_views(alphas[part, ..., None], cameras[part], points)[0, :, 0] > 0.25
    most = votes.max()
    if most == 0:
        raise ValueError("no silhouette meets the unit cube about the origin")
    return (votes == most).view(grid, grid, grid)


def random_start(
    images: Tensor, cameras: Cameras, num: int, rng: torch.Generator
) -> dict[str, Tensor]:
    """Draw random points in the hull, as parameters before activation.

    Half of them are in its outer voxels; the others are anywhere in it, because concave parts of an
    object lie inside the hull. Colours are the mean of the views.

    Args:
        images: ``[V, H, W, 4]`` straight RGBA in [0, 1].
        cameras: V cameras.
        num: number N of Gaussians.
        rng: generator on the images' device.

    Returns:
        ``means [N, 3]``, ``quats [N, 4]``, ``scales [N, 3]`` (logarithms), ``opacities [N]`` and
        ``colors [N, 3]`` (logits).

    Raises:
        ValueError: no voxel projects into any silhouette.
    """
    device = images.device
    hull = visual_hull(images[..., 3], cameras)
    empty = torch.nn.functional.pad((~hull).float()[None], (1,) * 6, value=1.0)
    shell = (hull & (max_pool3d(empty, 3, stride=1)[0] > 0)).nonzero()
    cells = []
    for voxels, count in ((shell, num // 2), (hull.nonzero(), num - num // 2)):
        chosen = torch.randint(len(voxels), (count,), generator=rng, device=device)
        cells.append(voxels[chosen])
    offsets = torch.rand(num, 3, generator=rng, device=device)
    means = (torch.cat(cells) + offsets) / HULL_GRID - 0.5
    rgba = sample_views(images, cameras, means)
    weights = rgba[..., 3:].clamp_min(1e-3)
    colors = (rgba[..., :3] * weights).sum(0) / weights.sum(0)
    # Half the side of the square per Gaussian if all were spread over the surface.
    scale = 0.5 * (len(shell) / num) ** 0.5 / HULL_GRID
    scale = min(max(scale, 2 * MIN_SCALE), 0.5 * MAX_SCALE)
    return {
        "means": means,
        "quats": torch.randn(num, 4, generator=rng, device=device),
        "scales": torch.full((num, 3), math.log(scale), device=device),
        "opacities": torch.zeros(num, device=device),
        "colors": colors.clamp(0.02, 0.98).logit(),
    }
