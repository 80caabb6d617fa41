"""3D Gaussians to 2D in gsplat's layouts, by the rasterizer's projection."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, EPS2D
from gamba_warp.kernels.rasterize.ops import project
from gamba_warp.kernels.rasterize.project import LensOptions

from .checks import cameras, means_of, only, positive, shape
from .faint import compensation_of, exact_where_faint
from .shapes import proj, symmetric, world_to_cam

# Without opacities gsplat draws a box of 3.33 standard deviations: that of this opacity, about 1.
_OPAQUE = ALPHA_MIN * math.exp(0.5 * 3.33**2)
_LARGE = 1e15  # an opacity that stays over alpha_min with every factor of antialiasing from 4e-18


class Lens(NamedTuple):
    """What a projection is told beside the tensors; as ``fully_fused_projection`` has them."""

    width: int
    height: int
    eps2d: float
    near_plane: float
    far_plane: float
    radius_clip: float
    antialiased: bool


class Splats(NamedTuple):
    """N Gaussians of each of B objects in C views; what is culled has radii and extents 0.

    Attributes:
        means2d: ``[B, C, N, 2]`` pixels.
        conics: ``[B, C, N, 3]``: a, k, e of ``a (dx + k dy)² + e dy²``.
        depths: ``[B, C, N]``.
        opacities: ``[B, C, N]``, with the factor of antialiasing.
        extents: ``[B, C, N, 2]`` half sides of the box that is drawn, pixels.
        radii: ``[B, C, N, 2]`` int32, the same rounded up.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    extents: Tensor
    radii: Tensor


def flat(x: Tensor, lead: tuple[int, ...]) -> Tensor:
    """One batch dimension for the leading ones; contiguous float32."""
    return x.reshape(math.prod(lead), *x.shape[len(lead) :]).float().contiguous()


def plain_conics(conics: Tensor) -> Tensor:
    """From (a, k, e) of ``a (dx + k dy)² + e dy²`` to gsplat's xx, xy, yy."""
    a, k, e = conics.unbind(-1)
    return torch.stack([a, a * k, a * k * k + e], -1)


def project_views(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    lens: Lens,
) -> Splats:
    """Projects B objects into C views each; float32, contiguous tensors.

    Args:
        means: ``[B, N, 3]``.
        quats: ``[B, N, 4]``, or None with ``covars``.
        scales: ``[B, N, 3]``, or None with ``covars``.
        covars: ``[B, N, 3, 3]``, or None.
        opacities: ``[B, N]``.
        colors: ``[B, N, D]`` or ``[B, C, N, D]``, only to cull what is not finite.
        viewmats: ``[B, C, 4, 4]``.
        Ks: ``[B, C, 3, 3]``.
        lens: options.
    """
    if covars is not None:
        found = _project_covariances(means, covars, opacities, colors, viewmats, Ks, lens)
    else:
        options = LensOptions(
            width=lens.width, height=lens.height, near_plane=lens.near_plane,
            far_plane=lens.far_plane, radius_clip=lens.radius_clip, eps2d=lens.eps2d,
            alpha_min=ALPHA_MIN, antialiased=lens.antialiased, skip_unused=True, rounded=True,
        ).numbers()  # fmt: skip
        given = means, quats, scales, opacities, colors.detach(), viewmats, Ks
        found = project(*given, options)[:5]
        if lens.antialiased:
            assert quats is not None and scales is not None
            found = exact_where_faint(found, means, quats, scales, opacities, viewmats, Ks, lens)
    means2d, conics, depths, view_opacities, extents = found
    extents = extents.detach()
    return Splats(means2d, conics, depths, view_opacities, extents, extents.ceil().int())


def _project_covariances(
    means: Tensor,
    covars: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    lens: Lens,
) -> tuple[Tensor, ...]:
    """The operator's results for covariances, in torch and float64: it takes scales alone."""
    finite = means.isfinite().all(-1) & covars.isfinite().flatten(-2).all(-1)
    # what is culled is replaced before any product, so that its gradient is 0 and not NaN
    means = torch.where(finite[..., None], means, 0.0)
    covars = torch.where(finite[..., None, None], covars, 0.0)
    finite = finite[:, None] & opacities.isfinite()[:, None]
    finite = finite & (colors if colors.dim() == 4 else colors[:, None]).isfinite().all(-1)
    turned, covars = world_to_cam(means.double(), covars.double(), viewmats.double())
    depths = turned[..., 2]
    seen = finite & (depths >= lens.near_plane) & (depths <= lens.far_plane)
    # and here before the division by z
    turned = torch.where(seen[..., None], turned, turned.new_tensor([0.0, 0.0, 1.0]))
    covars = torch.where(seen[..., None, None], covars, torch.eye(3).to(covars))
    centers, plane = proj(turned, covars, Ks.double(), lens.width, lens.height)
    xx, xy, yy = plane[..., 0, 0], plane[..., 0, 1], plane[..., 1, 1]
    factor = compensation_of(xx, xy, yy, lens.eps2d) if lens.antialiased else 1.0
    xx, yy = xx + lens.eps2d, yy + lens.eps2d
    det = xx * yy - xy * xy
    view_opacities = opacities[:, None].double().expand_as(depths) * factor
    seen = seen & (det > 0) & (view_opacities >= ALPHA_MIN)
    with torch.no_grad():
        cut = (2 * (view_opacities / ALPHA_MIN).clamp_min(1).log()).sqrt()
        extents = cut[..., None] * torch.stack([xx, yy], -1).clamp_min(0).sqrt()
        reach = extents.ceil()
        inside = (centers + reach >= 0) & (centers - reach <= plane.new_tensor(lens[:2]))
        seen = seen & inside.all(-1) & (reach > lens.radius_clip).any(-1)
    conics = torch.stack([yy / det, -xy / yy, 1 / yy], -1)
    culled = ~seen
    kept = (
        centers.masked_fill(culled[..., None], 0.0),
        torch.where(seen[..., None], conics, conics.new_tensor([1.0, 0.0, 1.0])),
        turned[..., 2].masked_fill(culled, 0.0),
        view_opacities.masked_fill(culled, 0.0),
        extents.masked_fill(culled[..., None], 0.0),
    )
    return tuple(x.float().contiguous() for x in kept)


