"""About single Gaussians: covariances and steps of a projection in torch, spherical harmonics."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gamba_warp.kernels.rasterize.constants import FRUSTUM_MARGIN
from gamba_warp.kernels.rasterize.harmonics import sums_seen_from

from .checks import MAX_SH_DEGREE, only, shape, side

_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])  # rows and columns of xx xy xz yy yz zz


def upper_triangle(matrices: Tensor) -> Tensor:
    """``[.., 3, 3]`` to the six entries on and over the diagonal, ``[.., 6]``."""
    return matrices[..., _UPPER[0], _UPPER[1]]


def symmetric(entries: Tensor) -> Tensor:
    """The way back from ``upper_triangle``: ``[.., 6]`` to ``[.., 3, 3]``."""
    return entries[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))


def rotations(quats: Tensor) -> Tensor:
    """``[.., 4]`` wxyz of any length to rotation matrices ``[.., 3, 3]``."""
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def quat_scale_to_covar_preci(
    quats: Tensor,
    scales: Tensor,
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Rotations and standard deviations to covariances and their inverses.

    Args:
        quats: ``[.., 4]`` wxyz, any length.
        scales: ``[.., 3]``.
        compute_covar: if False, the first result is None.
        compute_preci: if False, the second result is None.
        triu: the six entries xx, xy, xz, yy, yz, zz in place of the matrix.

    Returns:
        Covariances R diag(s²) Rᵀ and their inverses, ``[.., 3, 3]``, or ``[.., 6]``.

    Raises:
        TypeError: no tensor.
        ValueError: the shapes do not fit.
    """
    lead = tuple(scales.shape[:-1]) if isinstance(scales, Tensor) else ()
    shape("scales", scales, (*lead, 3))
    shape("quats", quats, (*lead, 4))
    rotation = rotations(quats)

    def product(lengths: Tensor) -> Tensor:
        root = rotation * lengths[..., None, :]
        square = root @ root.mT
        return upper_triangle(square) if triu else square

    return product(scales) if compute_covar else None, (
        product(1 / scales) if compute_preci else None
    )


def spherical_harmonics(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None
) -> Tensor:
    """Values of real spherical harmonics, ``Σ_k Y_k(dirs) coeffs_k``; nothing is added or clamped.

    Args:
        degrees_to_use: 0 to 4; coefficients beyond it are not used.
        dirs: ``[.., 3]``, of any length.
        coeffs: ``[.., K, D]``, K >= (degrees_to_use + 1)²; gsplat's D is 3.
        masks: ``[..]`` bool, or None; the result is 0 where it is False.

    Returns:
        ``[.., D]``; NaN in all D without a gradient where a direction or a used coefficient is not
        finite.

    Raises:
        TypeError: no tensor.
        ValueError: the degree or a shape is not as above.
    """
    if degrees_to_use not in range(MAX_SH_DEGREE + 1):
        raise ValueError(f"degrees_to_use is {degrees_to_use!r}, allowed are 0 to {MAX_SH_DEGREE}")
    lead = tuple(dirs.shape[:-1]) if isinstance(dirs, Tensor) else ()
    shape("dirs", dirs, (*lead, 3))
    shape("coeffs", coeffs, (*lead, *coeffs.shape[-2:]))
    used = (degrees_to_use + 1) ** 2
    if coeffs.shape[-2] < used:
        raise ValueError(f"coeffs has shape {list(coeffs.shape)}, allowed is K >= {used}")
    if masks is not None:
        shape("masks", masks, lead)
    rows = coeffs.reshape(1, -1, *coeffs.shape[-2:])
    values = sums_seen_from(degrees_to_use, rows, dirs.reshape(1, -1, 3), dirs.new_zeros(1, 1, 3))
    values = values.reshape(*lead, coeffs.shape[-1])
    return values if masks is None else torch.where(masks[..., None], values, 0.0)


def world_to_cam(means: Tensor, covars: Tensor, viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Means and covariances in the frames of cameras.

    Args:
        means: ``[.., N, 3]``.
        covars: ``[.., N, 3, 3]``.
        viewmats: ``[.., C, 4, 4]``.

    Returns:
        ``[.., C, N, 3]`` and ``[.., C, N, 3, 3]``.
    """
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    turned = means[..., None, :, :] @ rotation.mT + translation[..., None, :]
    rotation = rotation[..., None, :, :]
    return turned, rotation @ covars[..., None, :, :, :] @ rotation.mT


def proj(
    means: Tensor,
    covars: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    camera_model: str = "pinhole",
) -> tuple[Tensor, Tensor]:
    """Means and covariances in the picture, of those in cameras' frames (EWA, a pinhole's).

    Args:
        means: ``[.., C, N, 3]``.
        covars: ``[.., C, N, 3, 3]``.
        Ks: ``[.., C, 3, 3]`` in pixels; skew is ignored.
        width: pixels.
        height: pixels.
        camera_model: "pinhole".

    Returns:
        ``[.., C, N, 2]`` pixels and ``[.., C, N, 2, 2]`` square pixels.

    Raises:
        ValueError: another camera, or a size that is not allowed.
    """
    only("camera_model", camera_model, "pinhole")
    side(width=width, height=height)
    focal = torch.stack([Ks[..., 0, 0], Ks[..., 1, 1]], -1)[..., None, :]
    center = Ks[..., None, :2, 2]
    size = Ks.new_tensor([width, height])
    z = means[..., 2:]
    slopes = means[..., :2] / z
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    clamped = slopes.clamp(-(center / focal + margin), (size - center) / focal + margin)
    scale = (focal / z).expand(slopes.shape)
    jacobian = torch.cat([torch.diag_embed(scale), (-scale * clamped)[..., None]], -1)
    return focal * slopes + center, jacobian @ covars @ jacobian.mT
