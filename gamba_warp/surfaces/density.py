"""Opacity field of Gaussians, and its level set by marching cubes (scikit-image)."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import torch

from ..errors import UserError
from ..gaussians import Gaussians

FAINT = 0.05  # opacity that separates inside from outside when cavities are filled
EDGE = 1.1  # largest coordinate of the grid; surfaces are closed there
LEAST = 0.005  # lower alpha is ignored
MOST_POINTS = 1 << 27  # largest grid: half a gigabyte, five times that during filling
_BATCH = 2_000_000  # points evaluated at once: 100 MB


def level_set(gaussians: Gaussians, voxels: int, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Extract a surface by marching cubes on ``opacity_volume``, with closed cavities filled.

    Thin parts become thicker by about the width of a Gaussian.

    Args:
        gaussians: one object.
        voxels: number of voxels per unit.
        level: value of the volume at the surface, in (0, 1).

    Returns:
        Vertices ``[V, 3]`` float64 and faces ``[F, 3]`` int64, outside in front.

    Raises:
        UserError: the density does not reach the level, or the grid would be too large.
    """
    from skimage.measure import marching_cubes

    volume, origin = opacity_volume(gaussians, voxels)
    if volume.max() <= level:
        raise UserError(f"the density's maximum is {volume.max():.3g}, under {level}")
    volume[_cavities(volume)] = 1.0
    vertices, faces, _, _ = marching_cubes(volume, level)
    faces = faces[:, ::-1]  # scikit-image's faces point to larger values
    return origin + vertices.astype(np.float64) / voxels, faces.astype(np.int64)


def _cavities(volume: np.ndarray) -> np.ndarray:
    """Return the voxels inside a shell, bool; the first voxel counts as outside.

    A shell of splats has holes at the level of the surface. So the inside is found at a low
    density, where the shell is closed, and grown to the ridge of the shell.
    """
    from skimage.measure import label
    from skimage.segmentation import watershed

    parts = cast(np.ndarray, label(volume < FAINT, connectivity=1))
    if parts.max(initial=0) < 2:
        return np.zeros(volume.shape, bool)
    seeds = np.where(parts == parts[0, 0, 0], 1, np.where(parts > 0, 2, 0))
    return watershed(volume, seeds) == 2


def opacity_volume(gaussians: Gaussians, voxels: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute 1 - prod(1 - alpha) on a grid, alpha = opacity · exp(-d²/2), d Mahalanobis distance.

    Each Gaussian is evaluated only at the points it reaches.

    Args:
        gaussians: one object; Gaussians outside [-1, 1]^3 or without volume are left out, and so
            are alpha under 0.005 and parts beyond [-1.1, 1.1]^3.
        voxels: number of grid points per unit.

    Returns:
        The volume ``[X, Y, Z]`` float32 with an empty margin, and its first point ``[3]``.

    Raises:
        UserError: no Gaussian is visible, or the grid would be too large.
    """
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    gaussians = gaussians.to("cpu").detach()
    gaussians = gaussians.select(
        (gaussians.opacities > LEAST) & (gaussians.means.abs() < 1).all(-1)
    )
    axes = torch.diag_embed(gaussians.scales)
    if gaussians.quats is not None:
        axes = quaternion_to_rotation_matrix(gaussians.quats) @ axes
    to_unit, flat = torch.linalg.inv_ex(axes)
    if flat.any():
        solid = flat == 0
        gaussians, axes, to_unit = gaussians.select(solid), axes[solid], to_unit[solid]
    if gaussians.num == 0:
        raise UserError("no visible Gaussian within [-1, 1]^3")
    reach = (2 * torch.log(gaussians.opacities / LEAST)).sqrt()[:, None] * axes.norm(dim=-1)
    half = _rounded_up((reach * voxels).ceil().long().clamp(1, voxels))  # along each axis
    position = gaussians.means * voxels
    edge = math.ceil(EDGE * voxels)
    first = (position.floor().long() - half).amin(0).clamp_min(-edge)
    last = (position.ceil().long() + half).amax(0).clamp_max(edge)
    shape = tuple((last - first + 1).tolist())
    if math.prod(shape) > MOST_POINTS:
        size = " x ".join(map(str, shape))
        raise UserError(f"{voxels} voxels a unit: a grid of {size} points is over {MOST_POINTS:,}")
    absorbed = torch.zeros(shape)
    boxes, kinds = half.unique(dim=0, return_inverse=True)
    order = kinds.argsort(stable=True)
    # Gaussians of one size are evaluated together.
    for box, members in zip(boxes, order.split(kinds.bincount().tolist())):
        spans = [torch.arange(-size, size + 1) for size in box.tolist()]
        points = torch.stack(torch.meshgrid(*spans, indexing="ij"), -1).reshape(-1, 3)
        for part in members.split(max(1, _BATCH // len(points))):
            _splat(absorbed, gaussians.select(part), to_unit[part], points, first, voxels)
    absorbed = torch.nn.functional.pad(absorbed, (1,) * 6)
    return 1 - torch.exp(-absorbed).numpy(), (first - 1).numpy() / voxels


def _rounded_up(sizes: torch.Tensor) -> torch.Tensor:
    """Round up to the next of 1, 2, 3, 4, 5, 7, 9, ..., to have few sizes."""
    steps = [1]
    while steps[-1] < int(sizes.max()):
        steps.append(max(steps[-1] + 1, steps[-1] * 5 // 4))
    steps = torch.tensor(steps)
    return steps[torch.searchsorted(steps, sizes)]


def _splat(absorbed, gaussians, to_unit, box, first, voxels) -> None:
    """Add -log(1 - alpha) of some Gaussians, each in a ``box [P, 3]`` of points around it."""
    position = gaussians.means * voxels
    points = position.round().long()[:, None] + box
    offset = (points - position[:, None]) / voxels
    squared = (offset @ to_unit.mT).square().sum(-1)
    alpha = gaussians.opacities[:, None] * torch.exp(-0.5 * squared)
    x, y, z = (points - first).unbind(-1)
    keep = alpha > LEAST
    for value, size in zip((x, y, z), absorbed.shape):
        keep &= (value >= 0) & (value < size)
    index = ((x * absorbed.shape[1] + y) * absorbed.shape[2] + z)[keep]
    absorbed.view(-1).index_add_(0, index, -torch.log1p(-alpha[keep].clamp(max=0.9999)))
