"""gsplat's ``rasterization`` on our projection, tile lists and compositor."""

from __future__ import annotations

import inspect
from enum import Enum
from typing import Any, Literal

import torch
from torch import Tensor

from gamba_warp.kernels.rasterize.autograd import bin_op
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, TILE
from gamba_warp.kernels.rasterize.harmonics import colors_seen_from
from gamba_warp.kernels.rasterize.projection import ProjectionOptions
from gamba_warp.kernels.rasterize.tiles import Bins, Tiling

from ..shared import check_tensor, one_device, one_of, side
from .pixels import SKIP, blend, pair_ids
from .projection import MAX_SH_DEGREE, check_bounds, check_scene, flat, plain_conics, project_views

# Unsupported arguments, which must have their defaults. ``tile_size``, ``channel_chunk`` and
# ``segmented`` have no effect, and ``rolling_shutter`` may be gsplat's own ``GLOBAL``; all others
# are used.
MUST_BE_DEFAULT = (
    "sparse_grad", "distributed", "camera_model", "with_ut", "with_eval3d", "radial_coeffs",
    "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs", "viewmats_rs", "macro_tile",
    "return_normals", "global_z_order", "rays", "lidar_coeffs", "external_distortion_coeffs",
    "ut_params", "extra_signals", "extra_signals_sh_degree", "renderer_config",
)  # fmt: skip


CameraModel = Literal["pinhole"]
RasterizeMode = Literal["classic", "antialiased"]
RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]


