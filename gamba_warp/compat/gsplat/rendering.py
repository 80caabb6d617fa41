"""gsplat's ``rasterization`` over our projection, lists and compositor."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from gamba_warp.kernels.rasterize.constants import ALPHA_MIN
from gamba_warp.kernels.rasterize.cpu.tuning import Tuning, tuning_for
from gamba_warp.kernels.rasterize.harmonics import colors_seen_from
from gamba_warp.kernels.rasterize.ops import bin_op
from gamba_warp.kernels.rasterize.tiles import Bins, Tiling

from .checks import RollingShutterType, rasterization_arguments
from .pixels import SKIP, Layers, blend
from .projection import Lens, Packing, Splats, flat, plain_conics, project_views
from .tiles import pair_ids


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = RollingShutterType.GLOBAL,
    viewmats_rs: Tensor | None = None,
    *,
    macro_tile: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    ut_params: Any = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders N Gaussians of each object in each of its C views.

    The arguments, their order and defaults are those of gsplat 1.5.3; the keywords after the star
    came later. ``tile_size``, ``channel_chunk`` and ``segmented`` have no effect. All options that
    the list below leaves out are accepted at their defaults alone. docs/drop-in-gsplat.md says of
    each argument what differs.

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
        eps2d: added to the diagonal of the covariance in the picture; > 0.
        sh_degree: None, or 0 to 4.
        packed: ``meta`` has one row for each Gaussian that a view sees.
        tile_size: no effect; ``meta["tile_size"]`` is the side of the tiles that were used.
        backgrounds: ``[.., C, D]``, or None: black.
        render_mode: "RGB", "D", "ED", "RGB+D" or "RGB+ED".
        absgrad: in backward, set ``meta["means2d"].absgrad``.
        rasterize_mode: "classic" or "antialiased".
        covars: ``[.., N, 3, 3]`` in place of quats and scales, or None.

    Returns:
        ``[.., C, H, W, X]``, alphas ``[.., C, H, W, 1]`` and ``meta``.

    Raises:
        TypeError: no tensor where one is asked for.
        ValueError: a shape, device or option is not allowed; the message names it.
    """
    arguments = dict(locals())
    return _rasterize(SimpleNamespace(**arguments), rasterization_arguments(arguments))


def _rasterize(a: SimpleNamespace, lead: tuple[int, ...]) -> tuple[Tensor, Tensor, dict[str, Any]]:
    a.views, a.num = a.viewmats.shape[-3], a.means.shape[-2]
    a.batch, a.lead = math.prod(lead), lead
    names = ("means", "quats", "scales", "covars", "opacities", "colors", "viewmats", "Ks")
    given = {k: getattr(a, k) for k in names}
    if a.covars is not None:
        given.update(quats=None, scales=None)
    if "RGB" not in a.render_mode:
        given["colors"] = a.means.new_ones(*lead, a.num, 1)
    scene = SimpleNamespace(**{k: None if x is None else flat(x, lead) for k, x in given.items()})
    if a.sh_degree is not None and "RGB" in a.render_mode:
        centers = torch.linalg.inv(scene.viewmats)[..., :3, 3]
        colors = colors_seen_from(a.sh_degree, scene.colors, scene.means, centers)
        scene.colors = colors.contiguous()
    lens = Lens(
        a.width, a.height, a.eps2d, a.near_plane, a.far_plane, a.radius_clip,
        a.rasterize_mode == "antialiased",
    )  # fmt: skip
    splats = project_views(
        scene.means, scene.quats, scene.scales, scene.covars, scene.opacities,
        scene.colors.detach(), scene.viewmats, scene.Ks, lens,
    )  # fmt: skip
    meta, splats = _described(splats, a)
    channels = _channels(a.render_mode, scene.colors, splats.depths)
    tuning = tuning_for(a.means.device.type)
    tiling = Tiling(a.width, a.height, tuning.tile)
    per_view = [x.detach().flatten(0, 1).contiguous() for x in splats[:5]]
    picture = a.width, a.height, ALPHA_MIN, SKIP
    bins = Bins(*bin_op(*per_view, *picture, tuning.numbers(), True))  # its meta shows them
    keep = _keeper(meta["means2d"], meta.pop("_packing")) if a.absgrad else None
    meta.pop("_packing", None)
    renders, alphas = _blended(splats, channels, bins, tiling, tuning, keep)
    renders = _finished(a, renders, alphas)
    _list(meta, splats, bins, tiling, a)
    renders, alphas = (x.view(*lead, a.views, *x.shape[1:]) for x in (renders, alphas))
    return renders, alphas, meta


