"""diff_gaussian_rasterization of the original 3D Gaussian splatting code, over our kernels."""

from __future__ import annotations

import dis
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gamba_warp.kernels.rasterize import Skip
from gamba_warp.kernels.rasterize.autograd import bin_op, composite, project
from gamba_warp.kernels.rasterize.constants import ALPHA_MAX, ALPHA_MIN, EPS2D, T_MIN
from gamba_warp.kernels.rasterize.harmonics import colors_seen_from
from gamba_warp.kernels.rasterize.projection import Projected, ProjectionOptions
from gamba_warp.kernels.rasterize.quantile import counts_in_front
from gamba_warp.kernels.rasterize.skip import SQUARES
from gamba_warp.kernels.rasterize.tiles import Bins, Limits, Size, Tiling

from .shared import DTYPES, check_tensor, one_device, one_of, side

# What the forks return; ``use_fork`` chooses one.
FORKS = {
    "graphdeco": "colour, radii; with antialiasing in the settings also inverse depth",
    "ingra14m": "colour, radii, depth",
    "ashawkey": "colour, radii, depth, alpha",
    "monogs": "colour, radii, depth, alpha without gradient, n_touched",
}
NEAR = float(np.nextafter(np.float32(0.2), np.float32(1)))  # nearer ones are culled
# A pixel blends down to this transmittance, inclusive.
LIMITS = Limits(ALPHA_MIN, ALPHA_MAX, float(np.nextafter(np.float32(T_MIN), np.float32(0))), True)
SKIP = Skip().bits() | SQUARES
_MAX_SH_DEGREE = 3
_UNPACK = dis.opmap["UNPACK_SEQUENCE"]
_fork = "graphdeco"


def use_fork(name: str) -> None:
    """Choose what a rasterizer returns from now on, by the fork that a program was written for.

    Args:
        name: of ``FORKS``; "graphdeco", the original, is the default.

    Raises:
        ValueError: another name.
    """
    global _fork
    one_of("fork", name, *FORKS)
    _fork = name


class _Settings(NamedTuple):
    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    antialiasing: bool | None = None
    projmatrix_raw: Tensor | None = None


class GaussianRasterizationSettings(_Settings):
    """A camera, a background and options, checked where they are used.

    Attributes:
        image_height: pixels.
        image_width: pixels.
        tanfovx: tangent of half the horizontal field of view.
        tanfovy: tangent of half the vertical one.
        bg: ``[C]``, the background, which gets no gradient.
        scale_modifier: factor of the scales.
        viewmatrix: ``[4, 4]`` world to camera, transposed: of row vectors.
        projmatrix: ``[4, 4]`` the same times a perspective projection, which has the slopes of
            ``tanfovx`` and ``tanfovy``; its centre may be anywhere.
        sh_degree: 0 to 3.
        campos: ``[3]`` the camera's centre, from which harmonics are seen. It and the matrices may
            have leading dimensions of 1.
        prefiltered: no effect.
        debug: no effect.
        antialiasing: None for the code before 2024; True scales opacities by the part of a
            footprint's area that dilation has not added.
        projmatrix_raw: no effect; the fork "monogs" has the projection alone there.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> GaussianRasterizationSettings:
        """Make settings.

        Raises:
            TypeError: there is another option, as Mip-Splatting, GOF, TRELLIS and 2DGS have it.
        """
        for name in kwargs:
            if name not in _Settings._fields:
                raise TypeError(f"{name} is an option of another rasterizer and is not supported")
        return super().__new__(cls, *args, **kwargs)


class _Results(tuple):
    """Results that name ``use_fork`` where a program unpacks another number of them."""

    def __iter__(self) -> Iterator[Any]:
        frame = sys._getframe(1)
        code, at = frame.f_code.co_code, frame.f_lasti
        if at >= 0 and code[at] == _UNPACK and code[at + 1] != len(self):
            raise ValueError(
                f"{code[at + 1]} results are expected, the fork {_fork!r} has {len(self)}: choose "
                "another by gamba_warp.compat.diff_gaussian_rasterization.use_fork or --fork: "
                + "; ".join(f"{name} ({what})" for name, what in FORKS.items())
            )
        return super().__iter__()


class _InImage(torch.autograd.Function):
    """Centres in pixels, whose gradient also goes to ``means2D``, in units of half the image.

    In the same units the sums of absolute values, which the compositor's gradient has set before,
    go to ``means2D_densify``.
    """

    @staticmethod
    def forward(
        ctx: Any,
        pixels: Tensor,
        means2D: Tensor,
        means2D_densify: Tensor | None,
        absolute: Tensor | None,
        half: tuple[float, float],
    ) -> Tensor:
        """Return the centres."""
        ctx.half, ctx.absolute = half, absolute
        return pixels.view_as(pixels)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        """Return the gradient, and both scaled with a third entry of 0."""

        def scaled(v: Tensor) -> Tensor:
            return torch.nn.functional.pad(v[0] * v.new_tensor(ctx.half), (0, 1))

        (v,) = grads
        absolute = None if ctx.absolute is None else scaled(ctx.absolute)
        return v, scaled(v), absolute, None, None


class _Moved(torch.autograd.Function):
    """A camera, whose gradient also goes to the twist (rho, theta) by which it would be moved.

    Its world-to-camera matrix would be exp(rho, theta) times this one; the gradient is that at 0.
    """

    @staticmethod
    def forward(
        ctx: Any, viewmat: Tensor, center: Tensor, theta: Tensor, rho: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the matrix ``[1, 4, 4]`` and the camera's centre ``[1, 1, 3]``."""
        ctx.save_for_backward(viewmat)
        return viewmat.view_as(viewmat), center.view_as(center)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        """Return the gradients of theta and rho."""
        (viewmat,) = ctx.saved_tensors
        v_viewmat, v_center = grads
        upper, v_upper = viewmat[0, :3], v_viewmat[0, :3]
        v_theta = torch.linalg.cross(upper, v_upper, dim=0).sum(1)
        return None, None, v_theta, v_upper[:, 3] - upper[:, :3] @ v_center[0, 0]