class RollingShutterType(Enum):
    """Shutters of gsplat's cameras; only ``GLOBAL``, all pixels at once, is supported."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


def rasterization(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor,
    colors: Tensor | None, viewmats: Tensor, Ks: Tensor, width: int, height: int,
    near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0, eps2d: float = 0.3,
    sh_degree: int | None = None, packed: bool = True, tile_size: int | None = 16,
    backgrounds: Tensor | None = None, render_mode: str = "RGB", sparse_grad: bool = False,
    absgrad: bool = False, rasterize_mode: str = "classic", channel_chunk: int = 32,
    distributed: bool = False, camera_model: str = "pinhole", segmented: bool = False,
    covars: Tensor | None = None, with_ut: bool = False, with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None, tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None, ftheta_coeffs: Any = None,
    rolling_shutter: Any = RollingShutterType.GLOBAL, viewmats_rs: Tensor | None = None, *,
    macro_tile: bool = False, return_normals: bool = False, global_z_order: bool = True,
    rays: Tensor | None = None, lidar_coeffs: Any = None, external_distortion_coeffs: Any = None,
    ut_params: Any = None, extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None, renderer_config: Any = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:  # fmt: skip
    """Render N Gaussians of each object in each of its C views.

    The arguments, their order and defaults match gsplat 1.5.3; the keywords after the star
    came later. ``tile_size``, ``channel_chunk`` and ``segmented`` have no effect. Options that are
    not listed below must have their defaults. docs/drop-ins.md lists the differences of each
    argument.

    Args:
        means: ``[.., N, 3]``.
        quats: ``[.., N, 4]`` wxyz, any length; not used with ``covars``.
        scales: ``[.., N, 3]``; not used with ``covars``.
        opacities: ``[.., N]`` in (0, 1).
        colors: ``[.., (C,) N, D]``; with ``sh_degree`` coefficients ``[.., (C,) N, K, D]``; or None
            in the modes "D" and "ED".
        viewmats: ``[.., C, 4, 4]`` world to camera.
        Ks: ``[.., C, 3, 3]`` pixels; skew is ignored.
        width: pixels.
        height: pixels.
        near_plane: nearer Gaussians are culled; > 0.
        far_plane: farther ones are culled.
        radius_clip: ones with both radii up to this many pixels are culled.
        eps2d: added to the diagonal of the covariance in the image; >= 0.
        sh_degree: None, or 0 to 4.
        packed: ``meta`` has one row for each visible Gaussian of a view.
        tile_size: no effect; ``meta["tile_size"]`` is the side of the tiles used.
        backgrounds: ``[.., C, D]``, ``[C, D]`` or ``[D]``, or None: black.
        render_mode: "RGB", "D", "ED", "RGB+D" or "RGB+ED".
        absgrad: in backward, set ``meta["means2d"].absgrad``.
        rasterize_mode: "classic" or "antialiased".
        covars: ``[.., N, 3, 3]`` in place of quats and scales, or None.

    Returns:
        ``[.., C, H, W, X]``, alphas ``[.., C, H, W, 1]`` and ``meta``.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: a shape, device or option is not allowed; the message names it.
    """
    arguments = locals()
    for name in MUST_BE_DEFAULT:
        one_of(name, arguments[name], _PARAMETERS[name].default)
    one_of("rolling_shutter", getattr(rolling_shutter, "name", rolling_shutter), "GLOBAL")
    one_of("render_mode", render_mode, "RGB", "D", "ED", "RGB+D", "RGB+ED")
    one_of("rasterize_mode", rasterize_mode, "classic", "antialiased")
    one_of("sh_degree", sh_degree, None, *range(MAX_SH_DEGREE + 1))
    check_bounds(near_plane, eps2d)
    width, height = side(width=width, height=height)
    tensors: dict[str, Any] = dict(means=means, viewmats=viewmats, Ks=Ks, opacities=opacities)
    tensors |= dict(quats=quats, scales=scales) if covars is None else dict(covars=covars)
    lead = check_scene(tensors, (3, 3))
    num, views, colored = means.shape[-2], viewmats.shape[-3], "RGB" in render_mode
    if colored or colors is not None:
        least = () if sh_degree is None else (f"K >= {(sh_degree + 1) ** 2}",)
        shapes = ((*lead, *rows, *least, "D >= 1") for rows in ((num,), (views, num)))
        check_tensor("colors", colors, *shapes)
    if colored and colors is not None:
        shape = *lead, views, colors.shape[-1]
        check_tensor("backgrounds", backgrounds, shape, shape[-2:], shape[-1:], optional=True)
        backgrounds = None if backgrounds is None else backgrounds.expand(shape)
    one_device({"means": means, "colors": colors, "backgrounds": backgrounds})

    if covars is not None:  # as in gsplat, the upper entries count
        tensors["covars"] = covars[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    scene = {name: flat(x, lead) for name, x in tensors.items()}
    if colors is None or not colored:
        blended = torch.ones_like(scene["opacities"])[..., None]
    elif sh_degree is None:
        blended = flat(colors, lead)
    else:
        centers = torch.linalg.inv(scene["viewmats"])[..., :3, 3]
        colors = flat(colors, lead)
        blended = colors_seen_from(sh_degree, colors, scene["means"], centers).contiguous()
    options = ProjectionOptions(
        width, height, near_plane, far_plane, radius_clip, eps2d, ALPHA_MIN,
        rasterize_mode == "antialiased", skip_unused=True, rounded=True,
    )  # fmt: skip
    splats = project_views(scene, blended, options)
    radii = splats.extents.ceil().int()
    seen = (radii > 0).all(-1)
    at = seen.nonzero(as_tuple=True) if packed else None

    def shown(x: Tensor) -> Tensor:
        """Return ``[B, C, N, ..]`` in the layout of ``meta``."""
        return x.view(*lead, *x.shape[1:]) if at is None else x[at]

    # In meta these are part of the graph, so that they receive gradients.
    attached = {name: shown(getattr(splats, name)) for name in ("means2d", "depths", "opacities")}
    for name, value in attached.items():
        x = getattr(splats, name)
        x = value.view(x.shape) if at is None else x.detach().index_put(at, value)
        splats = splats._replace(**{name: x})
    ids = dict(zip(("batch_ids", "camera_ids", "gaussian_ids"), at or (None, None, None)))
    conics = shown(plain_conics(splats.conics))
    meta: dict[str, Any] = dict(**ids, **attached, radii=shown(radii), conics=conics)

    if render_mode != "RGB":  # depth comes last
        parts = [splats.depths[..., None]]
        if colored:
            each = blended if blended.dim() == 4 else blended[:, None]
            parts.insert(0, each.expand(-1, views, -1, -1))
        blended = torch.cat(parts, -1)
    tiling = Tiling(width, height)
    per_view = [x.flatten(0, 1).contiguous() for x in splats]
    bins = Bins(*bin_op(*(x.detach() for x in per_view), width, height, ALPHA_MIN, SKIP))
    layers = *per_view[:2], per_view[3], blended.flatten(0, -2).contiguous()

    def keep(values: Tensor) -> None:
        meta["means2d"].absgrad = shown(values.view(splats.means2d.shape))

    shared = views if blended.dim() == 3 else 1
    renders, transmittances = blend(layers, bins, tiling, shared, keep if absgrad else None)
    alphas = 1 - transmittances
    if render_mode != "RGB":
        renders, depth = renders.split([renders.shape[-1] - 1, 1], -1)
        depth = depth / alphas.clamp_min(1e-10) if render_mode.endswith("ED") else depth
    if colored and backgrounds is not None:
        renders = renders + transmittances * flat(backgrounds, lead).flatten(0, 1)[:, None, None]
    if render_mode != "RGB":
        renders = torch.cat([renders, depth], -1)

    # gsplat's names of the lists. Ours hold the tiles that the ellipse meets, not its box.
    counts = torch.empty_like(bins.order)
    counts[bins.order.long()] = bins.offsets.diff()
    tile = torch.arange(len(bins.starts) - 1, device=counts.device)
    tile = tile.repeat_interleave(bins.starts.diff().long())
    pairs = bins.pairs.long()
    depths = splats.depths.detach().flatten()[pairs]
    row = pairs if at is None else (seen.flatten().cumsum(0) - 1)[pairs]
    grid = tiling.tiles_y, tiling.tiles_x
    meta.update(
        tile_width=grid[1], tile_height=grid[0], tiles_per_gauss=shown(counts.view(seen.shape)),
        isect_ids=pair_ids(tile // tiling.count, tile % tiling.count, depths, tiling.count),
        flatten_ids=row.int(), isect_offsets=bins.starts[:-1].view(*lead, views, *grid),
        width=width, height=height, tile_size=TILE, n_batches=len(radii), n_cameras=views,
    )  # fmt: skip
    renders, alphas = (x.view(*lead, views, *x.shape[1:]) for x in (renders, alphas))
    return renders, alphas, meta


_PARAMETERS = inspect.signature(rasterization).parameters