def _described(splats: Splats, a: SimpleNamespace) -> tuple[dict[str, Any], Splats]:
    """Makes gsplat's ``meta``, and the splats that are drawn: what it shows of means2d, depths and
    opacities is on the gradient's way.
    """
    meta: dict[str, Any] = dict(batch_ids=None, camera_ids=None, gaussian_ids=None)
    if not a.packed:
        shown = splats._replace(conics=plain_conics(splats.conics))
        shown = Splats(*(x.view(*a.lead, *x.shape[1:]) for x in shown))
        size = splats.depths.shape
        splats = splats._replace(
            means2d=shown.means2d.view(*size, 2),
            depths=shown.depths.view(size),
            opacities=shown.opacities.view(size),
        )
        at = None
    else:
        at = Packing.of(splats.radii)
        shown = Splats(*(x.flatten(0, 2)[at.flat] for x in splats))
        back = {
            name: getattr(splats, name).detach().flatten(0, 2).index_copy(0, at.flat, value)
            for name, value in zip(("means2d", "depths", "opacities"), (shown[0], *shown[2:4]))
        }
        splats = splats._replace(**{k: x.view_as(getattr(splats, k)) for k, x in back.items()})
        shown = shown._replace(conics=plain_conics(shown.conics))
        meta.update(batch_ids=at.batch, camera_ids=at.camera, gaussian_ids=at.gaussian)
    meta.update(
        radii=shown.radii, means2d=shown.means2d, depths=shown.depths, conics=shown.conics,
        opacities=shown.opacities, _packing=at,
    )  # fmt: skip
    return meta, splats


def _keeper(means2d: Tensor, at: Packing | None) -> Callable[[Tensor], None]:
    def keep(values: Tensor) -> None:
        values = values if at is None else values[at.flat]
        means2d.absgrad = values.view(means2d.shape)  # type: ignore[attr-defined]

    return keep


def _channels(mode: str, colors: Tensor, depths: Tensor) -> Tensor:
    """What is blended: ``[B, N, D]`` shared by the views, or ``[B, C, N, D]``."""
    if mode == "RGB":
        return colors
    depths = depths[..., None]
    if "RGB" not in mode:
        return depths
    if colors.dim() == 3:
        colors = colors[:, None].expand(-1, depths.shape[1], -1, -1)
    return torch.cat([colors, depths], -1)


def _blended(
    splats: Splats,
    channels: Tensor,
    bins: Bins,
    tiling: Tiling,
    tuning: Tuning,
    keep: Callable[[Tensor], None] | None,
) -> tuple[Tensor, Tensor]:
    views = 1 if channels.dim() == 4 else splats.depths.shape[1]
    layers = Layers(
        splats.means2d.flatten(0, 1).contiguous(),
        splats.conics.flatten(0, 1).contiguous(),
        splats.opacities.flatten(0, 1).contiguous(),
        channels.reshape(-1, channels.shape[-1]).contiguous(),
    )
    return blend(layers, bins, tiling, tuning, views, keep)


def _finished(a: SimpleNamespace, renders: Tensor, alphas: Tensor) -> Tensor:
    """Background behind the colours, and expected depth."""
    depth = None
    if a.render_mode != "RGB":
        renders, depth = renders.split([renders.shape[-1] - 1, 1], -1)
        if a.render_mode.endswith("ED"):
            depth = depth / alphas.clamp_min(1e-10)
    if a.backgrounds is not None and renders.shape[-1]:
        behind = flat(a.backgrounds, a.lead).flatten(0, 1)[:, None, None]
        renders = renders + (1 - alphas) * behind
    return renders if depth is None else torch.cat([renders, depth], -1)


def _list(
    meta: dict[str, Any], splats: Splats, bins: Bins, tiling: Tiling, a: SimpleNamespace
) -> None:
    """Adds gsplat's names of the lists; ours hold the tiles that the ellipse meets, not its box."""
    images = a.batch * a.views
    counts = torch.empty_like(bins.order)
    counts[bins.order.long()] = bins.offsets.diff()
    tile = torch.arange(images * tiling.count, device=counts.device)
    tile = tile.repeat_interleave(bins.starts.diff().long())
    pairs = bins.pairs.long()
    ids = pair_ids(
        tile // tiling.count, tile % tiling.count, splats.depths.detach().flatten()[pairs],
        tiling.count,
    )  # fmt: skip
    if a.packed:
        seen = (splats.radii > 0).all(-1).flatten()
        number = seen.cumsum(0) - 1
        pairs, counts = number[pairs], counts[seen]
    else:
        counts = counts.view(*a.lead, a.views, a.num)
    meta.update(
        tile_width=tiling.tiles_x, tile_height=tiling.tiles_y, tiles_per_gauss=counts,
        isect_ids=ids, flatten_ids=pairs.int(),
        isect_offsets=bins.starts[:-1].view(
            *a.lead, a.views, tiling.tiles_y, tiling.tiles_x
        ),
        width=a.width, height=a.height, tile_size=tiling.tile, n_batches=a.batch,
        n_cameras=a.views,
    )  # fmt: skip