class Packing(NamedTuple):
    """Which (object, view, Gaussian) are seen: P of them, in their order, each int64 ``[P]``."""

    batch: Tensor
    camera: Tensor
    gaussian: Tensor
    flat: Tensor  # the index among all B * C * N

    @classmethod
    def of(cls, radii: Tensor) -> Packing:
        """Those with a box, from radii ``[B, C, N, 2]``."""
        seen = (radii > 0).all(-1)
        _, views, num = seen.shape
        index = seen.flatten().nonzero()[:, 0]
        return cls(index // (views * num), index // num % views, index % num, index)


def fully_fused_projection(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = EPS2D,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    opacities: Tensor | None = None,
) -> tuple[Tensor | None, ...]:
    """Projects Gaussians into each view; differentiable in means, covars, quats, scales, viewmats.

    Args:
        means: ``[.., N, 3]``.
        covars: ``[.., N, 6]``, the entries xx, xy, xz, yy, yz, zz; or None.
        quats: ``[.., N, 4]`` wxyz, any length; not used with ``covars``.
        scales: ``[.., N, 3]``; not used with ``covars``.
        viewmats: ``[.., C, 4, 4]`` world to camera.
        Ks: ``[.., C, 3, 3]`` pixels; skew is ignored.
        width: pixels.
        height: pixels.
        eps2d: added to the diagonal of the covariance in the picture; > 0.
        near_plane: nearer Gaussians are culled; > 0.
        far_plane: farther ones are culled.
        radius_clip: ones with both radii up to this many pixels are culled.
        packed: return only what is seen.
        sparse_grad: False.
        calc_compensations: also return the factor of antialiasing.
        camera_model: "pinhole".
        opacities: ``[.., N]``, to draw the boxes no larger than needed; or None.

    Returns:
        radii (int32), means2d, depths, conics and compensations (or None) of
        ``[.., C, N, (2, 2, -, 3, -)]``, with radii 0 where a Gaussian is culled; if packed, of
        ``[nnz, ..]``, with batch_ids, camera_ids and gaussian_ids (int64) before them.

    Raises:
        TypeError: no tensor.
        ValueError: a shape, device or option is not as above.
    """
    only("sparse_grad", sparse_grad, False)
    only("camera_model", camera_model, "pinhole")
    positive(eps2d=eps2d, near_plane=near_plane)
    lead, num = means_of(means)
    if covars is not None:
        shape("covars", covars, (*lead, num, 6))
        quats = scales = None
    elif quats is None or scales is None:
        raise ValueError("covars is None and so are quats or scales: allowed is either or")
    tensors = dict(quats=quats, scales=scales, opacities=opacities, viewmats=viewmats, Ks=Ks)
    cameras(lead, num, {"means": means, **tensors}, width, height)
    quats, scales = (None if x is None else flat(x, lead) for x in (quats, scales))
    covars = None if covars is None else symmetric(flat(covars, lead))
    given = flat(means, lead), quats, scales, covars
    cams = flat(viewmats, lead), flat(Ks, lead)

    def projected(opacity: Tensor, antialiased: bool) -> Splats:
        lens = Lens(width, height, eps2d, near_plane, far_plane, radius_clip, antialiased)
        return project_views(*given, opacity, opacity[..., None], *cams, lens)

    compensations = None
    if opacities is not None:
        opacity = flat(opacities.detach(), lead)
        found = projected(opacity, calc_compensations)
        if calc_compensations:
            # an opacity of 0 is culled, and its factor is 0
            compensations = found.opacities / opacity[:, None].clamp_min(ALPHA_MIN)
    else:
        opacity = flat(means.detach()[..., 0], lead)
        found = projected(torch.full_like(opacity, _OPAQUE), False)
        if calc_compensations:  # without opacities the factor does not shrink gsplat's boxes
            compensations = projected(torch.full_like(opacity, _LARGE), True).opacities / _LARGE
            compensations = torch.where((found.radii > 0).all(-1), compensations, 0.0)
    results = found.radii, found.means2d, found.depths, plain_conics(found.conics), compensations
    if not packed:
        return tuple(None if x is None else x.view(*lead, *x.shape[1:]) for x in results)
    at = Packing.of(found.radii)
    seen = (None if x is None else x.flatten(0, 2)[at.flat] for x in results)
    return at.batch, at.camera, at.gaussian, *seen
