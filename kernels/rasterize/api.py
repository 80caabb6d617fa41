"""The public operator: checks, batch dimensions, render modes, background."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .autograd import composite, project
from .checks import check_inputs
from .constants import ALPHA_MAX, ALPHA_MIN, EPS2D, T_MIN, TILE
from .harmonics import colors_from_harmonics
from .meta import Call, Meta
from .projection import Projected, ProjectionOptions
from .skip import Skip
from .tiles import Limits, Saved, Size

DEFAULT_SKIP = Skip()
_WEIGHT_EPS = 1e-10  # a sum of weights below this has no expected depth


class Inputs(NamedTuple):
    """The tensors of a call of ``rasterization``."""

    means: Any
    quats: Any
    scales: Any
    opacities: Any
    colors: Any
    viewmats: Any
    Ks: Any
    backgrounds: Any


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = EPS2D,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    alpha_min: float = ALPHA_MIN,
    alpha_max: float = ALPHA_MAX,
    t_min: float = T_MIN,
    skip: Skip = DEFAULT_SKIP,
) -> tuple[Tensor, Tensor, Meta]:
    """Renders N Gaussians of each object in each of its V views, all in single launches.

    ``C = Σ_i T_i α_i c_i + T_end background``, ``α_i = min(alpha_max, o_i exp(-½ dᵀ Σ⁻¹ d))``,
    ``T_i = Π_{j<i} (1 - α_j)``, front to back (Kerbl et al. 2023; conventions of gsplat 1.6).
    Differentiable in means, quats, scales, opacities, colors, viewmats and backgrounds, to any
    leading dimensions ``..``. The same input gives the same bits.

    Args:
        means: ``[.., N, 3]``, world units. float32, bfloat16 or float16, as all tensors here; the
            interior and the results are float32.
        quats: ``[.., N, 4]`` wxyz, any length (zero counts as no rotation); None: no rotation.
        scales: ``[.., N, 3]`` standard deviations, world units.
        opacities: ``[.., N]`` in (0, 1).
        colors: ``[.., N, C]`` or ``[.., V, N, C]``, any C >= 1; with ``sh_degree``: spherical
            harmonics coefficients ``[.., N, K, 3]``, K >= (sh_degree + 1)².
        viewmats: ``[.., V, 4, 4]`` world to camera, OpenCV frame.
        Ks: ``[.., V, 3, 3]`` intrinsics in pixels, pixel centres at +0.5; skew is ignored.
        width: pixels.
        height: pixels.
        near_plane: Gaussians whose centre is nearer are culled; > 0.
        far_plane: Gaussians whose centre is farther are culled.
        radius_clip: Gaussians whose box is not larger than this many pixels from the centre are
            culled.
        eps2d: added to the diagonal of the projected covariance, square pixels, >= 0.
        sh_degree: None or 0 to 3.
        backgrounds: ``[.., V, C]`` (without the depth channel), or None: black.
        render_mode: "RGB", "D" (Σ w z), "ED" (Σ w z / Σ w), "RGB+D" or "RGB+ED", with the weights
            w = T α; depth comes last.
        rasterize_mode: "classic", or "antialiased": opacity times sqrt(det Σ / det(Σ + eps2d)).
        alpha_min: fainter contributions are skipped; > 0.
        alpha_max: alpha is clamped here, and has zero gradient then; < 1.
        t_min: a pixel stops before its transmittance would fall to this; 1e-30 to < 1.
        skip: work to leave out; changes neither image nor gradients.

    Returns:
        ``renders [.., V, H, W, C]``, ``alphas [.., V, H, W, 1]`` and ``meta``, a dict with
        ``means2d, conics, depths, opacities, radii, width, height, tile_size`` and work counts
        (see ``Meta``).

    Raises:
        TypeError: a tensor has another dtype, or is not a tensor.
        ValueError: a shape, device or option is not as above; the message names it. Or there are
            over 2^31 pairs of tiles and Gaussians.
        RuntimeError: a CUDA graph is captured, and these shapes were never rendered before.
    """
    given = Inputs(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
    options = dict(
        width=width, height=height, near_plane=near_plane, eps2d=eps2d, alpha_min=alpha_min,
        alpha_max=alpha_max, t_min=t_min, sh_degree=sh_degree, render_mode=render_mode,
        rasterize_mode=rasterize_mode,
    )  # fmt: skip
    check_inputs(given._asdict(), options)
    x = Inputs(*map(_dense, given))
    colors = x.colors
    if sh_degree is not None:
        colors = colors_from_harmonics(sh_degree, colors, x.means, x.viewmats).contiguous()
    projection = ProjectionOptions(
        width=width, height=height, near_plane=near_plane, far_plane=far_plane,
        radius_clip=radius_clip, eps2d=eps2d, alpha_min=alpha_min,
        antialiased=rasterize_mode == "antialiased", skip_unused=skip.unused,
    )  # fmt: skip
    # colours only cull here, so their gradient does not require the geometry's
    gaussians = x.means, x.quats, x.scales, None, x.opacities
    projected = Projected(*project(*gaussians, colors.detach(), x.viewmats, x.Ks, *projection))
    channels = _channels(render_mode, colors, projected.depths)
    colors_per_view = channels.dim() > x.means.dim()
    size = Size(width, height, x.viewmats.shape[-3], colors_per_view, skip.bits())
    limits = Limits(alpha_min, alpha_max, t_min)
    call = Call(Projected(*(x.detach() for x in projected)), size, limits)
    bins = call.bins()
    tiles, compiling = bins.starts.numel() - 1, torch.compiler.is_compiling()
    skipped = None if compiling else bins.starts.new_zeros(tiles)
    drawn = projected.means2d, projected.conics, projected.view_opacities, channels
    given = list(bins), skipped, None, *size, *limits
    renders, transmittances, *saved = composite(*drawn, *given)
    renders = _finish(render_mode, renders, transmittances, x.backgrounds)
    meta = Meta(call, bins, Saved(*saved), skipped)
    # under gsplat's names
    meta.update(means2d=projected.means2d, conics=projected.conics, depths=projected.depths)
    meta.update(opacities=projected.view_opacities, width=width, height=height, tile_size=TILE)
    return renders, 1.0 - transmittances, meta


def _dense(x: Tensor | None) -> Tensor | None:
    """Contiguous float32."""
    return None if x is None else x.float().contiguous()


def _channels(render_mode: str, colors: Tensor, depths: Tensor) -> Tensor:
    """Channels to blend: ``[.., N, C]`` shared by the views, or ``[.., V, N, C]``.

    An expected depth needs the sum of the weights too, which is a channel of ones. ``alphas`` is
    that sum but for rounding: it is made as 1 - T, and where a pixel is faint, it has lost digits.
    Depth and ones come first, so that CUDA has both in one chunk of channels: where depths are
    equal their gradients cancel, and two rounded sums would leave a rest.
    """
    if render_mode == "RGB":
        return colors
    parts = [depths[..., None]]
    if render_mode.endswith("ED"):
        parts.append(torch.ones_like(parts[0]))
    if "RGB" in render_mode:
        if colors.dim() == depths.dim():
            colors = colors[..., None, :, :].expand(*depths.shape, -1)
        parts.append(colors)
    return torch.cat(parts, -1)


def _finish(
    render_mode: str, renders: Tensor, transmittances: Tensor, backgrounds: Tensor | None
) -> Tensor:
    """Expected depth, and the background behind the colour channels.

    The background's weight is T: 1 - alpha has lost digits where a pixel is almost opaque.
    """
    depth = None
    if render_mode.endswith("ED"):
        depth, weight, renders = renders.split([1, 1, renders.shape[-1] - 2], -1)
        depth = depth / weight.clamp_min(_WEIGHT_EPS)
    elif render_mode != "RGB":
        depth, renders = renders.split([1, renders.shape[-1] - 1], -1)
    if backgrounds is not None and renders.shape[-1]:
        renders = renders + transmittances * backgrounds[..., None, None, :]
    return renders if depth is None else torch.cat([renders, depth], -1)
