"""gsplat's lists of tiles, from boxes, in torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .checks import positive, shape


def tile_bits(tiles: int) -> int:
    """Bits that gsplat keeps for the number of a tile."""
    return tiles.bit_length()


def pair_ids(images: Tensor, tiles: Tensor, depths: Tensor, count: int) -> Tensor:
    """Makes gsplat's numbers of pairs, image | tile | depth, whose order is that of the lists.

    Args:
        images: ``[P]`` int64.
        tiles: ``[P]`` int64, tile of the picture.
        depths: ``[P]`` float32.
        count: tiles of a picture.

    Returns:
        ``[P]`` int64; the lower half holds the bits of the depth.
    """
    depth = depths.float().contiguous().view(torch.int32).long() & 0xFFFFFFFF
    return (images << (tile_bits(count) + 32)) | (tiles << 32) | depth


@torch.no_grad()
def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of tiles and Gaussians whose boxes meet.

    Args:
        means2d: ``[.., N, 2]`` pixels, or packed ``[nnz, 2]``.
        radii: the same shape, half sides of the boxes; no pair where one is 0.
        depths: ``[.., N]`` or ``[nnz]``.
        tile_size: side of a tile, pixels.
        tile_width: tiles in a row.
        tile_height: rows of tiles.
        sort: by image, tile and depth; else by image and Gaussian.
        segmented: a way of sorting, without effect here.
        packed: whether the tensors are packed.
        n_images: of packed tensors.
        image_ids: ``[nnz]`` of packed tensors.
        gaussian_ids: of packed tensors; not used.

    Returns:
        ``tiles_per_gauss`` int32 ``[.., N]`` or ``[nnz]``; ``isect_ids`` int64 and ``flatten_ids``
        int32 ``[n_isects]``, the index in the flattened Gaussians.

    Raises:
        TypeError: no tensor.
        ValueError: a shape or number is not as above, or the numbers of pairs do not fit 63 bits.
    """
    lead = tuple(means2d.shape[:-1])
    shape("means2d", means2d, (*lead, 2))
    shape("radii", radii, (*lead, 2))
    shape("depths", depths, lead)
    positive(tile_size=tile_size, tile_width=tile_width, tile_height=tile_height)
    if packed:
        if n_images is None or image_ids is None:
            raise ValueError("n_images and image_ids are None: packed tensors need them")
        shape("image_ids", image_ids, lead)
        count, images = n_images, image_ids.long()
    else:
        count, num = math.prod(lead[:-1]), lead[-1]
        images = torch.arange(count, device=means2d.device).repeat_interleave(num)
    tiles = tile_width * tile_height
    if count.bit_length() + tile_bits(tiles) + 32 > 63:
        raise ValueError(f"{count} images of {tiles} tiles: their numbers do not fit 63 bits")
    size = means2d.new_tensor([tile_width, tile_height])
    center, reach = (x.reshape(-1, 2) / tile_size for x in (means2d, radii))
    first = (center - reach).floor().clamp_min(0).minimum(size).long()
    last = (center + reach).ceil().clamp_min(0).minimum(size).long()
    counts = (last - first).prod(-1) * (radii.reshape(-1, 2) > 0).all(-1)
    gaussian = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    place = (
        torch.arange(len(gaussian), device=counts.device) - (counts.cumsum(0) - counts)[gaussian]
    )
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
    """Where the list of each tile begins.

    Args:
        isect_ids: ``[n_isects]`` int64, sorted, from ``isect_tiles``.
        n_images: pictures.
        tile_width: tiles in a row.
        tile_height: rows of tiles.

    Returns:
        ``[n_images, tile_height, tile_width]`` int32.

    Raises:
        TypeError: no tensor.
        ValueError: ``isect_ids`` has not one dimension.
    """
    shape("isect_ids", isect_ids, (isect_ids.numel(),))
    tiles = tile_width * tile_height
    image, tile = torch.arange(n_images), torch.arange(tiles)
    keys = ((image[:, None] << tile_bits(tiles)) | tile).to(isect_ids.device)
    begins = torch.searchsorted(isect_ids >> 32, keys.flatten())
    return begins.int().view(n_images, tile_height, tile_width)
