"""The oracle: dense torch, any float dtype, gradients by autograd.

No tiles and no lists: every pixel sees every Gaussian, in depth order. It shares conventions and
constants with the kernels, and no code; the 2D conic is the plain inverse of the covariance.
"""

import math

import torch
from torch import Tensor

from .constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    COMPENSATION_MIN,
    CONIC_MAX,
    EPS2D,
    FRUSTUM_MARGIN,
    T_MIN,
)

_CHUNK = 4096  # pixels at once


def _rotations(quats: Tensor) -> Tensor:
    norm = quats.norm(dim=-1, keepdim=True)
    identity = quats.new_tensor([1.0, 0, 0, 0]).expand_as(quats)
    w, x, y, z = torch.where(norm > 0, quats / norm.clamp_min(1e-300), identity).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _jacobian(points: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    x, y, z = points.unbind(-1)
    slopes = []
    for slope, axis, size in ((x / z, 0, width), (y / z, 1, height)):
        focal, center = K[axis, axis].item(), K[axis, 2].item()
        margin = FRUSTUM_MARGIN * 0.5 * size / focal
        slopes.append(slope.clamp(-(center / focal + margin), (size - center) / focal + margin))
    zero = torch.zeros_like(z)
    return torch.stack(
        [
            torch.stack([K[0, 0] / z, zero, -K[0, 0] * slopes[0] / z], -1),
            torch.stack([zero, K[1, 1] / z, -K[1, 1] * slopes[1] / z], -1),
        ],
        -2,
    )


def _blend(mean2d, conic, opacity, channels, pixels, alpha_min, alpha_max, t_min):
    dx, dy = (pixels[:, None] - mean2d[None]).unbind(-1)
    q = conic[:, 0, 0] * dx * dx + 2 * conic[:, 0, 1] * dx * dy + conic[:, 1, 1] * dy * dy
    alpha = (opacity * torch.exp(-0.5 * q)).clamp_max(alpha_max)
    alpha = torch.where(alpha >= alpha_min, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 1)
    # a pixel stops before the Gaussian that would bring it to t_min; those behind change nothing
    alpha = torch.where((after > t_min).cummin(1).values, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    weight = before * alpha
    return weight @ channels, weight.sum(1, keepdim=True)


def pixel_centers(width: int, height: int) -> Tensor:
    """Return the centres ``[H, W, 2]`` of an image's pixels, x and y."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y], -1) + 0.5


def render_view(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = EPS2D,
    antialiased: bool = False,
    alpha_min: float = ALPHA_MIN,
    alpha_max: float = ALPHA_MAX,
    t_min: float = T_MIN,
    pixels: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """One object in one view: colours ``[H, W, C]``, depth Σ w z and alpha ``[H, W, 1]``.

    Args:
        means: ``[N, 3]``; every Gaussian must be finite.
        quats: ``[N, 4]`` or None.
        scales: ``[N, 3]``.
        opacities: ``[N]``.
        colors: ``[N, C]``.
        viewmat: ``[4, 4]``.
        K: ``[3, 3]``.
        width: pixels.
        height: pixels.
        near_plane: as ``rasterization``, like the rest.
        far_plane: as ``rasterization``.
        eps2d: as ``rasterization``.
        antialiased: as ``rasterize_mode="antialiased"``.
        alpha_min: as ``rasterization``.
        alpha_max: as ``rasterization``.
        t_min: as ``rasterization``.
        pixels: ``[H, W, 2]`` centres of pixels, x and y; None: all of the image.
    """
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = points[:, 2].detach()
    seen = ((depth >= near_plane) & (depth <= far_plane) & (opacities >= alpha_min)).nonzero()[:, 0]
    order = seen[torch.argsort(depth[seen], stable=True)]
    points, scales, opacity, colors = points[order], scales[order], opacities[order], colors[order]
    mean2d = points[:, :2] / points[:, 2:] * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
    M = _jacobian(points, K, width, height) @ viewmat[:3, :3]
    M = (M if quats is None else M @ _rotations(quats[order])) * scales[:, None]
    cov0 = M @ M.mT
    cov = cov0 + eps2d * torch.eye(2, dtype=cov0.dtype)
    with torch.no_grad():  # a determinant without cancellation
        det = torch.linalg.cross(M[:, 0], M[:, 1]).square().sum(-1)
        det = det + eps2d * cov0.diagonal(dim1=-2, dim2=-1).sum(-1) + eps2d**2
        yy = cov[:, 1, 1]
        solid = (det > 0) & (yy <= CONIC_MAX * det) & (yy * CONIC_MAX >= 1)
    # replaced before they are inverted: a gradient of 0 is 0 then, and not NaN
    cov = torch.where(solid[:, None, None], cov, torch.eye(2, dtype=cov0.dtype))
    opacity = torch.where(solid, opacity, 0.0)
    if antialiased:
        ratio = torch.linalg.det(cov0) / torch.linalg.det(cov)
        opacity = opacity * ratio.clamp_min(COMPENSATION_MIN**2).sqrt()
    conic = torch.linalg.inv(cov)
    pixels = (pixel_centers(width, height) if pixels is None else pixels).to(means)
    channels = torch.cat([colors, points[:, 2:]], 1)
    size = max(1, math.ceil(_CHUNK * 64 / max(1, len(order))))
    parts = [
        _blend(mean2d, conic, opacity, channels, chunk, alpha_min, alpha_max, t_min)
        for chunk in pixels.flatten(0, 1).split(size)
    ]
    blended = torch.cat([p[0] for p in parts]).view(*pixels.shape[:2], -1)
    alpha = torch.cat([p[1] for p in parts]).view(*pixels.shape[:2], 1)
    return blended[..., :-1], blended[..., -1:], alpha


def rasterization_reference(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    backgrounds=None,
    **options,
) -> tuple[Tensor, Tensor, Tensor]:
    """``render_view`` for leading dimensions ``..`` and V views.

    Returns:
        ``renders [.., V, H, W, C]`` on the background, ``depths`` and ``alphas [.., V, H, W, 1]``.
    """
    lead, views = viewmats.shape[:-3], viewmats.shape[-3]
    out = []
    for index in torch.cartesian_prod(*(torch.arange(n) for n in (*lead, views))).view(
        -1, len(lead) + 1
    ):
        *b, v = index.tolist()
        b = tuple(b)
        object_colors = colors[(*b, v)] if colors.dim() == len(lead) + 3 else colors[b]
        color, depth, alpha = render_view(
            means[b],
            None if quats is None else quats[b],
            scales[b],
            opacities[b],
            object_colors,
            viewmats[(*b, v)],
            Ks[(*b, v)],
            width,
            height,
            **options,
        )
        if backgrounds is not None:
            color = color + (1 - alpha) * backgrounds[(*b, v)]
        out.append((color, depth, alpha))
    renders, depths, alphas = (
        torch.stack(parts).view(*lead, views, *parts[0].shape) for parts in zip(*out)
    )
    return renders, depths, alphas
