"""gsplat's tile lists, and compositing of such lists."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from gamba_warp.kernels.rasterize import Skip
from gamba_warp.kernels.rasterize.autograd import composite
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, T_MIN, TILE
from gamba_warp.kernels.rasterize.tiles import Bins, Limits, Size, Tiling

from ..shared import check_tensor, one_device, side

LIMITS = Limits(ALPHA_MIN, 0.999, T_MIN)  # gsplat 1.5.3 clamps alpha at 0.999
SKIP = Skip().bits()


def pair_ids(images: Tensor, tiles: Tensor, depths: Tensor, count: int) -> Tensor:
    """Make gsplat's ids of pairs, image | tile | depth, which sort the lists.

    Args:
        images: ``[P]`` int64.
        tiles: ``[P]`` int64, index of the tile in the image.
        depths: ``[P]`` float32.
        count: tiles per image.

    Returns:
        ``[P]`` int64; the lower half holds the bits of the depth.
    """
    depth = depths.float().contiguous().view(torch.int32).long() & 0xFFFFFFFF
    return (images << (count.bit_length() + 32)) | (tiles << 32) | depth


@torch.no_grad()
def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int,
    tile_height: int, sort: bool = True, segmented: bool = False, packed: bool = False,
    n_images: int | None = None, image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Find pairs of tiles and Gaussians whose boxes overlap.

    Args:
        means2d: ``[.., N, 2]`` pixels, or packed ``[nnz, 2]``.
        radii: the same shape, half sides of the boxes; no pair where one is 0.
        depths: ``[.., N]`` or ``[nnz]``.
        tile_size: side of a tile, pixels.
        tile_width: tiles in a row.
        tile_height: rows of tiles.
        sort: by image, tile and depth; else by image and Gaussian.
        segmented: a way of sorting, without effect here.
        packed: the tensors are packed.
        n_images: of packed tensors.
        image_ids: ``[nnz]`` of packed tensors.
        gaussian_ids: of packed tensors; not used.

    Returns:
        ``tiles_per_gauss`` int32 ``[.., N]`` or ``[nnz]``; ``isect_ids`` int64 and ``flatten_ids``
        int32 ``[n_isects]``, the index in the flattened Gaussians.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: a shape or number is not as above, or the numbers of pairs do not fit 63 bits.
    """
    check_tensor("means2d", means2d, ("..", 2))
    lead = means2d.shape[:-1]
    check_tensor("radii", radii, (*lead, 2))
    check_tensor("depths", depths, (*lead,))
    tile_size, tile_width, tile_height = side(
        tile_size=tile_size, tile_width=tile_width, tile_height=tile_height
    )
    if packed:
        if n_images is None or image_ids is None:
            raise ValueError("n_images and image_ids are None: packed tensors need them")
        check_tensor("image_ids", image_ids, (*lead,))
        count, images = operator.index(n_images), image_ids.long()
    else:
        count, num = math.prod(lead[:-1]), lead[-1]
        images = torch.arange(count, device=means2d.device).repeat_interleave(num)
    tiles = tile_width * tile_height
    if count.bit_length() + tiles.bit_length() + 32 > 63:
        raise ValueError(f"{count} images of {tiles} tiles: their indices do not fit in 63 bits")
    size = means2d.new_tensor([tile_width, tile_height])
    center, reach = (x.reshape(-1, 2) / tile_size for x in (means2d, radii))
    first = (center - reach).floor().clamp_min(0).minimum(size).long()
    last = (center + reach).ceil().clamp_min(0).minimum(size).long()
    counts = (last - first).prod(-1) * (radii.reshape(-1, 2) > 0).all(-1)
    gaussian = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    begins = counts.cumsum(0) - counts
    place = torch.arange(len(gaussian), device=counts.device) - begins[gaussian]
    columns = (last - first)[gaussian, 0]
    x, y = first[gaussian, 0] + place % columns, first[gaussian, 1] + place // columns
    ids = pair_ids(images[gaussian], y * tile_width + x, depths.flatten()[gaussian], tiles)
    if sort:
        ids, order = ids.sort(stable=True)
        gaussian = gaussian[order]
    return counts.int().view(lead), ids, gaussian.int()


