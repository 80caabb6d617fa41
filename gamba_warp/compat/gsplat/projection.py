"""Spherical harmonics and projection in gsplat's layouts."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gamba_warp.kernels.rasterize.autograd import project
from gamba_warp.kernels.rasterize.constants import (
    ALPHA_MIN,
    COMPENSATION_MIN,
    CONIC_MAX,
    EPS2D,
    FRUSTUM_MARGIN,
)
from gamba_warp.kernels.rasterize.harmonics import sums_seen_from
from gamba_warp.kernels.rasterize.projection import ProjectionOptions

from ..shared import check_tensor, one_device, one_of, side
from .relocation import quat_scale_to_covar_preci

MAX_SH_DEGREE = 4
# Without opacities gsplat's box has 3.33 standard deviations, as for this opacity, about 1.
_OPAQUE = ALPHA_MIN * math.exp(0.5 * 3.33**2)
_LARGE = 1e15  # stays over alpha_min with any antialiasing factor from 4e-18
_NEARLY = 1 + 1e-5  # tolerance of a float32 product of an opacity and the smallest factor


class Splats(NamedTuple):
    """N Gaussians of each of B objects in C views; culled ones have extents 0.

    Attributes:
        means2d: ``[B, C, N, 2]`` pixels.
        conics: ``[B, C, N, 3]``: a, k, e of ``a (dx + k dy)² + e dy²``.
        depths: ``[B, C, N]``.
        opacities: ``[B, C, N]``, times the factor of antialiasing.
        extents: ``[B, C, N, 2]`` half sides of the box that is drawn, pixels; gsplat's radii are
            the same rounded up.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    extents: Tensor


def check_bounds(near_plane: float, eps2d: float) -> None:
    """Refuse a near plane that is not above 0, and a dilation below 0.

    Raises:
        ValueError: one is so.
    """
    if not near_plane > 0:
        raise ValueError(f"near_plane must be > 0, got {near_plane}")
    if not eps2d >= 0:
        raise ValueError(f"eps2d must be >= 0, got {eps2d}")


def check_scene(tensors: dict[str, Any], covariance: tuple[int, ...]) -> tuple[int, ...]:
    """Check the inputs of a projection, and return the batch dimensions.

    Args:
        tensors: by name ``means``, ``viewmats``, ``Ks``, and ``opacities``, ``quats`` and
            ``scales``, or ``covars``.
        covariance: the last dimensions of ``covars``.

    Raises:
        TypeError: one is not a tensor.
        ValueError: one has another shape or device.
    """
    check_tensor("means", tensors["means"], ("..", "N", 3))
    *lead, num, _ = tensors["means"].shape
    check_tensor("viewmats", tensors["viewmats"], (*lead, "C", 4, 4))
    shapes = {
        "Ks": (tensors["viewmats"].shape[-3], 3, 3), "quats": (num, 4), "scales": (num, 3),
        "covars": (num, *covariance), "opacities": (num,),
    }  # fmt: skip
    for name, shape in shapes.items():
        if name in tensors:
            check_tensor(name, tensors[name], (*lead, *shape))
    one_device(tensors)
    return tuple(lead)


def flat(x: Tensor, lead: tuple[int, ...]) -> Tensor:
    """Merge the leading dimensions into one; contiguous float32."""
    return x.reshape(math.prod(lead), *x.shape[len(lead) :]).float().contiguous()


def plain_conics(conics: Tensor) -> Tensor:
    """Convert (a, k, e) of ``a (dx + k dy)² + e dy²`` to gsplat's xx, xy, yy."""
    a, k, e = conics.unbind(-1)
    return torch.stack([a, a * k, a * k * k + e], -1)


def num_sh_bases(degree: int) -> int:
    """Return the number of spherical harmonics up to a degree, (degree + 1)², at most 25."""
    return (min(degree, MAX_SH_DEGREE) + 1) ** 2


def spherical_harmonics(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None
) -> Tensor:
    """Evaluate real spherical harmonics, ``Σ_k Y_k(dirs) coeffs_k``, without offset or clamping.

    Args:
        degrees_to_use: 0 to 4; further coefficients are ignored.
        dirs: ``[.., 3]``, of any length.
        coeffs: ``[.., K, D]``, K >= (degrees_to_use + 1)²; gsplat's D is 3.
        masks: ``[..]`` bool, or None; the result is 0 where it is False.

    Returns:
        ``[.., D]``; NaN in all D, without a gradient, if a direction or a used coefficient is not
        finite.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: the degree or a shape is not as above.
    """
    one_of("degrees_to_use", degrees_to_use, *range(MAX_SH_DEGREE + 1))
    check_tensor("dirs", dirs, ("..", 3))
    lead = dirs.shape[:-1]
    check_tensor("coeffs", coeffs, (*lead, f"K >= {(degrees_to_use + 1) ** 2}", "D"))
    check_tensor("masks", masks, (*lead,), optional=True)
    rows = coeffs.reshape(1, -1, *coeffs.shape[-2:])
    values = sums_seen_from(degrees_to_use, rows, dirs.reshape(1, -1, 3), dirs.new_zeros(1, 1, 3))
    values = values.reshape(*lead, coeffs.shape[-1])
    return values if masks is None else torch.where(masks[..., None], values, 0.0)


