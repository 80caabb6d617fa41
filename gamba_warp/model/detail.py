"""The front of a reconstruction at the resolution of its picture: cells of ``rays`` that split.

The network sees the picture at ``image_size``; a photograph has more pixels. So after the network
each front cell may become k x k Gaussians, its children, each on the ray of its own small pixel:

- depth, what the network added to the opacity that alpha gives, and how far a parent lies off its
  ray, are interpolated between the cells. A cell counts as much as its alpha, so what is hardly
  there has no say. The opacity is over a half where alpha is 1: a network that is not sure of
  the depth makes a faint front, and then the colours of what lies behind it, which has no detail,
  show through.
- colour and alpha are those of the picture at k times the cells.
- the sizes are the parent's, 1/k of them across the view, but so large there that neighbours
  overlap: at ``image_size`` a rasterizer's own widening covers the gaps between small Gaussians, at
  k times that it does not. Along the view they stay, so that no crack opens from the side.
- a parent lies up to a pixel off its ray. Its children go a part of that way: on their rays they
  would part from cells that do not split, and all the way their pixels would show beside the
  picture's.

What is plain does not split. Cells with background in them or beside them split in 2 x 2 at most:
a rasterizer widens every Gaussian by a part of its own pixel, so the more of them stand along a
silhouette, the wider it is in a picture smaller than the one they are made for. For the same reason
two rounds of correction take colours at k times the cells, but opacities at twice the cells.
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
from .parts.patches import premultiplied, seen_cells
from .parts.rays import EMPTY

PLAIN = 6 / 255  # a cell that differs by less in itself, and from those beside it, is plain
MOST_CHILDREN = 60_000  # with the other layers less than 1 MB as ``.spz``, for most objects
SURE = 0.5  # logit of a child's opacity at least, where alpha is 1
# By detail: the standard deviation of a child across the view at least, in sides of its cell, and
# the share of its parent's way off the ray (docs/lab/rays.md has what others gave).
COVER = {2: 0.4, 4: 0.45}
OFF = {2: 0.5, 4: 0.125}
ROUNDS = 2  # of correction
SURER = 8.0  # how much the logit of an opacity rises where a whole unit of alpha is missing
FAINT = 0.05  # alpha of a rendered pixel under which its colour says little


def checked_detail(detail: Detail | None, config: GambaConfig, side: int) -> Detail:
    """How many children a side a cell may have.

    Args:
        detail: what was asked for; None: the most for which the picture has the pixels.
        config: of the model.
        side: of the square picture that is to be reconstructed, pixels.

    Raises:
        UserError: detail is no such number, or more than 1 for a decoder other than ``rays``.
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


