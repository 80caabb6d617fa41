"""Sums of the absolute gradients of centres (Ye et al. 2024, "AbsGS"), in torch.

The rasterizer's own gradient sums over pixels with their signs, and the absolute values cannot be
had from those sums. So backward walks the lists once more here, tile by tile, only if asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from gamba_warp.kernels.rasterize.tiles import Limits, Tiling

_ROOM = 2**19  # numbers of (tile, pair, pixel) that are worked on at once: they fit a cache


class Drawn(tuple):
    """What a picture was made of: means2d ``[R, 2]``, conics ``[R, 3]`` (a, k, e), opacities
    ``[R]``, colors ``[R, C]``, pairs ``[P]`` (rows of the first four) and starts
    ``[I * tiles + 1]``.
    """


def _groups(counts: Tensor, pixels: int) -> Iterator[tuple[Tensor, int]]:
    """Tiles with lists, those of like lengths together, and the length of the longest."""
    order = counts.argsort(descending=True)
    lengths = counts[order].tolist()
    begin = 0
    while begin < len(lengths) and lengths[begin]:
        some = max(1, _ROOM // (lengths[begin] * pixels))
        end = min(begin + some, sum(1 for n in lengths[begin : begin + some] if n) + begin)
        yield order[begin:end], lengths[begin]
        begin = end


def _by_tile(picture: Tensor, tiling: Tiling) -> Tensor:
    """``[I, H, W, C]`` to ``[I * tiles, tile², C]``, with 0 beyond the picture."""
    right, below = (-size % tiling.tile for size in (tiling.width, tiling.height))
    padded = F.pad(picture, (0, 0, 0, right, 0, below))
    cut = padded.unflatten(2, (tiling.tiles_x, tiling.tile))
    cut = cut.unflatten(1, (tiling.tiles_y, tiling.tile))
    return cut.transpose(2, 3).flatten(3, 4).flatten(0, 2)


@torch.no_grad()
def absolute_gradients(
    drawn: Drawn, tiling: Tiling, limits: Limits, v_renders: Tensor, v_alphas: Tensor
) -> Tensor:
    """``Σ_pixels |∂L/∂means2d|`` of each row, by README §5 of the rasterizer.

    Args:
        drawn: what the picture was made of.
        tiling: the cut into tiles.
        limits: of alpha and transmittance.
        v_renders: ``[I, H, W, C]``, the gradient of the picture.
        v_alphas: ``[I, H, W, 1]``.

    Returns:
        ``[R, 2]``.
    """
    means2d, conics, opacities, colors, pairs, starts = drawn
    total = torch.zeros_like(means2d)
    upstream = _by_tile(torch.cat([v_renders, v_alphas], -1), tiling)
    # a channel of ones stands for alpha, which is the sum of the weights
    colors = torch.cat([colors, torch.ones_like(opacities)[:, None]], -1)
    inside = torch.arange(tiling.tile**2, device=means2d.device)
    offsets = torch.stack([inside % tiling.tile, inside // tiling.tile], -1) + 0.5
    counts = starts.diff()
    for tiles, longest in _groups(counts, len(inside)):
        place = torch.arange(longest, device=tiles.device)
        real = place < counts[tiles, None]
        rows = pairs[(starts[tiles, None] + place).clamp_max(len(pairs) - 1)]
        column, line = tiles % tiling.tiles_x, tiles // tiling.tiles_x % tiling.tiles_y
        corners = torch.stack([column, line], -1) * tiling.tile
        d = corners[:, None, None] + offsets - means2d[rows][:, :, None]
        a, k, e = conics[rows][:, :, None].unbind(-1)
        dy = d[..., 1]
        u = d[..., 0] + k * dy
        alpha = opacities[rows][..., None] * torch.exp(-0.5 * (a * u * u + e * dy * dy))
        alpha = torch.where(real[..., None] & (alpha >= limits.alpha_min), alpha, 0.0)
        clamped = alpha >= limits.alpha_max
        alpha = alpha.clamp_max(limits.alpha_max)
        after = (1 - alpha).cumprod(1)
        live = (after > limits.t_min) & ~clamped
        before = after / (1 - alpha)
        worth = torch.einsum("tlc,tpc->tlp", colors[rows], upstream[tiles])
        part = torch.where(after > limits.t_min, before * alpha * worth, 0.0)
        behind = part.flip(1).cumsum(1).flip(1) - part
        h = torch.where(live, alpha * (before * worth - behind / (1 - alpha)), 0.0)
        x, y = a * h * u, a * k * h * u + e * h * dy
        sums = torch.stack([x.abs().sum(-1), y.abs().sum(-1)], -1)
        total.index_add_(0, rows.flatten(), sums.flatten(0, 1))
    return total


class _Listen(torch.autograd.Function):
    """Passes pictures on; in backward their gradients go to a function that looks at them."""

    @staticmethod
    def forward(ctx: Any, look: Callable, renders: Tensor, alphas: Tensor) -> tuple[Tensor, Tensor]:
        ctx.look = look
        return renders.view_as(renders), alphas.view_as(alphas)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        ctx.look(*grads)
        return None, *grads


def listen(look: Callable[[Tensor, Tensor], None], renders: Tensor, alphas: Tensor):
    """The same pictures; ``look`` is called with their gradients when backward has them.

    Args:
        look: takes the gradients of both.
        renders: any shape.
        alphas: any shape.
    """
    return _Listen.apply(look, renders, alphas)
