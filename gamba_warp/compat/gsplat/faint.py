"""The factor of antialiasing down to 0, as gsplat has it; that of our rasterizer ends at 0.005.

The factor is ``√(det Σ / det (Σ + eps2d I))`` of the covariance Σ in the picture. With M the 2 x 3
matrix of ``Σ = M Mᵀ`` and m0, m1 its rows, ``√(det Σ) = |m0 x m1|``: a length, whose gradient is
never longer than 1, where the root of a determinant has one that grows without bound. Our
projection does the work for all Gaussians; the few at its end are done again here, in float64.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, COMPENSATION_MIN, FRUSTUM_MARGIN

from .shapes import rotations

if TYPE_CHECKING:
    from .projection import Lens

_NEARLY = 1 + 1e-5  # float32's product of an opacity and the smallest factor, a few roundings off


def compensation_of(xx: Tensor, xy: Tensor, yy: Tensor, eps2d: float) -> Tensor:
    """The factor from covariances in the picture, before eps2d is added; 0 where they are flat.

    Args:
        xx: ``[..]`` float64, square pixels.
        xy: the same.
        yy: the same.
        eps2d: square pixels.

    Returns:
        ``[..]``; its gradient is 0 where the factor is 0.
    """
    before = xx * yy - xy * xy
    after = (xx + eps2d) * (yy + eps2d) - xy * xy
    some = before > 0
    # replaced before the root, whose slope at 0 would make NaN of a gradient of 0
    return torch.where(some, torch.where(some, before / after, 1.0).sqrt(), 0.0)


def compensation(
    means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, lens: Lens
) -> Tensor:
    """The factor of P Gaussians, each in a view of its own.

    Args:
        means: ``[P, 3]``, in front of the camera; as all that follows float64.
        quats: ``[P, 4]``.
        scales: ``[P, 3]``.
        viewmats: ``[P, 4, 4]``.
        Ks: ``[P, 3, 3]``.
        lens: size of the picture, and eps2d.

    Returns:
        ``[P]`` in [0, 1).
    """
    turn = viewmats[:, :3, :3]
    place = (turn @ means[..., None])[..., 0] + viewmats[:, :3, 3]
    focal = torch.stack([Ks[:, 0, 0], Ks[:, 1, 1]], -1)
    center, size = Ks[:, :2, 2], Ks.new_tensor([lens.width, lens.height])
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    slopes = place[:, :2] / place[:, 2:]
    slopes = slopes.clamp(-(center / focal + margin), (size - center) / focal + margin)
    pixels = focal / place[:, 2:]
    jacobian = torch.cat([torch.diag_embed(pixels), (-pixels * slopes)[..., None]], -1)
    m0, m1 = (jacobian @ turn @ (rotations(quats) * scales[:, None])).unbind(-2)
    area = torch.linalg.cross(m0, m1)
    before = torch.linalg.vector_norm(area, dim=-1)  # its gradient at 0 is 0
    trace = m0.square().sum(-1) + m1.square().sum(-1)
    return before / (before.square() + lens.eps2d * trace + lens.eps2d**2).sqrt()


def exact_where_faint(
    found: tuple[Tensor, ...],
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    lens: Lens,
) -> tuple[Tensor, ...]:
    """Gives the Gaussians at the projection's smallest factor their own, and culls by it.

    Args:
        found: means2d, conics, depths, opacities and extents as ``project`` returns them.
        means: as ``project_views``, like all that follows.

    Returns:
        The same five, differentiable in means, quats, scales, opacities and viewmats.
    """
    centers, conics, depths, shown, extents = found
    with torch.no_grad():
        floor = opacities[:, None] * (COMPENSATION_MIN * _NEARLY)
        at = torch.nonzero((extents > 0).all(-1) & (shown <= floor), as_tuple=True)
    if len(at[0]) == 0:
        return found
    b, c, g = at
    mean, quat, scale, opacity = (x[b, g].double() for x in (means, quats, scales, opacities))
    viewmat, K = viewmats[b, c].double(), Ks[b, c].double()
    exact = opacity * compensation(mean, quat, scale, viewmat, K, lens)
    with torch.no_grad():
        cut = (2 * (exact / ALPHA_MIN).clamp_min(1).log()).sqrt()
        was = (2 * (shown[at].double() / ALPHA_MIN).clamp_min(1).log()).sqrt()
        sides = extents[at] * (cut / was.clamp_min(1e-12)).float()[:, None]
        reach, size = sides.ceil(), centers.new_tensor([lens.width, lens.height])
        inside = (centers[at] + reach >= 0) & (centers[at] - reach <= size)
        kept = (exact >= ALPHA_MIN) & inside.all(-1) & (reach > lens.radius_clip).any(-1)
        lost = torch.zeros_like(shown, dtype=torch.bool)
        lost[at] = ~kept
        extents = extents.index_put(at, sides)
    shown = shown.index_put(at, exact.float()).masked_fill(lost, 0.0)
    conics = torch.where(lost[..., None], conics.new_tensor([1.0, 0.0, 1.0]), conics)
    centers, extents = (x.masked_fill(lost[..., None], 0.0) for x in (centers, extents))
    return centers, conics, depths.masked_fill(lost, 0.0), shown, extents
