"""Splitting of the front Gaussians of ``rays`` to the resolution of the input image.

The network sees the image at ``image_size``; a photograph has more pixels. After the network,
each front cell may therefore split into k x k children, each on the ray of its own small pixel:

- Depth, the network's contribution to the logit of the opacity, and the parent's offset from its
  ray are interpolated between the cells, weighted by alpha. The opacity is over a half where alpha
  is 1: a network uncertain of the depth makes a faint front, through which the colours of the
  layers behind it, without detail, would show.
- Colour and alpha are taken from the image at k times the resolution of the cells.
- Sizes are the parent's, across the view 1/k of them, but large enough that neighbours overlap: at
  ``image_size`` a rasterizer's own widening covers the gaps between small Gaussians, at k times
  that size it does not. Sizes along the view stay, so that no crack opens from the side.
- Gaussians that do not split are enlarged in the same way, across the view.
- A parent is up to a pixel off its ray. Its children take a part of that offset: without it they
  would separate from cells that do not split, and with all of it their pixels would be displaced.

Plain cells do not split. Cells that contain or touch background split in 2 x 2 at most: a
rasterizer widens every Gaussian by a part of its own pixel, so more of them along a silhouette
make it wider in images smaller than the intended one. For the same reason two rounds of
correction take colours at k times the cells, but opacities from the errors of two smaller
images, of twice as many pixels as cells and of as many.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ..cameras import Cameras
from ..conventions import DETAILS, Detail
from ..data.preprocess import resize_rgba
from ..errors import UserError
from ..gaussians import Gaussians
from ..kernels.rasterize.constants import ALPHA_MIN
from ..render import render
from .config import GambaConfig
from .parts.patches import premultiplied
from .parts.rays import EMPTY

PLAIN = 6 / 255  # largest contrast of a plain cell, with its neighbours
MAX_CHILDREN = 60_000  # with the other layers less than 1 MB as ``.spz``, for most objects
# By detail: the least standard deviation of a child across the view, in sides of its cell, and the
# fraction of its parent's offset from the ray.
MIN_SIZE = {2: 0.4, 4: 0.45}
WHOLE_MIN_SIZE = 0.45  # the same of a Gaussian that does not split
OFFSET_FRACTION = {2: 0.5, 4: 0.125}
MIN_OPACITY = 0.5  # logit; least opacity of a child where alpha is 1
ROUNDS = 2  # of correction
OPACITY_GAIN = 8.0  # added to the logit of an opacity per missing unit of alpha
SMALL_FRACTION = 0.2  # of that, for the smaller image: a large one loses what a small one gains
FAINT = 0.05  # alpha of a rendered pixel below which its colour is unreliable


def checked_detail(detail: Detail | None, config: GambaConfig, side: int) -> Detail:
    """Return the number of children a side of a cell.

    Args:
        detail: the requested number; None takes the largest that the image's pixels allow.
        config: of the model.
        side: side of the square input image, pixels.

    Raises:
        UserError: detail is not such a number, or more than 1 for a decoder other than ``rays``.
    """
    if detail not in (None, *DETAILS):
        raise UserError(f"detail is {detail}, it must be 1, 2 or 4")
    if config.decoder != "rays":
        if detail in (None, 1):
            return 1
        raise UserError(
            f"detail {detail} needs a model with the decoder rays, and this one has "
            f"{config.decoder}: leave --detail out, or give another --checkpoint"
        )
    if detail is not None:
        return detail
    return max(each for each in DETAILS if each == 1 or each * _cells(config) <= side)


def fill_gaps(gaussians: Gaussians, config: GambaConfig, camera: Cameras) -> Gaussians:
    """Enlarge small Gaussians across the view, so that larger images have no gaps between them.

    At ``image_size`` a rasterizer's own widening covers the gaps.

    Args:
        gaussians: ``[N]``, result of a model with the decoder ``rays``.
        config: of the model.
        camera: ``[1]``, camera of the image in the model's world, see ``posing``.
    """
    side = _cells(config)
    least = WHOLE_MIN_SIZE * camera.viewmats[0, 2, 3] / camera.resized(side, side).Ks[0, 1, 1]
    along = _along_the_view(gaussians.quats, gaussians.scales)
    scales = torch.where(along, gaussians.scales, gaussians.scales.clamp_min(least))
    return replace(gaussians, scales=scales)


def split_front(
    gaussians: Gaussians,
    image: Tensor,
    rgba: np.ndarray,
    config: GambaConfig,
    detail: Detail,
    camera: Cameras,
) -> Gaussians:
    """Split the front of a reconstruction where the image shows more than one colour a cell.

    Args:
        gaussians: ``[N]``, result of a model with the decoder ``rays`` for one image.
        image: ``[H, W, 4]`` in [0, 1], straight alpha: the input of the model, on the device of
            ``gaussians``.
        rgba: ``[S, S, 4]`` in [0, 1], straight alpha: the same image at its own size.
        config: of the model.
        detail: largest number of children a side of a cell.
        camera: ``[1]``, camera of the image in the model's world, see ``posing``.

    Returns:
        Gaussians of the same frame: those that did not split, then at most ``MAX_CHILDREN``
        children (or four for each cell, if that is more); all without gaps, see ``fill_gaps``. With
        detail 1 ``gaussians`` itself.
    """
    if detail == 1:
        return gaussians
    side, device = _cells(config), gaussians.means.device
    large = torch.from_numpy(resize_rgba(rgba, side * detail, side * detail)).to(device)
    camera = camera.to(device)
    whole = fill_gaps(gaussians, config, camera)
    step = config.image_size // side
    shown = premultiplied(large[None])
    alpha = F.avg_pool2d(image[None, None, ..., 3], step)
    cells = alpha.flatten().nonzero()[:, 0]  # of each front Gaussian
    counts = _children_a_side(shown, alpha, detail).flatten()
    splits = counts[cells] > 1
    if not splits.any():
        return whole
    is_front = torch.arange(gaussians.num, device=device) % config.ray_layers == 0
    front = gaussians.select(is_front)
    parent = cells.new_full((side * side,), -1)
    parent[cells] = torch.arange(len(cells), device=device)
    fields = _fields(front, cells, alpha, camera)
    parts = [
        _children(front, parent, fields, counts == count, count, shown, camera)
        for count in sorted({2, detail})
    ]
    children, pixels = _concatenate([one for one, _ in parts]), torch.cat([at for _, at in parts])
    stays = ~is_front
    stays[is_front] = ~splits
    return _correct(whole.select(stays), children, pixels, shown, camera, detail)


def _cells(config: GambaConfig) -> int:
    """Number of cells a side of the image."""
    return config.grid_size * config.ray_cells


def _children_a_side(image: Tensor, alpha: Tensor, detail: int) -> Tensor:
    """Children a side of each cell, 1, 2 or ``detail``: ``[cells, cells]``.

    If there would be more than ``MAX_CHILDREN`` children, the cells with the least contrast split
    in 2 x 2.

    Args:
        image: ``[1, 4, H, W]``, see ``premultiplied``.
        alpha: ``[1, 1, cells, cells]``.
        detail: largest number.
    """
    # Include the neighbouring cells: an unsplit parent would blur an edge between cells.
    both = F.max_pool2d(torch.cat([image, -image], 1), detail)
    most, least = F.max_pool2d(both, 3, stride=1, padding=1).chunk(2, 1)
    contrast = (most + least).amax(1)[0]
    splits = (contrast > PLAIN) & (alpha[0, 0] > 0)
    inner = -F.max_pool2d(-alpha, 3, stride=1, padding=1)[0, 0] > 0.99
    counts = torch.where(splits, 2, 1)
    count = (MAX_CHILDREN - 4 * int(splits.sum())) // (detail**2 - 4) if detail > 2 else 0
    contrast = torch.where(splits & inner, contrast, 0.0).flatten()
    best = contrast.topk(min(max(count, 0), len(contrast))).indices
    counts.view(-1)[best[contrast[best] > 0]] = detail
    return counts


def _fields(front: Gaussians, cells: Tensor, alpha: Tensor, camera: Cameras) -> Tensor:
    """Maps ``[1, 5, n, n]`` of the cells to interpolate, each weighted by alpha.

    Depth along the ray, the network's contribution to the logit of the opacity, the parent's offset
    from its ray in x and y, and the weight.
    """
    side = alpha.shape[-1]
    weight = alpha.flatten()[cells]
    opacity = (torch.logit(front.opacities, 1e-6) - EMPTY * (weight - 1)).clamp_min(MIN_OPACITY)
    points = front.means + camera.viewmats[0, :3, 3]
    depth = points[:, 2]
    K = camera.resized(side, side).Ks[0]
    off = points[:, :2] - depth[:, None] * _across(cells // side, cells % side, K)
    fields = alpha.new_zeros(5, alpha.numel())
    fields[:, cells] = torch.stack([depth, opacity, *off.T, torch.ones_like(depth)]) * weight
    return fields.view(1, 5, side, side)


def _across(row: Tensor, column: Tensor, K: Tensor) -> Tensor:
    """X and y of the rays of pixels at depth 1, ``[.., 2]``."""
    return (torch.stack([column, row], -1).to(K) + 0.5 - K[:2, 2]) / K[[0, 1], [0, 1]]


def _children(
    front: Gaussians,
    parent: Tensor,
    fields: Tensor,
    mask: Tensor,
    count: int,
    image: Tensor,
    camera: Cameras,
) -> tuple[Gaussians, Tensor]:
    """Make the ``count`` x ``count`` children of the cells of a mask.

    Args:
        front: the parents.
        parent: ``[cells²]``, index of each cell's parent.
        fields: ``[1, 5, cells, cells]``, see ``_fields``.
        mask: ``[cells²]`` bool, the cells to split.
        count: children a side of a cell.
        image: ``[1, 4, H, W]``, see ``premultiplied``.
        camera: of the image.

    Returns:
        The children opaque enough to be drawn, and their pixels ``[.., 2]`` int64, row and column.
    """
    side, size = fields.shape[-1], fields.shape[-1] * count
    grid = mask.view(side, 1, side, 1).expand(side, count, side, count).reshape(size, size)
    row, column = grid.nonzero(as_tuple=True)
    fine = F.interpolate(fields, (size, size), mode="bilinear")[0][:, row, column].T
    depth, opacity, off = (fine[:, :4] / fine[:, 4:]).split([1, 1, 2], -1)
    rgba = F.avg_pool2d(image, image.shape[-1] // size)[0][:, row, column].T
    index = parent[row // count * side + column // count]
    detail, K = image.shape[-1] // side, camera.resized(size, size).Ks[0]
    across = depth * _across(row, column, K) + OFFSET_FRACTION[detail] * off
    points = torch.cat([across, depth], -1)
    quats = None if front.quats is None else front.quats[index]
    least = MIN_SIZE[detail] * camera.viewmats[0, 2, 3] / K[1, 1]
    across_view = (front.scales[index] / count).clamp_min(least)
    children = Gaussians(
        means=points - camera.viewmats[0, :3, 3],
        quats=quats,
        scales=torch.where(_along_the_view(quats, index), front.scales[index], across_view),
        opacities=torch.sigmoid(opacity + EMPTY * (rgba[:, 3:] - 1))[:, 0],
        colors=(rgba[:, :3] / rgba[:, 3:].clamp_min(1e-3)).clamp(0, 1),
    )
    step = image.shape[-1] // size
    pixels = torch.stack([row, column], -1) * step + step // 2
    drawn = ~(children.opacities < ALPHA_MIN)
    return children.select(drawn), pixels[drawn]


def _along_the_view(quats: Tensor | None, like: Tensor) -> Tensor:
    """Mask ``[N, 3]`` of the axis of each Gaussian that is nearest to the input camera's z."""
    if quats is None:
        return torch.tensor([False, False, True], device=like.device).expand(len(like), 3)
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
    # The last row of the rotation matrix: the z of each axis.
    depths = torch.stack([x * z - w * y, y * z + w * x, 0.5 - x * x - y * y], -1).abs()
    return depths >= depths.amax(-1, keepdim=True)


