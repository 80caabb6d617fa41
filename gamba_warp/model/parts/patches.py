"""Which patches of a picture are computed: those that see something of the object."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F


@dataclass
class Patches:
    """P patches of B pictures; the others are plain background, and nothing is computed of them.

    They stand picture by picture, and in the order of the grid in a picture.

    Attributes:
        picture: ``[P]`` int64, the number of the picture.
        place: ``[P]`` int64, place in the row-major grid.
        counts: how many each picture has.
        grid: patches a side of a picture.
        size: side of a patch, pixels.
    """

    picture: Tensor
    place: Tensor
    counts: list[int]
    grid: int
    size: int

    def cells(self, maps: Tensor, count: int) -> Tensor:
        """Cuts maps into the cells of the patches.

        Args:
            maps: ``[B, C, n, n]``, n = grid · count.
            count: cells a side of a patch.

        Returns:
            ``[P, count², C]``, the cells of a patch row by row.
        """
        maps = maps.unflatten(3, (self.grid, count)).unflatten(2, (self.grid, count))
        row, column = self.place // self.grid, self.place % self.grid
        return maps[self.picture, :, row, :, column].flatten(2).mT

    def number(self, cells: Cells, count: int) -> Tensor:
        """Where cells are among those of all patches: ``[T]`` int64.

        Args:
            cells: cells in these patches.
            count: cells a side of a patch; within a patch they are counted row by row.
        """
        found = self.place.new_zeros(len(self.counts), self.grid**2)
        found[self.picture, self.place] = torch.arange(len(self.place), device=found.device)
        patch = cells.row // count * self.grid + cells.column // count
        inside = cells.row % count * count + cells.column % count
        return found[cells.picture, patch] * count**2 + inside

    def boxes(self) -> list[tuple[tuple[int, int], tuple[int, int]]]:
        """The first row of each picture's patches and the row after the last; so for the columns.

        Of a picture without patches it is the box of place 0. On CUDA the numbers are read back.
        """
        found = []
        for index in self.place.split(self.counts):
            own = index.tolist() or [0]
            sides = [place // self.grid for place in own], [place % self.grid for place in own]
            (top, bottom), (left, right) = ((min(side), max(side) + 1) for side in sides)
            found.append(((top, bottom), (left, right)))
        return found

    def orders(self, scan: Tensor) -> tuple[Tensor, Tensor]:
        """The tokens of these patches, in the order in which the network reads all of a picture.

        Args:
            scan: ``[O · grid²]`` int64, the place of each token's patch in O orders; see
                ``scan_orders``.

        Returns:
            ``[P O]`` int64, the tokens' numbers among all of a picture, picture by picture; and
            ``[P, O]`` int64, where in this list each patch has its token of each order.
        """
        total, device = self.grid**2, scan.device
        inside = torch.zeros(len(self.counts), total, dtype=torch.bool, device=device)
        inside[self.picture, self.place] = True
        inside = inside[:, scan]
        number = inside.flatten().cumsum(0).view_as(inside) - 1
        by_order = scan.view(-1, total)
        starts = total * torch.arange(len(by_order), device=device)[:, None]
        tokens = (by_order.argsort(1) + starts)[:, self.place].T
        return inside.nonzero()[:, 1], number[self.picture[:, None], tokens]


@dataclass
class Cells:
    """The cells of B pictures that see something of the object, T in all.

    They stand picture by picture, and row by row in a picture.

    Attributes:
        picture: ``[T]`` int64, the number of the picture.
        row: ``[T]`` int64, from the top.
        column: ``[T]`` int64, from the left.
        alpha: ``[T, 1]``, the cell's mean.
        color: ``[T, 3]``, the mean of the colours, weighted by alpha.
        counts: how many each picture has.
    """

    picture: Tensor
    row: Tensor
    column: Tensor
    alpha: Tensor
    color: Tensor
    counts: list[int]


def premultiplied(rgba: Tensor) -> Tensor:
    """``[B, H, W, 4]`` with straight alpha as ``[B, 4, H, W]`` with colours times alpha."""
    return torch.cat([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], -1).permute(0, 3, 1, 2)


def seen_cells(rgba: Tensor, side: int) -> Cells:
    """The cells in which a picture is not fully transparent.

    Args:
        rgba: ``[B, H, W, 4]`` in [0, 1], straight alpha, H = W.
        side: of a cell, pixels. On CUDA the numbers of cells are read back.
    """
    means = F.avg_pool2d(premultiplied(rgba), side).permute(0, 2, 3, 1)
    seen = means[..., 3] > 0
    own = means[seen]
    color = own[:, :3] / own[:, 3:].clamp_min(1e-3)
    picture, row, column = seen.nonzero().unbind(1)
    return Cells(picture, row, column, own[:, 3:], color, seen.sum((1, 2)).tolist())


def foreground_patches(alpha: Tensor, size: int, margin: int = 0) -> Patches:
    """The patches in which a picture is not fully transparent.

    Args:
        alpha: ``[B, H, W]`` in [0, 1], H = W.
        size: side of a patch, pixels.
        margin: patches around these that are kept too, >= 0.

    Returns:
        These patches; a picture may have none. On CUDA their numbers are read back.

    Raises:
        ValueError: a negative margin.
    """
    near = near_patches(alpha > 0, size, margin)
    picture, place = near.nonzero().unbind(1)
    return Patches(picture, place, near.sum(1).tolist(), alpha.shape[-1] // size, size)


def near_patches(seen: Tensor, size: int, margin: int) -> Tensor:
    """The patches that hold something, and those near such a patch.

    Args:
        seen: ``[B, H, W]`` bool, the pixels of the object.
        size: side of a patch, pixels.
        margin: how many patches near is, >= 0.

    Returns:
        ``[B, (H/size) · (W/size)]`` bool, row by row.

    Raises:
        ValueError: a negative margin.
    """
    if margin < 0:
        raise ValueError(f"background_margin is {margin}, it must be 0 or more")
    patches = F.max_pool2d(seen.float()[:, None], size)
    return F.max_pool2d(patches, 2 * margin + 1, stride=1, padding=margin).flatten(1) > 0