def split_front(
    gaussians: Gaussians,
    image: Tensor,
    rgba: np.ndarray,
    config: GambaConfig,
    detail: Detail,
    camera: Cameras,
) -> Gaussians:
    """Splits the front of a reconstruction, where the picture shows more than one colour a cell.

    Args:
        gaussians: ``[N]``, what a model with the decoder ``rays`` made of one picture.
        image: ``[H, W, 4]`` in [0, 1], straight alpha: the picture as this model took it, on the
            device of ``gaussians``.
        rgba: ``[S, S, 4]`` in [0, 1], straight alpha: the same picture at its own size.
        config: of the model.
        detail: children a side of a cell at most.
        camera: ``[1]``, that of the picture, in the model's world: see ``posing``.

    Returns:
        Gaussians of the same frame: those that did not split, then at most ``MOST_CHILDREN``
        children (or four for each cell, where that is more). With detail 1, or where all is plain,
        ``gaussians`` itself.
    """
    if detail == 1:
        return gaussians
    side, device = _cells(config), gaussians.means.device
    large = torch.from_numpy(resize_rgba(rgba, side * detail, side * detail)).to(device)
    picture, seen = premultiplied(large[None]), seen_cells(image[None], config.image_size // side)
    alpha = F.avg_pool2d(image[None, None, ..., 3], config.image_size // side)
    cells = seen.row * side + seen.column  # of each front Gaussian
    counts = _children_a_side(picture, alpha, detail).flatten()
    splits = counts[cells] > 1
    if not splits.any():
        return gaussians
    camera = camera.to(device)
    is_front = torch.arange(gaussians.num, device=device) % config.ray_layers == 0
    front = gaussians.select(is_front)
    parent = cells.new_full((side * side,), -1)
    parent[cells] = torch.arange(len(cells), device=device)
    fields = _fields(front, cells, alpha, camera)
    made = [
        _children(front, parent, fields, counts == count, count, picture, camera)
        for count in sorted({2, detail})
    ]
    children, pixels = _joined([one for one, _ in made]), torch.cat([at for _, at in made])
    stays = ~is_front
    stays[is_front] = ~splits
    return _corrected(gaussians.select(stays), children, pixels, picture, camera, detail)


def _cells(config: GambaConfig) -> int:
    """Cells a side of the picture."""
    return config.grid_size * config.ray_cells


def _children_a_side(picture: Tensor, alpha: Tensor, detail: int) -> Tensor:
    """1, 2 or ``detail`` for each cell, ``[cells, cells]``: of the picture, and its cells' alpha.

    Where there would be more than ``MOST_CHILDREN`` children, the cells with the least contrast
    split in 2 x 2.
    """
    # The cells beside a cell count, too: at its edge a parent would not be sharp enough for them.
    both = F.max_pool2d(torch.cat([picture, -picture], 1), detail)
    most, least = F.max_pool2d(both, 3, stride=1, padding=1).chunk(2, 1)
    contrast = (most + least).amax(1)[0]
    splits = (contrast > PLAIN) & (alpha[0, 0] > 0)
    inner = -F.max_pool2d(-alpha, 3, stride=1, padding=1)[0, 0] > 0.99
    counts = torch.where(splits, 2, 1)
    room = (MOST_CHILDREN - 4 * int(splits.sum())) // (detail**2 - 4) if detail > 2 else 0
    contrast = torch.where(splits & inner, contrast, 0.0).flatten()
    best = contrast.topk(min(max(room, 0), len(contrast))).indices
    counts.view(-1)[best[contrast[best] > 0]] = detail
    return counts


def _fields(front: Gaussians, cells: Tensor, alpha: Tensor, camera: Cameras) -> Tensor:
    """What is interpolated, as a map of the cells, ``[1, 5, n, n]``; each is weighted by alpha.

    Depth along the ray, what the network added to the logit of the opacity, how far a parent lies
    off its ray, x and y, and the weight.
    """
    side = alpha.shape[-1]
    weight = alpha.flatten()[cells]
    opacity = (torch.logit(front.opacities, 1e-6) - EMPTY * (weight - 1)).clamp_min(SURE)
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
    picture: Tensor,
    camera: Cameras,
) -> tuple[Gaussians, Tensor]:
    """The ``count`` x ``count`` children of the cells of a mask, and their pixels in the picture.

    Args:
        front: the parents.
        parent: ``[cells²]``, which of them is that of a cell.
        fields: ``[1, 5, cells, cells]``, see ``_fields``.
        mask: ``[cells²]`` bool, which cells split.
        count: children a side of a cell.
        picture: ``[1, 4, H, W]``, see ``premultiplied``.
        camera: of the picture.

    Returns:
        Those that are drawn at all, and ``[.., 2]`` int64, row and column.
    """
    side, size = fields.shape[-1], fields.shape[-1] * count
    grid = mask.view(side, 1, side, 1).expand(side, count, side, count).reshape(size, size)
    row, column = grid.nonzero(as_tuple=True)
    fine = F.interpolate(fields, (size, size), mode="bilinear")[0][:, row, column].T
    depth, opacity, off = (fine[:, :4] / fine[:, 4:]).split([1, 1, 2], -1)
    seen = F.avg_pool2d(picture, picture.shape[-1] // size)[0][:, row, column].T
    own = parent[row // count * side + column // count]
    detail, K = picture.shape[-1] // side, camera.resized(size, size).Ks[0]
    across = depth * _across(row, column, K) + OFF[detail] * off
    points = torch.cat([across, depth], -1)
    quats = None if front.quats is None else front.quats[own]
    least = COVER[detail] * camera.viewmats[0, 2, 3] / K[1, 1]
    across_view = (front.scales[own] / count).clamp_min(least)
    children = Gaussians(
        means=points - camera.viewmats[0, :3, 3],
        quats=quats,
        scales=torch.where(_along_the_view(quats, own), front.scales[own], across_view),
        opacities=torch.sigmoid(opacity + EMPTY * (seen[:, 3:] - 1))[:, 0],
        colors=(seen[:, :3] / seen[:, 3:].clamp_min(1e-3)).clamp(0, 1),
    )
    step = picture.shape[-1] // size
    pixels = torch.stack([row, column], -1) * step + step // 2
    drawn = ~(children.opacities < ALPHA_MIN)
    return children.select(drawn), pixels[drawn]


def _along_the_view(quats: Tensor | None, like: Tensor) -> Tensor:
    """Which axis of a Gaussian is nearest to the input camera's z, ``[N, 3]`` bool."""
    if quats is None:
        return torch.tensor([False, False, True], device=like.device).expand(len(like), 3)
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
    # The last row of the rotation matrix: the z of each axis.
    depths = torch.stack([x * z - w * y, y * z + w * x, 0.5 - x * x - y * y], -1).abs()
    return depths >= depths.amax(-1, keepdim=True)


def _joined(parts: list[Gaussians]) -> Gaussians:
    """Several lots of Gaussians as one."""
    quats = [part.quats for part in parts if part.quats is not None]
    return Gaussians(
        means=torch.cat([part.means for part in parts]),
        quats=torch.cat(quats) if quats else None,
        scales=torch.cat([part.scales for part in parts]),
        opacities=torch.cat([part.opacities for part in parts]),
        colors=torch.cat([part.colors for part in parts]),
    )


def _corrected(
    others: Gaussians,
    children: Gaussians,
    pixels: Tensor,
    picture: Tensor,
    camera: Cameras,
    detail: int,
) -> Gaussians:
    """All Gaussians, after each child got what its pixel lacks in a render of them.

    Colours are compared by themselves, so that no background gets into them.

    Args:
        others: those that did not split.
        children: ``[M]``.
        pixels: ``[M, 2]``, row and column in the picture.
        picture: ``[1, 4, H, W]``, see ``premultiplied``.
        camera: of the picture.
    """
    size, step = picture.shape[-1], detail // 2
    want, alpha = picture[0].permute(1, 2, 0), F.avg_pool2d(picture[:, 3:], step)[0, 0]
    row, column = pixels.unbind(-1)
    for _ in range(ROUNDS):
        both = _joined([others, children])
        seen = render(both, camera.resized(size, size))
        color = want[..., :3] - want[..., 3:] * seen.rgb[0] / seen.alpha[0].clamp_min(FAINT)
        lacks = alpha - render(both, camera.resized(size // step, size // step)).alpha[0, ..., 0]
        logits = torch.logit(children.opacities, 1e-4) + SURER * lacks[row // step, column // step]
        children = replace(
            children,
            colors=(children.colors + color[row, column]).clamp(0, 1),
            opacities=logits.sigmoid(),
        )
    return _joined([others, children])
