"""The public operator: checks, batch dimensions, render modes, background."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .autograd import composite, project
from .constants import ALPHA_MAX, ALPHA_MIN, EPS2D, T_MIN, TILE
from .harmonics import colors_from_harmonics
from .meta import Call, Meta
from .projection import Projected, ProjectionOptions
from .skip import Skip
from .tiles import Limits, Saved, Size

DEFAULT_SKIP = Skip()
_WEIGHT_EPS = 1e-10  # a sum of weights below this has no expected depth
_DTYPES = (torch.float32, torch.bfloat16, torch.float16)
_RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_RASTERIZE_MODES = ("classic", "antialiased")
_MAX_SIDE = 2**15  # pixels
_MAX_SH_DEGREE = 3


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
    _check_inputs(given._asdict(), options)
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


def _want(name: str, value: Tensor, *allowed: tuple) -> None:
    if tuple(value.shape) not in allowed:
        shapes = " or ".join(str(list(shape)) for shape in allowed)
        raise ValueError(f"{name} must have shape {shapes}, got {list(value.shape)}")


def _check_options(options: dict) -> None:
    for name in ("width", "height"):
        value = options[name]
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= _MAX_SIDE:
            raise ValueError(f"{name} must be an integer from 1 to {_MAX_SIDE}, got {value!r}")
    if not options["near_plane"] > 0:
        raise ValueError(f"near_plane must be > 0, got {options['near_plane']}")
    if not options["eps2d"] >= 0:
        raise ValueError(f"eps2d must be >= 0, got {options['eps2d']}")
    low, high = options["alpha_min"], options["alpha_max"]
    if not 0 < low <= high < 1:
        raise ValueError(
            f"alpha_min and alpha_max must satisfy 0 < min <= max < 1, got {low}, {high}"
        )
    if not 1e-30 <= options["t_min"] < 1:
        raise ValueError(f"t_min must be in [1e-30, 1), got {options['t_min']}")
    for name, allowed in (("render_mode", _RENDER_MODES), ("rasterize_mode", _RASTERIZE_MODES)):
        if options[name] not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {options[name]!r}")
    degree = options["sh_degree"]
    if degree is not None and degree not in range(_MAX_SH_DEGREE + 1):
        raise ValueError(f"sh_degree must be None or 0 to {_MAX_SH_DEGREE}, got {degree!r}")


def _check_inputs(tensors: dict[str, Any], options: dict) -> None:
    """Checks the arguments of ``rasterization`` by name."""
    _check_options(options)
    device = getattr(tensors["means"], "device", None)
    for name, value in tensors.items():
        if value is None and name in ("quats", "backgrounds"):
            continue
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
        if value.dtype not in _DTYPES:
            names = ", ".join(str(d).removeprefix("torch.") for d in _DTYPES)
            raise TypeError(f"{name} must have dtype {names}, got {value.dtype}")
        if value.device != device:
            raise ValueError(f"{name} must be on {device}, as means, got {value.device}")
    if device is None or device.type not in ("cpu", "cuda"):
        raise ValueError(f"means must be on cpu or cuda, got {device}")

    means, viewmats, colors = tensors["means"], tensors["viewmats"], tensors["colors"]
    if means.dim() < 2 or means.shape[-1] != 3:
        raise ValueError(f"means must have shape [.., N, 3], got {list(means.shape)}")
    *lead, num, _ = means.shape
    if viewmats.dim() < 3:
        raise ValueError(f"viewmats must have shape [.., V, 4, 4], got {list(viewmats.shape)}")
    views = viewmats.shape[-3]
    _want("scales", tensors["scales"], (*lead, num, 3))
    _want("opacities", tensors["opacities"], (*lead, num))
    _want("viewmats", viewmats, (*lead, views, 4, 4))
    _want("Ks", tensors["Ks"], (*lead, views, 3, 3))
    if tensors["quats"] is not None:
        _want("quats", tensors["quats"], (*lead, num, 4))
    channels = colors.shape[-1] if colors.dim() else 0
    if options["sh_degree"] is not None:
        least = (options["sh_degree"] + 1) ** 2
        coefficients = colors.shape[-2] if colors.dim() >= 2 else 0
        if coefficients < least:
            raise ValueError(
                f"colors must have shape [.., N, K, 3] with K >= {least}, got {list(colors.shape)}"
            )
        _want("colors", colors, (*lead, num, coefficients, 3))
    else:
        if channels < 1:
            raise ValueError(f"colors must have shape [.., N, C], C >= 1, got {list(colors.shape)}")
        _want("colors", colors, (*lead, num, channels), (*lead, views, num, channels))
    if tensors["backgrounds"] is not None:
        _want("backgrounds", tensors["backgrounds"], (*lead, views, channels))


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
