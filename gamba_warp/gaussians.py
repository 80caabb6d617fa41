"""Container of activated Gaussian parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from .kernels.rasterize.constants import ALPHA_MIN
from .kernels.rasterize.harmonics import harmonics_basis

SH_C0 = 0.28209479177387814  # value of the degree-0 spherical harmonic


@dataclass
class Gaussians:
    """3D Gaussians with activated values; any number of leading batch dimensions ``..``.

    Attributes:
        means: ``[.., N, 3]``, object units (the bounding cube of an object has side 1).
        quats: ``[.., N, 4]`` wxyz, any length > 0, or None for no rotation (cheaper).
        scales: ``[.., N, 3]`` standard deviations, > 0, object units.
        opacities: ``[.., N]`` in (0, 1).
        colors: ``[.., N, 3]`` RGB, of networks in [0, 1]; from files they may be outside.
        harmonics: ``[.., N, K, 3]``, K of 3, 8 or 15: coefficients of the spherical harmonics of
            degrees 1 to 1, 2 or 3 in the order and signs of 3DGS, for the view-dependent part
            added to ``colors`` (Kerbl et al. 2023); None: the colour is view-independent.
        antialiased: True for Gaussians that were fitted with antialiasing (Mip-Splatting, gsplat's
            mode "antialiased"); ``render`` draws them so.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    harmonics: Tensor | None = None
    antialiased: bool = False

    def __post_init__(self) -> None:
        lead = tuple(self.opacities.shape)
        want = {"means": 3, "quats": 4, "scales": 3, "colors": 3}
        for name, size in want.items():
            value = getattr(self, name)
            if value is not None and tuple(value.shape) != (*lead, size):
                raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {(*lead, size)}")
        if self.harmonics is not None:
            shape = tuple(self.harmonics.shape)
            if shape not in [(*lead, K, 3) for K in (3, 8, 15)]:
                raise ValueError(f"harmonics has shape {shape}, expected {(*lead, '3|8|15', 3)}")

    @property
    def degree(self) -> int:
        """Highest degree of the spherical harmonics, 0 to 3."""
        return 0 if self.harmonics is None else {3: 1, 8: 2, 15: 3}[self.harmonics.shape[-2]]

    @property
    def num(self) -> int:
        """Number N of Gaussians of one object."""
        return self.opacities.shape[-1]

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Return a container with ``function`` applied to every tensor."""
        return replace(self, **{name: function(value) for name, value in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """Return the attributes that are tensors, by name."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, Tensor)}

    def __getitem__(self, index) -> Gaussians:
        """Index the leading batch dimensions, the same way in every tensor."""
        return self.map(lambda value: value[index])

    def select(self, keep: Tensor) -> Gaussians:
        """Return the Gaussians of one object (no batch dimension) that ``keep [N]`` selects."""
        return self.map(lambda value: value[keep])

    def is_finite(self) -> Tensor:
        """Return a mask ``[N]`` of the Gaussians of one object that have only finite numbers."""
        values = self.tensors().values()
        return torch.stack([x.reshape(len(x), -1).isfinite().all(1) for x in values]).all(0)

    def is_drawn(self, least: float | None = None) -> Tensor:
        """Return a mask ``[N]`` of the Gaussians of one object that ``drawn`` keeps."""
        return ~(self.opacities < (ALPHA_MIN if least is None else least))

    def drawn(self, least: float | None = None) -> Gaussians:
        """Return the Gaussians of one object that are drawn, and any with an opacity of NaN.

        Args:
            least: opacity below which a Gaussian is left out. None: 1/255, below which the
                rasterizer draws nothing, so that images stay bit-identical.
        """
        return self.select(self.is_drawn(least))

    def to(self, *args, **kwargs) -> Gaussians:
        """Move or convert every tensor, with the arguments of ``torch.Tensor.to``."""
        return self.map(lambda value: value.to(*args, **kwargs))

    def detach(self) -> Gaussians:
        """Return the same values, detached from the graph."""
        return self.map(torch.Tensor.detach)

    def in_unit(self, center: Tensor, side: float) -> Gaussians:
        """Return the object with ``center [3]`` at the origin and ``side`` as the unit length."""
        return replace(self, means=(self.means - center) / side, scales=self.scales / side)

    def transformed(self, rotation: Tensor, translation: Tensor, scale: float = 1.0) -> Gaussians:
        """Return the Gaussians moved by ``x -> scale · rotation · x + translation``.

        Args:
            rotation: ``[3, 3]``, a proper rotation.
            translation: ``[3]``.
            scale: > 0.
        """
        rotation_quat = matrix_to_quat(rotation)
        quats = self.quats
        if quats is None:
            quats = torch.zeros_like(self.means[..., :1]).expand(*self.means.shape[:-1], 4).clone()
            quats[..., 0] = 1.0
        return replace(
            self,
            means=scale * self.means @ rotation.mT + translation,
            quats=quat_multiply(rotation_quat.to(quats), quats),
            scales=scale * self.scales,
            harmonics=None
            if self.harmonics is None
            else rotate_harmonics(self.harmonics, rotation),
        )


def rotate_harmonics(harmonics: Tensor, rotation: Tensor) -> Tensor:
    """Rotate spherical-harmonic coefficients: ``Y(R d) c' = Y(d) c`` for all d.

    The matrix between them is the least-squares solution at more directions than coefficients, in
    float64, which is exact up to rounding.

    Args:
        harmonics: ``[.., K, 3]``, K of 3, 8 or 15, degrees 1 and above.
        rotation: ``[3, 3]``, a proper rotation.
    """
    degree = {3: 1, 8: 2, 15: 3}[harmonics.shape[-2]]
    steps = torch.arange(64, dtype=torch.float64, device=rotation.device) + 0.5
    z, angle = 1 - steps / 32, steps * (math.pi * (3 - math.sqrt(5)))  # a spiral over the sphere
    radius = (1 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)
    before = harmonics_basis(degree, directions)[:, 1:]
    after = harmonics_basis(degree, directions @ rotation.double().mT)[:, 1:]
    matrix = torch.linalg.pinv(after) @ before
    return matrix.to(harmonics) @ harmonics


def quat_multiply(p: Tensor, q: Tensor) -> Tensor:
    """Compute the Hamilton product of wxyz quaternions ``[.., 4]``: first rotation q, then p."""
    pw, px, py, pz = p.unbind(-1)
    qw, qx, qy, qz = q.unbind(-1)
    return torch.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        dim=-1,
    )


def matrix_to_quat(rotation: Tensor) -> Tensor:
    """Compute the wxyz quaternion ``[4]``, w >= 0, of a rotation matrix ``[3, 3]``.

    It is an eigenvector of Bar-Itzhack's symmetric matrix, which is exact at every angle, also near
    180°.
    """
    m = rotation.double()
    k = m.new_zeros(4, 4)
    k[0, 0] = m.trace()
    k[0, 1:] = k[1:, 0] = torch.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    k[1:, 1:] = m + m.mT - m.trace() * torch.eye(3).to(m)
    quat = torch.linalg.eigh(k).eigenvectors[:, -1]
    return (quat if quat[0] >= 0 else -quat).to(rotation.dtype)
