"""Radial mask constraint (paper eq. radial_mask): Gaussians stay inside the silhouettes.

A mask becomes U distances, one per ray, from the image centre to the outermost contour. A Gaussian
whose projected centre is farther out than the contour at its angle is pulled back.

Distances are in units of half the image height, so the loss is independent of the image size.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gamba_warp.cameras import Cameras, exact_product

RAYS = 256
NEAR = 0.1  # object units; a centre nearer to the camera plane has no meaningful projection
_STEP = 0.5  # pixels between two samples along a ray


def contour_distances(masks: Tensor, rays: int = RAYS, threshold: float = 0.5) -> Tensor:
    """Find the distance from the image centre to the outermost contour along each ray.

    Ray k has the angle 2πk/U, from +x (right) towards +y (down). At the contour the bilinearly
    interpolated mask crosses ``threshold``; outside the image the mask is 0.

    Args:
        masks: ``[.., H, W]`` in [0, 1].
        rays: number of rays, U.
        threshold: mask value of the contour, in (0, 1).

    Returns:
        ``[.., U]`` float32 in half image heights; 0 where a ray meets no foreground.
    """
    height, width = masks.shape[-2:]
    angles = torch.arange(rays, device=masks.device) * (2 * math.pi / rays)
    count = math.ceil(math.hypot(width, height) / 2 / _STEP) + 3  # the last samples are outside
    radii = torch.arange(count, device=masks.device) * _STEP
    directions = torch.stack([angles.cos(), angles.sin()], -1)
    size = _pair(width, height, angles)
    grid = directions[:, None] * radii[:, None] * 2 / size  # from the centre, in [-1, 1]
    flat = masks.reshape(1, -1, height, width).float()
    samples = torch.nn.functional.grid_sample(flat, grid[None], align_corners=False)[0]

    inside = samples >= threshold
    last = (inside * torch.arange(count, device=masks.device)).amax(-1, keepdim=True)
    before = samples.gather(-1, last)
    after = samples.gather(-1, (last + 1).clamp(max=count - 1))
    crossing = last + (before - threshold) / (before - after).clamp_min(1e-6)
    distances = torch.where(inside.any(-1, keepdim=True), crossing, 0.0)[..., 0] * _STEP
    return (distances / (height / 2)).reshape(*masks.shape[:-2], rays)


def _pair(x: float, y: float, like: Tensor) -> Tensor:
    """Two numbers as a tensor, without the synchronizing copy of a list to a GPU."""
    return torch.stack([like.new_full((), x), like.new_full((), y)])


def project_means(means: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Project every centre into every view with a pinhole camera.

    Args:
        means: ``[.., N, 3]``.
        cameras: ``viewmats [.., V, 4, 4]``.

    Returns:
        Pixel positions ``[.., V, N, 2]`` and depths ``[.., V, N]``. At depths under ``NEAR`` the
        position is finite but means nothing.
    """
    rotation, translation = cameras.viewmats[..., :3, :3], cameras.viewmats[..., :3, 3]
    points = exact_product(means[..., None, :, :], rotation.mT) + translation[..., None, :]
    depths = points[..., 2]
    safe = torch.where(depths > NEAR, depths, 1.0)
    homogeneous = torch.cat(
        [points[..., :2] / safe[..., None], torch.ones_like(safe)[..., None]], -1
    )
    return exact_product(homogeneous, cameras.Ks.mT)[..., :2], depths


def radial_mask_loss(means: Tensor, cameras: Cameras, contours: Tensor) -> Tensor:
    """Average (d_j - contour)² over all N Gaussians; those inside the contour count 0.

    d_j is the distance of the projected centre from the image centre. The contour's distance is
    interpolated linearly in angle between the two nearest rays (paper eq. radial_mask). A centre
    behind the camera counts 0, and so does every centre in a view with an empty mask. The mean is
    over all Gaussians, so the pull on one does not depend on the number of others outside.

    Args:
        means: ``[.., N, 3]``, object units.
        cameras: cameras of the masks' images, ``viewmats [.., V, 4, 4]``.
        contours: result of ``contour_distances``, ``[.., V, U]``.

    Returns:
        ``[.., V]``, in squared half image heights.
    """
    positions, depths = project_means(means, cameras)
    centre = _pair(cameras.width / 2, cameras.height / 2, positions)
    offsets = (positions - centre) / (cameras.height / 2)
    # Square root and angle have no gradient at 0, where the loss is 0 anyway.
    usable = (depths > NEAR) & (offsets.square().sum(-1) > 1e-12)
    offsets = torch.where(usable[..., None], offsets, _pair(1.0, 0.0, offsets))
    x, y = offsets.unbind(-1)
    distances = (x * x + y * y).sqrt()

    rays = contours.shape[-1]
    angles = torch.atan2(y, x) / (2 * math.pi) * rays  # in units of rays
    below = angles.detach().floor()
    index = below.long()
    contour = torch.lerp(
        contours.gather(-1, index % rays), contours.gather(-1, (index + 1) % rays), angles - below
    )
    outside = usable & (distances > contour) & (contours.amax(-1, keepdim=True) > 0)
    return torch.where(outside, distances - contour, 0.0).square().mean(-1)
