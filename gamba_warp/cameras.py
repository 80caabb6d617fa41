"""Cameras and their conventions.

``viewmats [.., V, 4, 4]`` map world to camera in the OpenCV frame (x right, y down, z forward).
``Ks [.., V, 3, 3]`` are in pixels, with pixel centres at +0.5. Dataset files hold camera-to-world
matrices in the OpenGL/Blender frame (x right, y up, z backward); ``from_opengl`` converts them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from .conventions import DEFAULT_DISTANCE, DEFAULT_FOV

_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


@dataclass
class Cameras:
    """V pinhole cameras with one image size.

    Attributes:
        viewmats: ``[.., V, 4, 4]`` world to camera, OpenCV frame.
        Ks: ``[.., V, 3, 3]`` intrinsics in pixels.
        width: width of the images, pixels.
        height: height of the images, pixels.
    """

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    def __getitem__(self, index) -> Cameras:
        """Index the leading dimensions of both tensors."""
        return replace(self, viewmats=self.viewmats[index], Ks=self.Ks[index])

    def to(self, *args, **kwargs) -> Cameras:
        """Move or convert both tensors, with the arguments of ``torch.Tensor.to``."""
        return replace(
            self, viewmats=self.viewmats.to(*args, **kwargs), Ks=self.Ks.to(*args, **kwargs)
        )

    def resized(self, width: int, height: int) -> Cameras:
        """Return the same cameras for another image size; the field of view stays."""
        factor = self.Ks.new_tensor([width / self.width, height / self.height, 1.0])
        return Cameras(self.viewmats, self.Ks * factor[:, None], width, height)


def intrinsics(width: int, height: int, fov: float = DEFAULT_FOV) -> Tensor:
    """Return K ``[3, 3]`` float32 of square pixels, a centred axis and a vertical fov, degrees."""
    focal = 0.5 * height / math.tan(math.radians(fov) / 2)
    return torch.tensor(
        [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]], dtype=torch.float32
    )


def from_opengl(camera_to_world: Tensor) -> Tensor:
    """Convert camera-to-world OpenGL matrices to world-to-camera OpenCV ones, ``[.., 4, 4]``."""
    inverse = torch.linalg.inv(camera_to_world.double())
    return (_FLIP @ inverse).to(camera_to_world.dtype)


def reference_viewmat(distance: float = DEFAULT_DISTANCE) -> Tensor:
    """Return ``[4, 4]`` float32 of the reference camera, which looks along +z at the origin."""
    viewmat = torch.eye(4, dtype=torch.float32)
    viewmat[2, 3] = distance
    return viewmat


def orbit(
    azimuths: Tensor, elevation: float | Tensor = 0.0, distance: float | Tensor = DEFAULT_DISTANCE
) -> Tensor:
    """Return world-to-camera matrices ``[V, 4, 4]`` float32 on an orbit about the origin.

    The world is the reference camera's frame, so "up" is -y. The reference camera itself has
    azimuth and elevation 0, and a camera of positive elevation looks down from above.

    Args:
        azimuths: ``[V]``, degrees.
        elevation: degrees, one or ``[V]``.
        distance: object units, one or ``[V]``.
    """
    a = torch.deg2rad(torch.as_tensor(azimuths, dtype=torch.float64))
    e = torch.deg2rad(torch.as_tensor(elevation, dtype=torch.float64)).expand_as(a)
    d = torch.as_tensor(distance, dtype=torch.float64).expand_as(a)
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    # z (forward) points from the camera to the origin, x (right) stays horizontal, and y (down) is
    # z × x.
    forward = torch.stack([-a.sin() * e.cos(), e.sin(), a.cos() * e.cos()], -1)
    right = torch.stack([a.cos(), zero, a.sin()], -1)
    down = torch.linalg.cross(forward, right)
    viewmats = torch.zeros(len(a), 4, 4, dtype=torch.float64)
    viewmats[:, :3, :3] = torch.stack([right, down, forward], 1)
    viewmats[:, 2, 3] = d
    viewmats[:, 3, 3] = one
    return viewmats.float()


def fibonacci_sphere(count: int) -> np.ndarray:
    """Return ``[count, 3]`` float64 unit vectors, evenly spread and none along an axis."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