def world_to_cam(means: Tensor, covars: Tensor, viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Transform means and covariances into camera frames.

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
    means: Tensor, covars: Tensor, Ks: Tensor, width: int, height: int,
    camera_model: str = "pinhole",
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Project means and covariances from camera frames to the image (EWA, pinhole).

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
    one_of("camera_model", camera_model, "pinhole")
    width, height = side(width=width, height=height)
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


def project_views(scene: dict[str, Tensor], colors: Tensor, options: ProjectionOptions) -> Splats:
    """Project each object into each of its views; all float32, contiguous.

    The rasterizer's factor of antialiasing is at least 0.005, while gsplat's goes down to 0. The
    few Gaussians below are projected again by their covariances, in float64, and culled by their
    own factor. Where covariances are given, that takes all: a thin one's factor needs their digits.

    Args:
        scene: by name ``means [B, N, 3]``, ``opacities [B, N]``, ``viewmats [B, C, 4, 4]``,
            ``Ks [B, C, 3, 3]``, and ``quats [B, N, 4]`` and ``scales [B, N, 3]``, or
            ``covars [B, N, 6]``.
        colors: ``[B, N, D]`` or ``[B, C, N, D]``, only to cull what is not finite.
        options: of the projection.
    """
    means, opacities, viewmats, Ks = (scene[k] for k in ("means", "opacities", "viewmats", "Ks"))
    quats, scales, covars = (scene.get(name) for name in ("quats", "scales", "covars"))
    if covars is not None and options.antialiased:
        finite = colors.isfinite().all(-1).view(len(colors), -1, means.shape[1])
        finite = finite & opacities.isfinite()[:, None]
        shown = torch.where(finite, opacities[:, None], 0.0)
        whole: Any = covars[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))
        return _project_covariances(means, whole, shown, viewmats, Ks, options)
    arguments = means, quats, scales, covars, opacities, colors.detach(), viewmats, Ks
    splats = Splats(*project(*arguments, *options)[:5])
    splats = splats._replace(extents=splats.extents.detach())
    if not options.antialiased or quats is None or scales is None:
        return splats
    with torch.no_grad():
        faint = splats.opacities <= opacities[:, None] * (COMPENSATION_MIN * _NEARLY)
        at = (faint & (splats.extents > 0).all(-1)).nonzero(as_tuple=True)
    b, c, g = at
    if len(b) == 0:
        return splats
    wide = quats[b, g].double(), scales[b, g].double()
    whole = quat_scale_to_covar_preci(*wide, True, False)[0]
    arguments = means[b, g], whole, opacities[b, g, None], viewmats[b, c], Ks[b, c]
    exact = _project_covariances(*(x[:, None] for x in arguments), options=options)
    return Splats(*(x.index_put(at, one[:, 0, 0]) for x, one in zip(splats, exact)))


def _project_covariances(
    means: Tensor,
    covars: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    options: ProjectionOptions,
) -> Splats:
    """Project like the operator, from covariances, in float64 torch; opacities ``[B, (C), N]``."""
    finite = means.isfinite().all(-1) & covars.isfinite().flatten(-2).all(-1)
    # Culled ones are replaced before any product, so that their gradient is 0 and not NaN,
    means = torch.where(finite[..., None], means, 0.0)
    covars = torch.where(finite[..., None, None], covars, 0.0)
    turned, covars = world_to_cam(means.double(), covars.double(), viewmats.double())
    depths = turned[..., 2]
    seen = finite[:, None] & (depths >= options.near_plane) & (depths <= options.far_plane)
    # and here before the division by z.
    turned = torch.where(seen[..., None], turned, turned.new_tensor([0.0, 0.0, 1.0]))
    covars = torch.where(seen[..., None, None], covars, torch.eye(3).to(covars))
    centers, plane = proj(turned, covars, Ks.double(), options.width, options.height)
    xx, xy, yy = plane[..., 0, 0], plane[..., 0, 1], plane[..., 1, 1]
    before = xx * yy - xy * xy
    xx, yy = xx + options.eps2d, yy + options.eps2d
    det = xx * yy - xy * xy
    solid = (det > 0) & (yy <= CONIC_MAX * det) & (yy * CONIC_MAX >= 1)
    xx, yy, det = (torch.where(solid, x, 1.0) for x in (xx, yy, det))
    shown = opacities.double().expand_as(depths)
    if options.antialiased:
        some = before > 0
        # Replaced before the root, whose infinite slope at 0 would turn a gradient of 0 into NaN.
        factor = torch.where(some, before / det, 1.0).sqrt()
        shown = shown * torch.where(some, factor, 0.0)
    seen = seen & solid & (shown >= ALPHA_MIN)
    with torch.no_grad():
        cut = (2 * (shown / ALPHA_MIN).clamp_min(1).log()).sqrt()
        extents = cut[..., None] * torch.stack([xx, yy], -1).clamp_min(0).sqrt()
        reach = extents.ceil()
        inside = (centers + reach >= 0) & (centers - reach <= plane.new_tensor(options[:2]))
        seen = seen & inside.all(-1) & (reach > options.radius_clip).any(-1)
    conics = torch.stack([yy / det, -xy / yy, 1 / yy], -1)
    box, blank = seen[..., None], conics.new_tensor([1.0, 0.0, 1.0])
    fields = (
        torch.where(box, centers, 0.0),
        torch.where(box, conics, blank),
        torch.where(seen, turned[..., 2], 0.0),
        torch.where(seen, shown, 0.0),
        torch.where(box, extents, 0.0),
    )
    return Splats(*(x.float().contiguous() for x in fields))


