"""gsplat's ``rasterize_to_pixels``: given lists of tiles, blended by our compositor."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from gamba_warp.kernels.rasterize import Skip
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, T_MIN
from gamba_warp.kernels.rasterize.cpu.tuning import Tuning, tuning_for
from gamba_warp.kernels.rasterize.ops import composite
from gamba_warp.kernels.rasterize.tiles import Bins, Limits, Size, Tiling

from .absolute import Drawn, absolute_gradients, listen
from .checks import one_device, positive, shape, side

LIMITS = Limits(ALPHA_MIN, 0.999, T_MIN)  # gsplat 1.5.3 clamps alpha at 0.999
SKIP = Skip().bits()


class Layers(NamedTuple):
    """What is blended in I pictures: R rows of each; the lists of tiles name rows of all.

    Attributes:
        means2d: ``[I, R, 2]`` pixels.
        conics: ``[I, R, 3]``: a, k, e of ``a (dx + k dy)² + e dy²``.
        opacities: ``[I, R]``.
        colors: ``[I * R, C]``, or ``[I / views * R, C]`` if an object's views share them.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor


def blend(
    layers: Layers,
    bins: Bins,
    tiling: Tiling,
    tuning: Tuning,
    views: int,
    keep: Callable[[Tensor], None] | None,
) -> tuple[Tensor, Tensor]:
    """Blends I pictures: ``[I, H, W, C]`` and alphas ``[I, H, W, 1]``, with gradients.

    Args:
        layers: what is blended.
        bins: the lists of tiles.
        tiling: the cut into tiles.
        tuning: its tile is the tiling's.
        views: pictures of an object, which share the colours; 1 if none do.
        keep: given, in backward, the absolute gradients ``[I * R, 2]`` of the centres; or None.
    """
    size = Size(tiling.width, tiling.height, views, int(views == 1), SKIP)
    renders, alphas, *_ = composite(
        *layers, list(bins), list(size), list(LIMITS), tuning.numbers(), None
    )
    if keep is None:
        return renders, alphas
    means2d, conics, opacities, colors = (x.detach() for x in layers)
    if views > 1:
        shared = colors.view(len(means2d) // views, 1, -1, colors.shape[-1])
        colors = shared.expand(-1, views, -1, -1).flatten(0, 2)
    rows = means2d.flatten(0, 1), conics.flatten(0, 1), opacities.flatten(), colors
    drawn = Drawn((*rows, bins.pairs, bins.starts))

    def look(v_renders: Tensor, v_alphas: Tensor) -> None:
        keep(absolute_gradients(drawn, tiling, LIMITS, v_renders, v_alphas))

    return listen(look, renders, alphas)


class Lists(NamedTuple):
    """gsplat's lists: those of ``counts[t]`` ids from ``begins[t]`` on belong to tile t.

    Attributes:
        ids: ``[P]`` rows.
        begins: ``[I * tiles]``.
        counts: ``[I * tiles]``.
    """

    ids: Tensor
    begins: Tensor
    counts: Tensor

    def taken(self, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """The lists of some tiles one after another: places in ``ids``, and their counts."""
        counts, begins = self.counts[tiles], self.begins[tiles]
        ends = counts.cumsum(0)
        places = torch.arange(int(counts.sum()), device=counts.device)
        return places + (begins - (ends - counts)).repeat_interleave(counts), counts


def _lists(offsets: Tensor, ids: Tensor, masks: Tensor | None, rows: int) -> Lists:
    begins = offsets.flatten().long()
    counts = torch.cat([begins, begins.new_tensor([len(ids)])]).diff()
    if len(begins) and (int(begins[0]) < 0 or int(counts.min()) < 0):
        raise ValueError(f"isect_offsets do not rise from 0 to {len(ids)}, the length of ids")
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < rows:
        raise ValueError(f"flatten_ids has {int(ids.min())} to {int(ids.max())} of {rows} rows")
    if masks is not None:
        counts = torch.where(masks.flatten(), counts, 0)
    return Lists(ids.long(), begins, counts)


def _bins(pairs: Tensor, counts: Tensor, rows: int) -> Bins:
    """Lists in tile order as the compositor has them; pairs of a row are numbered together."""
    order = pairs.argsort(stable=True)
    number = torch.empty_like(order)
    number[order] = torch.arange(len(order), device=order.device)
    ends = torch.bincount(pairs, minlength=rows).cumsum(0)
    return Bins(
        order=torch.arange(rows, device=pairs.device, dtype=torch.int32),
        offsets=F.pad(ends, (1, 0)).int(),
        pairs=pairs.int(),
        rows=number.int(),
        starts=F.pad(counts.cumsum(0), (1, 0)).int(),
        box_pairs=counts.sum(),
        count=counts.sum(),
    )


def _sheared(conics: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """From gsplat's xx, xy, yy to (a, k, e); what is no ellipse gets opacity 0.

    In float64, because ``e = yy - xy²/xx`` cancels for needles.
    """
    xx, xy, yy = conics.double().unbind(-1)
    fits = (xx > 0) & (xx * yy - xy * xy > 0)
    xx = torch.where(fits, xx, 1.0)
    k = torch.where(fits, xy, 0.0) / xx
    e = torch.where(fits, yy, 1.0) - xx * k * k
    return torch.stack([xx, k, e], -1).float(), torch.where(fits, opacities, 0.0)


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Blends the Gaussians of given lists, front to back; differentiable in all but the lists.

    Args:
        means2d: ``[.., N, 2]`` pixels, or packed ``[nnz, 2]``.
        conics: ``[.., N, 3]`` or ``[nnz, 3]``: xx, xy, yy of the inverse covariances; one that is
            not positive definite is not drawn.
        colors: ``[.., N, D]`` or ``[nnz, D]``, any D >= 1.
        opacities: ``[.., N]`` or ``[nnz]``.
        image_width: pixels.
        image_height: pixels.
        tile_size: side of a tile, pixels. With another one than 16 each tile is drawn as a
            picture of its own, with copies of its Gaussians: slower, and the same picture.
        isect_offsets: ``[.., tile_height, tile_width]`` int32.
        flatten_ids: ``[n_isects]`` int32.
        backgrounds: ``[.., D]``, or None: black.
        masks: ``[.., tile_height, tile_width]`` bool, or None; where False, the background is seen.
        packed: whether the tensors are packed.
        absgrad: in backward, set ``means2d.absgrad`` to the sum of the pixels' absolute gradients.

    Returns:
        ``[.., image_height, image_width, D]`` and alphas ``[.., image_height, image_width, 1]``.

    Raises:
        TypeError: no tensor.
        ValueError: a shape or device is not as above; the lists name rows that are not there.
    """
    lead = tuple(isect_offsets.shape[:-2])
    rows = (len(means2d),) if packed else (*lead, means2d.shape[-2])
    shape("means2d", means2d, (*rows, 2))
    shape("conics", conics, (*rows, 3))
    shape("opacities", opacities, rows)
    shape("colors", colors, (*rows, max(1, colors.shape[-1])))
    shape("flatten_ids", flatten_ids, (flatten_ids.numel(),))
    if backgrounds is not None:
        shape("backgrounds", backgrounds, (*lead, colors.shape[-1]))
    if masks is not None:
        shape("masks", masks, tuple(isect_offsets.shape))
    one_device(dict(means2d=means2d, conics=conics, colors=colors, opacities=opacities))
    side(image_width=image_width, image_height=image_height)
    positive(tile_size=tile_size)
    grid = tuple(isect_offsets.shape[-2:])
    if grid[0] * tile_size < image_height or grid[1] * tile_size < image_width:
        need = f"{image_height} x {image_width} pixels"
        raise ValueError(f"isect_offsets has {grid} tiles of {tile_size}: too few for {need}")
    total, images = math.prod(rows), math.prod(lead)
    sheared, visible = _sheared(conics.reshape(total, 3), opacities.reshape(total))
    flat = [means2d.reshape(total, 2), sheared, visible, colors.reshape(total, colors.shape[-1])]
    lists = _lists(isect_offsets, flatten_ids, masks, total)

    def keep(values: Tensor) -> None:
        means2d.absgrad = values.view(means2d.shape)  # type: ignore[attr-defined]

    cut = _Cut(images, grid[0], grid[1], tile_size, image_width, image_height)
    renders, alphas = _draw(flat, lists, cut, keep if absgrad else None)
    renders, alphas = (x.reshape(*lead, *x.shape[1:]) for x in (renders, alphas))
    if backgrounds is not None:
        renders = renders + (1 - alphas) * backgrounds[..., None, None, :]
    return renders, alphas


class _Cut(NamedTuple):
    """How I pictures are cut into gsplat's tiles."""

    images: int
    rows: int
    columns: int
    tile: int
    width: int
    height: int


def _draw(flat: list[Tensor], lists: Lists, cut: _Cut, keep: Callable | None):
    tuning = tuning_for(flat[0].device.type)
    tiling = Tiling(cut.width, cut.height, tuning.tile)
    grid = (tiling.tiles_y, tiling.tiles_x)
    if cut.tile == tuning.tile and grid == (cut.rows, cut.columns):
        tiles = torch.arange(len(lists.counts), device=lists.counts.device)
        places, counts = lists.taken(tiles)
        pairs = lists.ids[places]
        return _blend_rows(flat, pairs, counts, cut.images, tiling, tuning, keep)
    return _draw_apart(flat, lists, cut, tuning, keep)


def _draw_apart(flat: list[Tensor], lists: Lists, cut: _Cut, tuning: Tuning, keep: Callable | None):
    """Tiles of any size: each is a picture of its own, with copies of its rows."""
    parts = -(-cut.tile // tuning.tile)
    side = parts * tuning.tile
    tiles = torch.arange(len(lists.counts), device=lists.counts.device)
    places, counts = lists.taken(tiles)
    ids = lists.ids[places]
    owner = tiles.repeat_interleave(counts)
    corner = torch.stack([owner % cut.columns, owner // cut.columns % cut.rows], -1)
    copies = [x[ids] for x in flat]
    copies[0] = copies[0] - corner * cut.tile
    mine = Lists(ids, counts.cumsum(0) - counts, counts)
    pairs, fine_counts = mine.taken(tiles.repeat_interleave(parts * parts))

    def gather(values: Tensor) -> None:
        if keep is not None:
            keep(values.new_zeros(len(flat[0]), 2).index_add_(0, ids, values))

    tiling = Tiling(side, side, tuning.tile)
    drawn = _blend_rows(copies, pairs, fine_counts, len(tiles), tiling, tuning, keep and gather)
    return tuple(_together(x, cut) for x in drawn)


def _together(pictures: Tensor, cut: _Cut) -> Tensor:
    apart = pictures[:, : cut.tile, : cut.tile].unflatten(0, (cut.images, cut.rows, cut.columns))
    whole = apart.transpose(2, 3).flatten(3, 4).flatten(1, 2)
    return whole[:, : cut.height, : cut.width]


def _blend_rows(
    flat: list[Tensor],
    pairs: Tensor,
    counts: Tensor,
    images: int,
    tiling: Tiling,
    tuning: Tuning,
    keep: Callable | None,
) -> tuple[Tensor, Tensor]:
    """Blends rows that belong to all pictures: they are dealt out to them, with a few to spare."""
    total = len(flat[0])
    each = -(-total // max(images, 1))
    spare = each * images - total
    means2d, conics, opacities, colors = (
        F.pad(x.float(), (0, 0, 0, spare) if x.dim() == 2 else (0, spare)).contiguous()
        for x in flat
    )
    layers = Layers(
        means2d.view(images, each, 2),
        conics.view(images, each, 3),
        opacities.view(images, each),
        colors,
    )
    bins = _bins(pairs, counts, images * each)
    cropped = None if keep is None else lambda values: keep(values[:total])
    return blend(layers, bins, tiling, tuning, 1, cropped)
