"""Foreground of images: the patches and cells that are not fully transparent.

Only these are computed. Their lists are made on the CPU, from the images' alpha, so that no GPU
is asked for their numbers; a training makes them while it loads the data.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from ...kernels.runtime.packed import Packed
from ..config import GambaConfig, Orders

# Of ``Foreground.padded``: significant bits of its numbers of patches, and of rows of an image;
# fraction of a patch's cells that have an object, in the mean over 1,120 images of training data.
_FINE, _COARSE = 5, 2
_FILLED = 0.72
# Patches by which the sides of ``Foreground.boxes`` grow: oneDNN compiles a kernel for each shape
# of a convolution, and keeps 1,024.
_BOX = 4


def scan_orders(height: int, width: int, orders: Orders = "backward", count: int = 4) -> Tensor:
    """Return the first ``count`` of four scan orders of a map.

    These are: row by row from the top left, column by column from the top left, and both of them
    backward (VMamba's cross-scan; paper §3.2), or "mirrored": row by row from the top right, column
    by column from the bottom left (the authors' public code).

    Returns:
        ``[count, height·width]`` int64 positions in the row-major map; each row is a permutation.
    """
    rows = np.arange(height * width).reshape(height, width)
    flipped = (0, 1) if orders == "backward" else 1
    passes = [rows, rows.T, np.flip(rows, flipped), np.flip(rows.T, flipped)]
    return torch.from_numpy(np.stack([order.flatten() for order in passes[:count]]))


@dataclass
class Foreground:
    """Index lists of B images, with P foreground patches and T foreground cells in all.

    Patches and cells are sorted by image, then row by row. Each patch has O tokens, one in each
    scan order. Tensors are int64 unless stated otherwise.

    Attributes:
        patch: ``[3, P]``: image, row and column of each patch.
        tokens: ``[P O]``, indices of the tokens among all of an image, image by image in the
            order in which the network reads them.
        patch_of: ``[P O]``, the patch of each of these tokens.
        positions: ``[P, O]``, indices into ``tokens`` of each patch's tokens.
        cu_seqlens: ``[B + 1]``, borders of each image's tokens.
        rows: ``[B, 3]`` int32, as of ``Packed``.
        cell: ``[3, T]``: image, row and column of each cell.
        number: ``[T]``, index of each cell among all cells of all patches, patch by patch.
        slot: ``[T]``, row of each cell among B times ``most`` rows.
        most: rows of an image, at least its number of cells.
        counts: number of cells of each image.
        boxes: for each image the first row and column of a box with its patches, and those behind
            the last; empty if whole images are to be computed, as on a GPU.
        void: ``[T, 1]`` float32, 0, or -inf for padding; None without padding.
    """

    patch: Tensor
    tokens: Tensor
    patch_of: Tensor
    positions: Tensor
    cu_seqlens: Tensor
    rows: Tensor
    cell: Tensor
    number: Tensor
    slot: Tensor
    most: int
    counts: list[int]
    boxes: list[tuple[int, int, int, int]]
    void: Tensor | None = None

    @property
    def packed(self) -> Packed | None:
        """The images' tokens as sequences in one row; None for a single image."""
        return Packed(self.cu_seqlens, self.rows) if len(self.counts) != 1 else None

    def to(self, device: torch.device) -> Foreground:
        """Return the lists on a device."""
        moved = {k: v.to(device) for k, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **moved)

    def padded(self, cells: int) -> Foreground:
        """Return lists of one of few lengths.

        A CUDA graph of one batch then fits many. On a CPU a step takes 6 % less: oneDNN compiles
        few kernels, and the allocator reuses blocks of the same sizes (docs/lab/step.md).

        Added tokens follow the last image's tokens, so no other token depends on them. Added
        patches and cells repeat the first of image 0; these cells are transparent, and share a
        row behind the cells of image 0.

        Args:
            cells: number of cells of a patch.
        """
        orders, patches, cells_now = len(self.positions.T), len(self.patch.T), len(self.cell.T)
        each = _FILLED * cells
        more = _rounded_up(max(patches, cells_now / each, 1), _FINE) - patches
        total = patches + more
        empty = max(math.ceil(total * each), cells_now) - cells_now
        most = _rounded_up(self.most + 1, _COARSE)
        new = torch.arange(orders * patches, orders * total)
        end = torch.tensor([orders * total])
        rows = self.rows.clone()
        rows[-1:, 2] = orders * total
        slot = self.slot + self.cell[0] * (most - self.most)
        return replace(
            self,
            patch=F.pad(self.patch, (0, more)),
            tokens=F.pad(self.tokens, (0, len(new))),
            patch_of=torch.cat([self.patch_of, new // orders]),
            positions=torch.cat([self.positions, new.view(more, orders)]),
            cu_seqlens=torch.cat([self.cu_seqlens[:-1], end]),
            rows=rows,
            cell=F.pad(self.cell, (0, empty)),
            number=F.pad(self.number, (0, empty)),
            slot=F.pad(slot, (0, empty), value=most - 1),
            void=F.pad(torch.zeros(cells_now, 1), (0, 0, 0, empty), value=-math.inf),
            most=most,
        )


def _rounded_up(number: float, bits: int) -> int:
    """Return the next number with that many significant bits."""
    step = 1 << max(0, math.ceil(number).bit_length() - bits)
    return math.ceil(number / step) * step


def find_foreground(alpha: Tensor, config: GambaConfig, margin: int = 0) -> Foreground:
    """Find the patches and cells in which an image is not fully transparent.

    Args:
        alpha: ``[B, S, S]`` in [0, 1], on the CPU.
        config: of a model with the decoder ``rays``; gives the sides of patches and cells.
        margin: number of further patches around the object's, >= 0; they have no cells.

    Returns:
        The lists on the CPU; an image may have no patch.

    Raises:
        ValueError: a negative margin.
    """
    size, count = config.patch_size, config.ray_cells
    mask, side = alpha > 0, alpha.shape[-1] // size
    near = near_patches(mask, size, margin)
    image, position = near.nonzero().unbind(1)
    row, column = position // side, position % side
    scan, inverse = _tokens_of(side, config.scan_orders, config.num_orders)
    inside = near[:, scan]
    number = (inside.flatten().cumsum(0) - 1).view_as(inside)
    positions = number[image[:, None], inverse[:, position].T]
    patch_of = torch.empty(positions.numel(), dtype=torch.int64)
    patch_of[positions] = torch.arange(len(positions))[:, None]
    borders = F.pad(config.num_orders * near.sum(1).cumsum(0), (1, 0))
    cell = (F.max_pool2d(mask.float()[:, None], size // count)[:, 0] > 0).nonzero().T
    numbers_of = torch.zeros(near.shape, dtype=torch.int64)
    numbers_of[image, position] = torch.arange(len(position))
    among = numbers_of[cell[0], cell[1] // count * side + cell[2] // count]
    counts = torch.bincount(cell[0], minlength=len(alpha))
    first = counts.max() * torch.arange(len(counts)) - counts.cumsum(0) + counts
    return Foreground(
        patch=torch.stack([image, row, column]),
        tokens=inside.nonzero()[:, 1],
        patch_of=patch_of,
        positions=positions,
        cu_seqlens=borders,
        rows=Packed.of(borders).rows,
        cell=cell.contiguous(),
        number=among * count**2 + cell[1] % count * count + cell[2] % count,
        slot=torch.arange(cell.shape[1]) + first[cell[0]],
        most=max(counts.tolist(), default=0),
        counts=counts.tolist(),
        boxes=[_box(grid) for grid in near.view(-1, side, side)],
    )


def _box(grid: Tensor) -> tuple[int, int, int, int]:
    """Return first row and column, and those behind the last, of a box with all patches."""
    begins, ends = [], []
    for axis, side in enumerate(grid.shape):
        filled = grid.any(1 - axis).nonzero()[:, 0].tolist() or [0]
        length = min(side, math.ceil((filled[-1] + 1 - filled[0]) / _BOX) * _BOX)
        begins.append(min(filled[0], side - length))
        ends.append(begins[-1] + length)
    return begins[0], begins[1], ends[0], ends[1]


@functools.lru_cache(8)
def _tokens_of(side: int, orders: Orders, count: int) -> tuple[Tensor, Tensor]:
    """Return each token's patch ``[O S²]``, and each patch's token in each order ``[O, S²]``."""
    scan = scan_orders(side, side, orders, count)
    inverse = scan.argsort(1) + scan.shape[1] * torch.arange(len(scan))[:, None]
    return scan.flatten(), inverse


def patch_pixels(maps: Tensor, patch: Tensor, size: int) -> Tensor:
    """Cut the patches of ``Foreground.patch`` from maps.

    Args:
        maps: ``[B, C, S, S]``.
        patch: ``[3, P]``.
        size: side of a patch.

    Returns:
        ``[P, size², C]``, the pixels of a patch row by row.
    """
    image, row, column = patch
    maps = maps.unflatten(3, (-1, size)).unflatten(2, (-1, size))
    return maps[image, :, row, :, column].flatten(2).mT


def cell_colors(rgba: Tensor, side: int, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Average the cells of ``Foreground.cell``.

    Args:
        rgba: ``[B, S, S, 4]`` in [0, 1], straight alpha.
        side: side of a cell, pixels.
        cell: ``[3, T]``.

    Returns:
        Colours ``[T, 3]``, weighted by alpha, and alpha ``[T, 1]``.
    """
    image, row, column = cell
    values = F.avg_pool2d(premultiplied(rgba), side)[image, :, row, column]
    return values[:, :3] / values[:, 3:].clamp_min(1e-3), values[:, 3:]


def premultiplied(rgba: Tensor) -> Tensor:
    """Convert ``[B, H, W, 4]`` with straight alpha to premultiplied ``[B, 4, H, W]``."""
    return torch.cat([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], -1).permute(0, 3, 1, 2)


def near_patches(mask: Tensor, size: int, margin: int) -> Tensor:
    """Mask of the patches with foreground, and of those within a margin.

    Args:
        mask: ``[B, H, W]`` bool, the pixels of the object.
        size: side of a patch, pixels.
        margin: number of further patches around them, >= 0.

    Returns:
        ``[B, (H/size) · (W/size)]`` bool, row by row.

    Raises:
        ValueError: a negative margin.
    """
    if margin < 0:
        raise ValueError(f"background_margin is {margin}, it must be 0 or more")
    patches = F.max_pool2d(mask.float()[:, None], size)
    return F.max_pool2d(patches, 2 * margin + 1, stride=1, padding=margin).flatten(1) > 0