def relative_to_reference(
    viewmats: Tensor, reference: Tensor, distance: float = DEFAULT_DISTANCE
) -> tuple[Tensor, Tensor]:
    """Express poses in the reference camera's frame, at a normalised distance.

    The new world has the object's origin, the axes of the reference camera, and a unit in which the
    reference camera is at ``distance``. If the reference camera looks at the origin, its new matrix
    is ``reference_viewmat``; else the offset of its axis from the origin remains.

    Args:
        viewmats: ``[.., V, 4, 4]`` world to camera.
        reference: ``[.., 4, 4]`` world to camera of the reference view.
        distance: distance of the reference camera from the origin in the new world.

    Returns:
        New ``viewmats [.., V, 4, 4]``, and ``scale [..]``, the new length of an old unit. A point
        becomes ``x_new = scale · R_reference · x_old``.
    """
    rotation = reference[..., :3, :3]
    scale = distance / reference[..., :3, 3].norm(dim=-1)
    out = viewmats.clone()
    out[..., :3, :3] = exact_product(viewmats[..., :3, :3], rotation[..., None, :, :].mT)
    out[..., :3, 3] = viewmats[..., :3, 3] * scale[..., None, None]
    return out, scale


def exact_product(rows: Tensor, matrix: Tensor) -> Tensor:
    """Compute ``rows @ matrix`` with inner size 3, in full precision forward and backward.

    Training lets a GPU round the factors of matrix products to TF32, with 11 bits each. The setting
    is process-wide, and a backward pass runs after any guard around the forward pass has ended. So
    geometry multiplies and adds instead.

    Args:
        rows: ``[.., N, 3]``.
        matrix: ``[.., 3, K]``; leading dimensions are broadcast.

    Returns:
        ``[.., N, K]``.
    """
    x, y, z = (column[..., None] for column in rows.unbind(-1))
    first, second, third = (row[..., None, :] for row in matrix.unbind(-2))
    return torch.addcmul(torch.addcmul(x * first, y, second), z, third)


def _inverse(matrices: Tensor) -> Tensor:
    """Invert ``[.., 3, 3]`` by cofactors; ``torch.linalg.inv`` would synchronise with the GPU."""
    a, b, c = matrices.unbind(-2)
    pairs = ((b, c), (c, a), (a, b))
    columns = torch.stack([torch.linalg.cross(x, y) for x, y in pairs], -1)
    return columns / (a * columns[..., 0]).sum(-1)[..., None, None]


def plucker_rays(viewmats: Tensor, Ks: Tensor, width: int, height: int) -> Tensor:
    """Compute Plücker coordinates (o × d, d) of the rays through all pixel centres, world frame.

    Args:
        viewmats: ``[.., 4, 4]``.
        Ks: ``[.., 3, 3]``.
        width: pixels.
        height: pixels.

    Returns:
        ``[.., height, width, 6]``: moment, then unit direction (paper §3.2; DMV3D).
    """
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    x = torch.arange(width, device=Ks.device, dtype=Ks.dtype) + 0.5
    y = torch.arange(height, device=Ks.device, dtype=Ks.dtype) + 0.5
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    pixels = torch.stack([grid_x, grid_y, torch.ones_like(grid_x)], -1)
    # d_world = Rᵀ K⁻¹ p, for row vectors.
    to_world = exact_product(_inverse(Ks).mT, rotation)
    directions = exact_product(pixels.reshape(-1, 3), to_world)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    origin = -exact_product(translation[..., None, :], rotation)[..., 0, :]
    moments = torch.linalg.cross(origin[..., None, :].expand_as(directions), directions)
    rays = torch.cat([moments, directions], -1)
    return rays.reshape(*viewmats.shape[:-2], height, width, 6)


def view_angles(cameras: Cameras) -> Tensor:
    """Return the angles between the viewpoints and the first one, seen from the origin.

    Args:
        cameras: ``[.., V]``, none at the origin.

    Returns:
        ``[.., V]``, degrees from 0 to 180.
    """
    rotations, shifts = cameras.viewmats[..., :3, :3], cameras.viewmats[..., :3, 3:]
    centers = torch.nn.functional.normalize((rotations.mT @ shifts)[..., 0], dim=-1)
    return torch.rad2deg((centers * centers[..., :1, :]).sum(-1).clamp(-1, 1).acos())