def _concatenate(parts: list[Gaussians]) -> Gaussians:
    """Concatenate Gaussians."""
    quats = [part.quats for part in parts if part.quats is not None]
    return Gaussians(
        means=torch.cat([part.means for part in parts]),
        quats=torch.cat(quats) if quats else None,
        scales=torch.cat([part.scales for part in parts]),
        opacities=torch.cat([part.opacities for part in parts]),
        colors=torch.cat([part.colors for part in parts]),
    )


def _correct(
    others: Gaussians,
    children: Gaussians,
    pixels: Tensor,
    image: Tensor,
    camera: Cameras,
    detail: int,
) -> Gaussians:
    """Correct each child by the error of its pixel in a rendering; return all Gaussians.

    Colours are compared without premultiplication, so that no background bleeds into them.

    Args:
        others: the Gaussians that did not split.
        children: ``[M]``.
        pixels: ``[M, 2]``, row and column in the image.
        image: ``[1, 4, H, W]``, see ``premultiplied``.
        camera: of the image.
    """
    size, want = image.shape[-1], image[0].permute(1, 2, 0)
    row, column = pixels.unbind(-1)
    for _ in range(ROUNDS):
        both = _concatenate([others, children])
        out = render(both, camera.resized(size, size))
        color = want[..., :3] - want[..., 3:] * out.rgb[0] / out.alpha[0].clamp_min(FAINT)
        logits = torch.logit(children.opacities, 1e-4)
        for step, fraction in ((detail // 2, 1 - SMALL_FRACTION), (detail, SMALL_FRACTION)):
            coverage = render(both, camera.resized(size // step, size // step)).alpha[0, ..., 0]
            missing = F.avg_pool2d(image[:, 3:], step)[0, 0] - coverage
            logits = logits + fraction * OPACITY_GAIN * missing[row // step, column // step]
        children = replace(
            children,
            colors=(children.colors + color[row, column]).clamp(0, 1),
            opacities=logits.sigmoid(),
        )
    return _concatenate([others, children])
