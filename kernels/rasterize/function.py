"""The public operator: checks, batch dimensions, render modes, background."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .checks import check_inputs
from .constants import ALPHA_MAX, ALPHA_MIN, EPS2D, T_MIN
from .cpu.tuning import current
from .harmonics import colors_from_harmonics
from .meta import Meta
from .ops import bin_op, composite, project
from .skip import Skip
from .tiles import Bins, Walk

EVERYTHING = Skip()
_DEPTH_EPS = 1e-10  # alpha below this has no expected depth


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
    skip: Skip = EVERYTHING,
    **gsplat_options,
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
        eps2d: added to the diagonal of the projected covariance, square pixels, > 0.
        sh_degree: None or 0 to 3.
        backgrounds: ``[.., V, C]`` (without the depth channel), or None: black.
        render_mode: "RGB", "D" (Σ w z), "ED" (D / alpha), "RGB+D" or "RGB+ED": depth comes last.
        rasterize_mode: "classic", or "antialiased": opacity times sqrt(det Σ / det(Σ + eps2d)).
        alpha_min: fainter contributions are skipped; > 0.
        alpha_max: alpha is clamped here, and has zero gradient then; < 1.
        t_min: a pixel stops before its transmittance would fall to this; 1e-30 to < 1.
        skip: what work to leave out; changes neither picture nor gradients.
        gsplat_options: what else gsplat's function takes, so that its callers need no change:
            ``packed, tile_size, channel_chunk, segmented`` have no effect, others are accepted at
            the values that ask for nothing.

    Returns:
        ``renders [.., V, H, W, C]``, ``alphas [.., V, H, W, 1]`` and ``meta``, a dict with
        ``means2d, conics, depths, opacities, radii, width, height, tile_size`` and work counts
        (see ``Meta``).

    Raises:
        TypeError: a tensor has another dtype, or is no tensor; an unknown option.
        ValueError: a shape, device or option is not as above; the message names it. Or there are
            over 2^31 pairs of tiles and Gaussians.
    """
    tensors = dict(
        means=means, quats=quats, scales=scales, opacities=opacities, colors=colors,
        viewmats=viewmats, Ks=Ks, backgrounds=backgrounds,
    )  # fmt: skip
    options = dict(
        width=width, height=height, near_plane=near_plane, eps2d=eps2d, alpha_min=alpha_min,
        alpha_max=alpha_max, t_min=t_min, sh_degree=sh_degree, render_mode=render_mode,
        rasterize_mode=rasterize_mode,
    )  # fmt: skip
    lead = check_inputs(tensors, options, gsplat_options)
    views, size = viewmats.shape[-3], math.prod(lead)
    flat = [_flat(x, size, len(lead)) for x in tensors.values()]
    means, quats, scales, opacities, colors, viewmats, Ks, backgrounds = flat
    if sh_degree is not None:
        colors = colors_from_harmonics(sh_degree, colors, means, viewmats).contiguous()
    lens = [width, height, near_plane, far_plane, radius_clip, eps2d, alpha_min]
    lens = [float(x) for x in (*lens, rasterize_mode == "antialiased", skip.unused)]
    seen = colors.detach()  # for what is culled: no reason to compute the geometry's gradients
    *projected, status = project(means, quats, scales, opacities, seen, viewmats, Ks, lens)
    # with the caller's dimensions first: a gradient retained on meta's tensors must be on the way
    projected = [x.view(*lead, *x.shape[1:]) for x in projected]
    per_view = [x.reshape(size * views, *x.shape[len(lead) + 1 :]) for x in projected]
    means2d, conics, depths, view_opacities, _ = per_view
    bins = bin_op(*(x.detach() for x in per_view), width, height, alpha_min, skip.bits())
    channels = _channels(render_mode, colors, depths.view(size, views, means.shape[1]))
    size2d = [width, height, views, int(channels.dim() == 4), skip.bits()]
    channels = channels.reshape(-1, channels.shape[-1])
    skipped = None if torch.compiler.is_compiling() else bins[-1].new_full((), -1)
    splats, limits = (means2d, conics, view_opacities, channels), [alpha_min, alpha_max, t_min]
    renders, alphas, *walk = composite(*splats, list(bins), size2d, limits, skipped)
    renders = _finish(render_mode, renders, alphas, backgrounds)
    meta = Meta(Bins(*bins), Walk(*walk), status, skipped)
    _describe(meta, projected, width, height)
    renders, alphas = (x.view(*lead, views, *x.shape[1:]) for x in (renders, alphas))
    return renders, alphas, meta


def _flat(x: Tensor | None, size: int, lead: int) -> Tensor | None:
    """One batch dimension of the given size for the leading ones; contiguous float32."""
    return None if x is None else x.reshape(size, *x.shape[lead:]).float().contiguous()


def _describe(meta: Meta, projected: list[Tensor], width: int, height: int) -> None:
    """What gsplat's ``meta`` has under the same names."""
    meta.update(zip(("means2d", "conics", "depths", "opacities"), projected))
    meta.update(radii=projected[4].ceil().int(), width=width, height=height)
    meta["tile_size"] = current().tile


def _channels(render_mode: str, colors: Tensor, depths: Tensor) -> Tensor:
    """What is blended: ``[B, N, C]`` shared by the views, or ``[B, V, N, C]``."""
    if render_mode == "RGB":
        return colors
    depth = depths[..., None]
    if render_mode in ("D", "ED"):
        return depth
    if colors.dim() == 3:
        colors = colors[:, None].expand(-1, depth.shape[1], -1, -1)
    return torch.cat([colors, depth], -1)


def _finish(render_mode: str, renders: Tensor, alphas: Tensor, backgrounds: Tensor | None):
    """Expected depth, and the background behind the colour channels."""
    depth = None
    if render_mode != "RGB":
        renders, depth = renders[..., :-1], renders[..., -1:]
        if render_mode.endswith("ED"):
            depth = depth / alphas.clamp_min(_DEPTH_EPS)
    if backgrounds is not None and renders.shape[-1]:
        renders = renders + (1.0 - alphas) * backgrounds.flatten(0, 1)[:, None, None]
    return renders if depth is None else torch.cat([renders, depth], -1)