def fully_fused_projection(
    means: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None,
    viewmats: Tensor, Ks: Tensor, width: int, height: int, eps2d: float = EPS2D,
    near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0,
    packed: bool = False, sparse_grad: bool = False, calc_compensations: bool = False,
    camera_model: str = "pinhole", opacities: Tensor | None = None,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """Project Gaussians into each view; differentiable in means, covars, quats, scales, viewmats.

    Args:
        means: ``[.., N, 3]``.
        covars: ``[.., N, 6]``, the entries xx, xy, xz, yy, yz, zz; or None.
        quats: ``[.., N, 4]`` wxyz, any length; not used with ``covars``.
        scales: ``[.., N, 3]``; not used with ``covars``.
        viewmats: ``[.., C, 4, 4]`` world to camera.
        Ks: ``[.., C, 3, 3]`` pixels; skew is ignored.
        width: pixels.
        height: pixels.
        eps2d: added to the diagonal of the covariance in the image; >= 0.
        near_plane: nearer Gaussians are culled; > 0.
        far_plane: farther ones are culled.
        radius_clip: ones with both radii up to this many pixels are culled.
        packed: return only visible ones.
        sparse_grad: False.
        calc_compensations: also return the factor of antialiasing.
        camera_model: "pinhole".
        opacities: ``[.., N]``, for the smallest sufficient boxes; or None.

    Returns:
        radii (int32), means2d, depths, conics and compensations (or None) of
        ``[.., C, N, (2, 2, -, 3, -)]``, with radii 0 where a Gaussian is culled; if packed, of
        ``[nnz, ..]``, with batch_ids, camera_ids and gaussian_ids (int64) before them.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: a shape, device or option is not as above.
    """
    one_of("sparse_grad", sparse_grad, False)
    one_of("camera_model", camera_model, "pinhole")
    check_bounds(near_plane, eps2d)
    width, height = side(width=width, height=height)
    tensors: dict[str, Any] = dict(means=means, viewmats=viewmats, Ks=Ks)
    tensors |= dict(quats=quats, scales=scales) if covars is None else dict(covars=covars)
    lead = check_scene({**tensors, **({} if opacities is None else {"opacities": opacities})}, (6,))
    flattened = {name: flat(x, lead) for name, x in tensors.items()}
    opacity = flat(means.detach()[..., 0] if opacities is None else opacities.detach(), lead)

    def projected(opacity: Tensor, antialiased: bool) -> Splats:
        scene = {**flattened, "opacities": opacity}
        options = ProjectionOptions(
            width, height, near_plane, far_plane, radius_clip, eps2d, ALPHA_MIN, antialiased,
            skip_unused=True, rounded=True,
        )  # fmt: skip
        return project_views(scene, opacity[..., None], options)

    compensations = None
    if opacities is not None:
        splats = projected(opacity, calc_compensations)
        if calc_compensations:
            # An opacity of 0 is culled, and its factor is 0.
            compensations = splats.opacities / opacity[:, None].clamp_min(ALPHA_MIN)
    else:
        splats = projected(torch.full_like(opacity, _OPAQUE), False)
        if calc_compensations:  # without opacities the factor does not shrink gsplat's boxes
            factors = projected(torch.full_like(opacity, _LARGE), True).opacities / _LARGE
            compensations = torch.where((splats.extents > 0).all(-1), factors, 0.0)
    radii = splats.extents.ceil().int()
    results = radii, splats.means2d, splats.depths, plain_conics(splats.conics), compensations
    if not packed:
        return tuple(None if x is None else x.view(*lead, *x.shape[1:]) for x in results)
    at = (radii > 0).all(-1).nonzero(as_tuple=True)
    return *at, *(None if x is None else x[at] for x in results)
