"""Foreground patches and cells of a picture; only these are computed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F


@dataclass
class Patches:
    """P foreground patches of B pictures.

    They are sorted by picture, then by position in the grid.

    Attributes:
        picture: ``[P]`` int64, index of the picture.
        position: ``[P]`` int64, position in the row-major grid.
        counts: number of patches of each picture.
        grid: patches a side of a picture.
        size: side of a patch, pixels.
    """

    picture: Tensor
    position: Tensor
    counts: list[int]
    grid: int
    size: int

    def cells(self, maps: Tensor, count: int) -> Tensor:
        """Cut maps into the cells of the patches.

        Args:
            maps: ``[B, C, n, n]``, n = grid · count.
            count: cells a side of a patch.

        Returns:
            ``[P, count², C]``, the cells of a patch row by row.
        """
        maps = maps.unflatten(3, (self.grid, count)).unflatten(2, (self.grid, count))
        row, column = self.position // self.grid, self.position % self.grid
        return maps[self.picture, :, row, :, column].flatten(2).mT

    def number(self, cells: Cells, count: int) -> Tensor:
        """Index of cells among those of all patches: ``[T]`` int64.

        Args:
            cells: cells in these patches.
            count: cells a side of a patch; numbered row by row within a patch.
        """
        index = self.position.new_zeros(len(self.counts), self.grid**2)
        index[self.picture, self.position] = torch.arange(len(self.position), device=index.device)
        patch = cells.row // count * self.grid + cells.column // count
        inside = cells.row % count * count + cells.column % count
        return index[cells.picture, patch] * count**2 + inside

    def boxes(self) -> list[tuple[tuple[int, int], tuple[int, int]]]:
        """Ranges of rows and of columns of each picture's patches.

        For a picture without patches, those of position 0. On CUDA the numbers are read back.
        """
        found = []
        for index in self.position.split(self.counts):
            positions = index.tolist() or [0]
            sides = [p // self.grid for p in positions], [p % self.grid for p in positions]
            (top, bottom), (left, right) = ((min(side), max(side) + 1) for side in sides)
            found.append(((top, bottom), (left, right)))
        return found

    def orders(self, scan: Tensor) -> tuple[Tensor, Tensor]:
        """Tokens of these patches, in the order in which the network reads a picture.

        Args:
            scan: ``[O · grid²]`` int64, position of each token's patch in O orders; see
                ``scan_orders``.

        Returns:
            ``[P O]`` int64, indices of the tokens among all of a picture, picture by picture; and
            ``[P, O]`` int64, indices into this list of each patch's token of each order.
        """
        total, device = self.grid**2, scan.device
        inside = torch.zeros(len(self.counts), total, dtype=torch.bool, device=device)
        inside[self.picture, self.position] = True
        inside = inside[:, scan]
        number = inside.flatten().cumsum(0).view_as(inside) - 1
        by_order = scan.view(-1, total)
        starts = total * torch.arange(len(by_order), device=device)[:, None]
        tokens = (by_order.argsort(1) + starts)[:, self.position].T
        return inside.nonzero()[:, 1], number[self.picture[:, None], tokens]


@dataclass
class Cells:
    """T foreground cells of B pictures.

    They are sorted by picture, then row by row.

    Attributes:
        picture: ``[T]`` int64, index of the picture.
        row: ``[T]`` int64, from the top.
        column: ``[T]`` int64, from the left.
        alpha: ``[T, 1]``, mean over the cell.
        color: ``[T, 3]``, mean of the colours, weighted by alpha.
        counts: number of cells of each picture.
    """

    picture: Tensor
    row: Tensor
    column: Tensor
    alpha: Tensor
    color: Tensor
    counts: list[int]


def premultiplied(rgba: Tensor) -> Tensor:
    """Convert ``[B, H, W, 4]`` with straight alpha to premultiplied ``[B, 4, H, W]``."""
    return torch.cat([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], -1).permute(0, 3, 1, 2)


def foreground_cells(rgba: Tensor, side: int) -> Cells:
    """Find the cells in which a picture is not fully transparent.

    On CUDA the numbers of cells are read back.

    Args:
        rgba: ``[B, H, W, 4]`` in [0, 1], straight alpha, H = W.
        side: side of a cell, pixels.
    """
    means = F.avg_pool2d(premultiplied(rgba), side).permute(0, 2, 3, 1)
    mask = means[..., 3] > 0
    values = means[mask]
    color = values[:, :3] / values[:, 3:].clamp_min(1e-3)
    picture, row, column = mask.nonzero().unbind(1)
    return Cells(picture, row, column, values[:, 3:], color, mask.sum((1, 2)).tolist())


def foreground_patches(alpha: Tensor, size: int, margin: int = 0) -> Patches:
    """Find the patches in which a picture is not fully transparent.

    On CUDA their numbers are read back.

    Args:
        alpha: ``[B, H, W]`` in [0, 1], H = W.
        size: side of a patch, pixels.
        margin: number of further patches around these, >= 0.

    Returns:
        The patches; a picture may have none.

    Raises:
        ValueError: a negative margin.
    """
    near = near_patches(alpha > 0, size, margin)
    picture, position = near.nonzero().unbind(1)
    return Patches(picture, position, near.sum(1).tolist(), alpha.shape[-1] // size, size)


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