@torch.no_grad()
def isect_offset_encode(
    isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int
) -> Tensor:
    """Return the start of each tile's list.

    Args:
        isect_ids: ``[n_isects]`` int64, sorted, from ``isect_tiles``.
        n_images: images.
        tile_width: tiles in a row.
        tile_height: rows of tiles.

    Returns:
        ``[n_images, tile_height, tile_width]`` int32.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: ``isect_ids`` is not one-dimensional.
    """
    check_tensor("isect_ids", isect_ids, ("P",))
    tile_width, tile_height = side(tile_width=tile_width, tile_height=tile_height)
    n_images = operator.index(n_images)
    tiles = tile_width * tile_height
    image, tile = torch.arange(n_images), torch.arange(tiles)
    keys = ((image[:, None] << tiles.bit_length()) | tile).to(isect_ids.device)
    begins = torch.searchsorted(isect_ids >> 32, keys.flatten())
    return begins.int().view(n_images, tile_height, tile_width)


def blend(
    layers: Sequence[Tensor],
    bins: Bins,
    tiling: Tiling,
    views: int = 1,
    keep: Callable[[Tensor], None] | None = None,
) -> tuple[Tensor, Tensor]:
    """Composite I images ``[I, H, W, C]``, with their transmittances ``[I, H, W, 1]``.

    Args:
        layers: R rows of each image: means2d ``[I, R, 2]`` pixels, conics ``[I, R, 3]`` (a, k, e
            of ``a (dx + k dy)² + e dy²``), opacities ``[I, R]``, and colors ``[I * R, C]``, or
            ``[I / views * R, C]`` if an object's views share them. The lists index rows of all.
        bins: the tile lists.
        tiling: the division into tiles.
        views: images per object that share the colours; 1 if none do.
        keep: called in backward with the absolute gradients ``[I * R, 2]`` of the centres, summed
            over the pixels (Ye et al. 2024, "AbsGS"), if these need a gradient; or None.
    """
    size = Size(tiling.width, tiling.height, views, views == 1, SKIP)
    means2d, sums = layers[0], None
    if keep is not None and means2d.requires_grad:
        sums = torch.zeros_like(means2d)
        means2d = means2d.view_as(means2d)  # it has no other gradient than the compositor's
        means2d.register_hook(lambda _: keep(sums.flatten(0, 1).clone()))
    arguments = list(bins), None, sums, *size, *LIMITS
    renders, transmittances, *_ = composite(means2d, *layers[1:], *arguments)
    return renders, transmittances


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int,
    image_height: int, tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor,
    backgrounds: Tensor | None = None, masks: Tensor | None = None, packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Composite the Gaussians of given lists, front to back; differentiable in all but the lists.

    Args:
        means2d: ``[.., N, 2]`` pixels, or packed ``[nnz, 2]``.
        conics: ``[.., N, 3]`` or ``[nnz, 3]``: xx, xy, yy of the inverse covariances; only positive
            definite ones are drawn.
        colors: ``[.., N, D]`` or ``[nnz, D]``, any D >= 1.
        opacities: ``[.., N]`` or ``[nnz]``.
        image_width: pixels.
        image_height: pixels.
        tile_size: side of a tile, pixels. Unless a multiple of 16, each tile has copies of its
            Gaussians: slower, with the same image.
        isect_offsets: ``[.., tile_height, tile_width]`` int32.
        flatten_ids: ``[n_isects]`` int32.
        backgrounds: ``[.., D]`` or ``[D]``, or None: black.
        masks: ``[.., tile_height, tile_width]`` bool, or None; False shows the background.
        packed: the tensors are packed.
        absgrad: in backward, set ``means2d.absgrad`` to the sum of absolute gradients over pixels.

    Returns:
        ``[.., image_height, image_width, D]`` and alphas ``[.., image_height, image_width, 1]``.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: a shape or device is not as above; the lists index missing rows.
    """
    check_tensor("isect_offsets", isect_offsets, ("..", "tile_height", "tile_width"))
    *lead, grid_y, grid_x = isect_offsets.shape
    check_tensor("means2d", means2d, ("nnz", 2) if packed else (*lead, "N", 2))
    rows = means2d.shape[:-1]
    check_tensor("conics", conics, (*rows, 3))
    check_tensor("opacities", opacities, (*rows,))
    check_tensor("colors", colors, (*rows, "D >= 1"))
    check_tensor("flatten_ids", flatten_ids, ("P",))
    shape = *lead, colors.shape[-1]
    check_tensor("backgrounds", backgrounds, shape, shape[-1:], optional=True)
    check_tensor("masks", masks, (*lead, grid_y, grid_x), optional=True)
    one_device(dict(means2d=means2d, conics=conics, colors=colors, opacities=opacities))
    image_width, image_height, tile_size = side(
        image_width=image_width, image_height=image_height, tile_size=tile_size
    )
    if grid_y * tile_size < image_height or grid_x * tile_size < image_width:
        need = f"{image_height} x {image_width} pixels"
        raise ValueError(
            f"isect_offsets has {grid_y, grid_x} tiles of {tile_size}: too few for {need}"
        )
    total, ids, begins = math.prod(rows), flatten_ids.long(), isect_offsets.flatten().long()
    counts = F.pad(begins, (0, 1), value=len(ids)).diff()
    if len(begins) and (int(begins[0]) != 0 or int(counts.min()) < 0):
        raise ValueError(f"isect_offsets do not increase from 0 to {len(ids)}, the length of ids")
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < total:
        raise ValueError(
            f"flatten_ids goes from {int(ids.min())} to {int(ids.max())}, must be in [0, {total})"
        )

    # From gsplat's xx, xy, yy to (a, k, e) in float64, because e = yy - xy²/xx cancels for needles.
    xx, xy, yy = conics.reshape(total, 3).double().unbind(-1)
    fits = (xx > 0) & (xx * yy - xy * xy > 0)  # else not an ellipse, and not drawn
    a = torch.where(fits, xx, 1.0)
    k = torch.where(fits, xy, 0.0) / a
    sheared = torch.stack([a, k, torch.where(fits, yy, 1.0) - a * k * k], -1)
    visible = torch.where(fits, opacities.reshape(total), 0.0)
    layers = [means2d.reshape(total, 2), sheared, visible, colors.reshape(total, colors.shape[-1])]

    def keep(values: Tensor) -> None:
        if moved:
            values = values.new_zeros(total, 2).index_add_(0, ids, values[: len(ids)])
        means2d.absgrad = values[:total].view(means2d.shape)  # type: ignore[attr-defined]

    # Each of gsplat's tiles begins at one of ours. If it ends within a tile, the next one is
    # shifted to a tile's border, with its Gaussians.
    device, parts = means2d.device, -(-tile_size // TILE)
    moved = tile_size % TILE != 0
    if moved:
        owner = torch.arange(len(counts), device=device).repeat_interleave(counts)
        corner = torch.stack([owner % grid_x, owner // grid_x % grid_y], -1)
        layers = [x[ids] for x in layers]
        layers[0] = layers[0] + corner * (parts * TILE - tile_size)
    images = math.prod(lead)
    around = torch.arange(len(counts), device=device).view(images, grid_y, 1, grid_x, 1)
    around = around.expand(-1, -1, parts, -1, parts).flatten()
    counts = (counts if masks is None else torch.where(masks.flatten(), counts, 0))[around]
    starts = F.pad(counts.cumsum(0), (1, 0))
    pairs = torch.arange(int(starts[-1]), device=device)
    pairs = pairs + (begins[around] - starts[:-1]).repeat_interleave(counts)
    pairs = pairs if moved else ids[pairs]

    # Rows are split evenly among the images, with a few spare ones.
    each = -(-len(layers[0]) // max(images, 1))
    spare = each * images - len(layers[0])
    layers = [F.pad(x.float(), (0, 0) * (x.dim() - 1) + (0, spare)) for x in layers]
    layers[:3] = (x.view(images, each, *x.shape[1:]) for x in layers[:3])
    order = pairs.argsort(stable=True)  # pairs of a row are numbered together
    number = torch.empty_like(order)
    number[order] = torch.arange(len(order), device=device)
    bins = Bins(
        order=torch.arange(images * each, device=device, dtype=torch.int32),
        offsets=F.pad(torch.bincount(pairs, minlength=images * each).cumsum(0), (1, 0)).int(),
        pairs=pairs.int(),
        rows=number.int(),
        starts=starts.int(),
        count=starts[-1],
    )
    tiling = Tiling(grid_x * parts * TILE, grid_y * parts * TILE)
    cropped = []
    for image in blend(layers, bins, tiling, keep=keep if absgrad else None):
        apart = image.unflatten(2, (grid_x, -1)).unflatten(1, (grid_y, -1))
        whole = apart[:, :, :tile_size, :, :tile_size].flatten(3, 4).flatten(1, 2)
        whole = whole[:, :image_height, :image_width]
        cropped.append(whole.reshape(*lead, *whole.shape[1:]))
    renders, transmittances = cropped
    if backgrounds is not None:
        renders = renders + transmittances * backgrounds.expand(shape)[..., None, None, :]
    return renders, 1 - transmittances