class GaussianRasterizer(torch.nn.Module):
    """A rasterizer of one view.

    Args:
        raster_settings: the camera and the options.
    """

    def __init__(self, raster_settings: GaussianRasterizationSettings):
        super().__init__()
        self.raster_settings = raster_settings

    @torch.no_grad()
    def markVisible(self, positions: Tensor) -> Tensor:
        """Return which of the positions ``[N, 3]`` are deeper than 0.2, ``[N]`` bool."""
        check_tensor("positions", positions, ("N", 3))
        view = _plain(self.raster_settings).viewmatrix
        return positions @ view[:3, 2].to(positions) + view[3, 2].to(positions) >= NEAR

    @torch.no_grad()
    def visible_filter(
        self, means3D: Tensor, scales: Tensor | None = None, rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """Return the radii of ``forward``, which do not depend on opacities and colours."""
        check_tensor("means3D", means3D, ("N", 3), dtypes=DTYPES)
        settings, ones = _plain(self.raster_settings), torch.ones_like(means3D)
        x = _checked(
            settings, means3D, ones, ones[:, :1], colors_precomp=ones, scales=scales,
            rotations=rotations, cov3D_precomp=cov3D_precomp,
        )  # fmt: skip
        return _radii(_project(x, ones, settings, *_camera(settings, means3D.device)))

    def forward(
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, shs: Tensor | None = None,
        colors_precomp: Tensor | None = None, scales: Tensor | None = None,
        rotations: Tensor | None = None, cov3D_precomp: Tensor | None = None,
        theta: Tensor | None = None, rho: Tensor | None = None,
        means2D_densify: Tensor | None = None, **others: Any,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Render N Gaussians, differentiable in all arguments.

        Args:
            means3D: ``[N, 3]``; float32, bfloat16 or float16, as all.
            means2D: ``[N, 3]``, whose values are not used; its gradient is that of the centres in
                the image, in units of half its sides.
            opacities: ``[N, 1]`` or ``[N]`` in (0, 1).
            shs: ``[N, K, 3]`` harmonics' coefficients, K >= (sh_degree + 1)²; or None.
            colors_precomp: ``[N, C]`` in their place.
            scales: ``[N, 3]`` standard deviations; or None.
            rotations: ``[N, 4]`` wxyz of length 1, which is not made so here; or None.
            cov3D_precomp: ``[N, 6]`` in their place: xx, xy, xz, yy, yz, zz of covariances.
            theta: ``[3]``, whose values are not used; its gradient is that of the camera's rotation
                vector, about the axes of the camera.
            rho: ``[3]``, likewise; its gradient is that of the translation, along these axes. The
                world-to-camera matrix would be multiplied by exp(rho, theta) from the left.
            means2D_densify: ``[N, 3]``, like ``means2D``; its gradient is the sum of the absolute
                values of the pixels' gradients (Ye et al. 2024, "AbsGS").
            **others: arguments of other forks, which are refused.

        Returns:
            The colour ``[C, H, W]`` and the radii ``[N]`` int32, pixels, 0 where culled, and what
            else the chosen fork has: Σ T α / z, Σ T α z or Σ T α, each ``[1, H, W]``, and
            n_touched ``[N]`` int32, the number of pixels to which a Gaussian contributes and whose
            transmittance is above 0.5 behind it.

        Raises:
            TypeError: an argument is not a tensor, or of another dtype, or of another fork.
            ValueError: a shape, device or setting is not as above, or not exactly one of two
                alternatives is given.
        """
        for name in others:
            raise TypeError(f"{name} is an argument of another rasterizer and is not supported")
        return rasterize_gaussians(
            means3D, means2D, shs, colors_precomp, opacities, scales, rotations, cov3D_precomp,
            self.raster_settings, theta, rho, means2D_densify,
        )  # fmt: skip


def rasterize_gaussians(
    means3D: Tensor, means2D: Tensor, sh: Tensor | None, colors_precomp: Tensor | None,
    opacities: Tensor, scales: Tensor | None, rotations: Tensor | None,
    cov3Ds_precomp: Tensor | None, raster_settings: GaussianRasterizationSettings,
    theta: Tensor | None = None, rho: Tensor | None = None, means2D_densify: Tensor | None = None,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Render as ``GaussianRasterizer``; an empty tensor is the same as None."""
    settings = _plain(raster_settings)
    x = _checked(
        settings, means3D, means2D, opacities, shs=sh, colors_precomp=colors_precomp, scales=scales,
        rotations=rotations, cov3D_precomp=cov3Ds_precomp, theta=theta, rho=rho,
        means2D_densify=means2D_densify,
    )  # fmt: skip
    viewmat, K = _camera(settings, means3D.device)
    center = settings.campos.detach().float().view(1, 1, 3).to(means3D.device)
    if "theta" in x or "rho" in x:
        zero = center.new_zeros(3)
        viewmat, center = _Moved.apply(viewmat, center, x.get("theta", zero), x.get("rho", zero))
    if "shs" in x:
        colors = colors_seen_from(settings.sh_degree, x["shs"][None], x["means3D"][None], center)
        colors = colors[0]
    else:
        colors = x["colors_precomp"]
    projected = _project(x, colors, settings, viewmat, K)
    width, height = settings.image_width, settings.image_height
    densify = x.get("means2D_densify")
    absolute = None if densify is None else torch.zeros_like(projected.means2d)
    half = width / 2, height / 2
    centers: Any = _InImage.apply(projected.means2d, x["means2D"], densify, absolute, half)

    fork = _fork
    depth, channels = projected.depths[..., None], colors
    if fork != "graphdeco" or settings.antialiasing is not None:
        if fork == "graphdeco":
            depth = torch.where(depth > 0, depth, 1.0).reciprocal()
        channels = torch.cat([colors.expand(1, *colors.shape[-2:]), depth], -1)
    shown = projected.view_opacities
    listed = torch.where(shown[..., None] > 0, projected.extents, 0.0)  # not the transparent ones
    splats = projected.means2d, projected.conics, projected.depths, shown, listed
    bins = bin_op(*(s.detach() for s in splats), width, height, ALPHA_MIN, SKIP)
    size = Size(width, height, 1, channels.dim() == 3, SKIP)
    drawn = centers, projected.conics, shown, channels
    arguments = list(bins), None, absolute, *size, *LIMITS
    renders, transmittances, *_ = composite(*drawn, *arguments)
    layers = renders[0].permute(2, 0, 1)
    clear = transmittances[0].permute(2, 0, 1)
    bg = settings.bg.detach().to(layers)[:, None, None]
    color = (layers[: len(bg)] + clear * bg).contiguous()
    results = [color, _radii(projected)]
    if channels is not colors:
        results.append(layers[len(bg) :].contiguous())
    if fork in ("ashawkey", "monogs"):
        alpha = (1 - clear).contiguous()
        results.append(alpha if fork == "ashawkey" else alpha.detach())
    if fork == "monogs":
        results.append(counts_in_front(projected, Bins(*bins), Tiling(width, height), LIMITS)[0])
    return _Results(results)


def _radii(projected: Projected) -> Tensor:
    """Return the radii ``[N]`` int32 of a view."""
    return projected.extents[0, :, 0].int()


def _project(
    x: dict[str, Tensor],
    colors: Tensor,
    settings: GaussianRasterizationSettings,
    viewmat: Tensor,
    K: Tensor,
) -> Projected:
    """Project by the original's conventions."""
    scales = x.get("scales")
    if scales is not None and settings.scale_modifier != 1:
        # As in the original, the gradient ignores the modifier.
        detached = scales.detach()
        scales = detached * settings.scale_modifier + (scales - detached)
    options = ProjectionOptions(
        settings.image_width, settings.image_height, NEAR, float("inf"), 0.0, EPS2D, ALPHA_MIN,
        bool(settings.antialiasing), skip_unused=True, original=True,
    )  # fmt: skip
    shapes = x.get("rotations"), scales, x.get("cov3D_precomp")
    gaussians = x["means3D"], *shapes, x["opacities"].flatten()
    return Projected(*project(*gaussians, colors.detach(), viewmat, K, *options))


def _plain(settings: GaussianRasterizationSettings) -> GaussianRasterizationSettings:
    """Return settings with ints for sizes, and a camera without leading dimensions of 1."""
    height, width = side(image_height=settings.image_height, image_width=settings.image_width)
    camera = {}
    for name, dims in {"viewmatrix": 2, "projmatrix": 2, "campos": 1}.items():
        x = getattr(settings, name)
        while isinstance(x, Tensor) and x.dim() > dims and len(x) == 1:
            x = x[0]
        camera[name] = x
    return settings._replace(image_height=height, image_width=width, **camera)


def _checked(
    settings: GaussianRasterizationSettings,
    means3D: Tensor,
    means2D: Tensor,
    opacities: Tensor,
    **optional: Tensor | None,
) -> dict[str, Tensor]:
    """Check the arguments by name, before any launch; return the given ones in float32."""
    tensors: dict[str, Any] = dict(means3D=means3D, means2D=means2D, opacities=opacities)
    empty = isinstance(means3D, Tensor) and len(means3D) == 0
    for name, x in optional.items():
        if x is not None and (empty or not isinstance(x, Tensor) or x.numel()):
            tensors[name] = x
    names = {*tensors}
    if len(names & {"shs", "colors_precomp"}) != 1:
        raise ValueError("shs, colors_precomp: exactly one of them must be given")
    if names & {"scales", "rotations", "cov3D_precomp"} not in (
        {"scales", "rotations"}, {"cov3D_precomp"},
    ):  # fmt: skip
        raise ValueError("scales and rotations, or cov3D_precomp: one of them must be given")
    one_of("sh_degree", settings.sh_degree, *range(_MAX_SH_DEGREE + 1))
    check_tensor("means3D", tensors["means3D"], ("N", 3), dtypes=DTYPES)
    num = len(tensors["means3D"])
    shapes = {
        "means2D": ((num, 3),), "opacities": ((num, 1), (num,)),
        "shs": ((num, f"K >= {(settings.sh_degree + 1) ** 2}", 3),),
        "colors_precomp": ((num, "C >= 1"),), "scales": ((num, 3),), "rotations": ((num, 4),),
        "cov3D_precomp": ((num, 6),), "theta": ((3,),), "rho": ((3,),),
        "means2D_densify": ((num, 3),),
    }  # fmt: skip
    for name, allowed in shapes.items():
        if name in tensors:
            check_tensor(name, tensors[name], *allowed, dtypes=DTYPES)
    channels = tensors["colors_precomp"].shape[1] if "colors_precomp" in tensors else 3
    check_tensor("bg", settings.bg, (channels,))
    check_tensor("campos", settings.campos, (3,))
    check_tensor("viewmatrix", settings.viewmatrix, (4, 4))
    check_tensor("projmatrix", settings.projmatrix, (4, 4))
    one_device(tensors)
    return {name: value.float().contiguous() for name, value in tensors.items()}


def _camera(settings: GaussianRasterizationSettings, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the viewmat ``[1, 4, 4]`` and the K ``[1, 3, 3]`` of settings."""
    view, full = (
        x.detach().double().cpu().numpy() for x in (settings.viewmatrix, settings.projmatrix)
    )
    half = np.array([float(settings.tanfovx), float(settings.tanfovy)])
    if not (half > 0).all():
        raise ValueError(f"tanfovx and tanfovy must be > 0, got {half[0]}, {half[1]}")
    # Clip coordinates x/tan + center z, and the same for y; w is the depth z.
    axis = view[:, 2]
    straight = view[:, :2] / half
    center = axis[:3] @ (full[:3, :2] - straight[:3]) / (axis[:3] @ axis[:3])
    want = np.concatenate([straight + np.outer(axis, center), axis[:, None]], 1)
    if not np.abs(full[:, [0, 1, 3]] - want).max() <= 2e-5 * np.abs(full).max():
        raise ValueError(
            "projmatrix is not viewmatrix times the perspective of tanfovx and tanfovy, transposed"
        )
    size = np.array([settings.image_width, settings.image_height])
    focal, middle = size / (2 * half), size * (1 + center) / 2
    K = [[focal[0], 0, middle[0]], [0, focal[1], middle[1]], [0, 0, 1]]
    viewmat = settings.viewmatrix.detach().float().mT.contiguous().to(device)
    return viewmat[None], torch.tensor([K], dtype=torch.float32, device=device)
