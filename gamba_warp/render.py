"""Rendering of Gaussians by the rasterizer kernels."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.profiler import record_function

from .cameras import Cameras
from .gaussians import SH_C0, Gaussians
from .kernels.rasterize import rasterization
from .kernels.rasterize.meta import Meta


@dataclass
class Rendering:
    """Result of ``render``.

    Attributes:
        rgb: ``[.., V, H, W, 3]``, composited on the background.
        alpha: ``[.., V, H, W, 1]`` in [0, 1].
        depth: ``[.., V, H, W, 1]`` expected depth in object units, or None if not requested.
        meta: the rasterizer's counts of its work.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    meta: Meta


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor | None = None,
    depth: bool = False,
    **options,
) -> Rendering:
    """Render every object in each of its views, in one launch.

    Args:
        gaussians: Gaussians with leading dimensions ``..``.
        cameras: cameras with the same leading dimensions, then V.
        background: RGB in [0, 1], ``[3]`` or ``[.., V, 3]``; None means black.
        depth: render the expected depth too.
        options: further arguments of ``rasterization``.
    """
    if background is not None:
        background = background.expand(*cameras.viewmats.shape[:-2], 3)
    colors = gaussians.colors
    if gaussians.harmonics is not None:  # with the colours as degree 0
        options["sh_degree"] = gaussians.degree
        constant = (colors - 0.5) / SH_C0
        colors = torch.cat([constant[..., None, :], gaussians.harmonics], -2)
    elif not colors.requires_grad:  # only files have colours below 0
        colors = colors.clamp_min(0)
    if gaussians.antialiased:
        options.setdefault("rasterize_mode", "antialiased")
    with record_function("rasterizer"):
        images, alpha, meta = rasterization(
            means=gaussians.means,
            quats=gaussians.quats,
            scales=gaussians.scales,
            opacities=gaussians.opacities,
            colors=colors,
            viewmats=cameras.viewmats,
            Ks=cameras.Ks,
            width=cameras.width,
            height=cameras.height,
            backgrounds=background,
            render_mode="RGB+ED" if depth else "RGB",
            **options,
        )
    return Rendering(images[..., :3], alpha, images[..., 3:] if depth else None, meta)
