"""Which patches of a picture are computed: those that see something of the object."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

# What one more pass through the network costs on a CPU, in patches of a batch.
PASS_COST = 60


@dataclass
class Patches:
    """F patches of each picture; the others are plain background, and nothing is computed of them.

    Attributes:
        index: ``[B, F]`` int64, places in the row-major grid, ascending. A picture that has fewer
            than F patches is filled up with places that mean nothing.
        valid: ``[B, F]`` bool, False for the filling, which comes last.
        grid: patches a side.
        size: side of a patch, pixels.
    """

    index: Tensor
    valid: Tensor
    grid: int
    size: int

    def cells(self, maps: Tensor, count: int) -> Tensor:
        """Cuts maps into the cells of the patches.

        Args:
            maps: ``[B, C, n, n]``, n = grid · count.
            count: cells a side of a patch.

        Returns:
            ``[B, F, count², C]``, the cells of a patch row by row.
        """
        batch, channels = maps.shape[:2]
        maps = maps.reshape(batch, channels, self.grid, count, self.grid, count)
        maps = maps.permute(0, 2, 4, 3, 5, 1).reshape(batch, self.grid**2, -1)
        index = self.index[..., None].expand(-1, -1, maps.shape[-1])
        return maps.gather(1, index).unflatten(-1, (count**2, channels))

    def number(self, cells: Cells, count: int) -> Tensor:
        """Where cells are among those of all valid patches, picture by picture: ``[T]`` int64.

        Args:
            cells: cells in these patches.
            count: cells a side of a patch; within a patch they are counted row by row.
        """
        order = self.valid.flatten().cumsum(0) - 1
        found = torch.zeros(len(self.index), self.grid**2, dtype=torch.int64, device=order.device)
        found = found.scatter(1, self.index, order.view_as(self.index))
        patch = cells.row // count * self.grid + cells.column // count
        inside = cells.row % count * count + cells.column % count
        return found[cells.picture, patch] * count**2 + inside

    def groups(self) -> list[list[int]]:
        """Pictures of like sizes, which a CPU computes together with least filling.

        Sorted by their numbers of patches, the pictures are cut where all patches, fillings and
        ``PASS_COST`` for each group included, are fewest. On CUDA the numbers are read back.
        """
        counts = self.valid.sum(1).tolist()
        order = sorted(range(len(counts)), key=lambda picture: counts[picture])
        best: list[tuple[int, int]] = [(0, 0)]  # of the first pictures: cost, start of the last cut
        for end in range(1, len(order) + 1):
            most = counts[order[end - 1]]
            costs = [best[i][0] + (end - i) * most + PASS_COST for i in range(end)]
            start = min(range(end), key=costs.__getitem__)
            best.append((costs[start], start))
        found, end = [], len(order)
        while end:
            found.append(order[best[end][1] : end])
            end = best[end][1]
        return found[::-1]

    def of(self, pictures: list[int]) -> Patches:
        """The patches of some of the pictures, with no more filling than these need."""
        valid = self.valid[pictures]
        most = int(valid.sum(1).max())
        return Patches(self.index[pictures, :most], valid[:, :most], self.grid, self.size)

    def boxes(self) -> list[tuple[tuple[int, int], tuple[int, int]]]:
        """The first row of each picture's patches and the row after the last; so for the columns.

        Of a picture without patches it is the box of place 0. On CUDA the numbers are read back.
        """
        found = []
        for index, valid in zip(self.index, self.valid):
            own = index[valid].tolist() or [0]
            sides = [place // self.grid for place in own], [place % self.grid for place in own]
            (top, bottom), (left, right) = ((min(side), max(side) + 1) for side in sides)
            found.append(((top, bottom), (left, right)))
        return found

    def orders(self, scan: Tensor) -> tuple[Tensor, Tensor]:
        """The tokens of these patches, in the order in which the network reads all tokens.

        A picture's own tokens come first, so what fills up the batch is never seen by them.

        Args:
            scan: ``[O · grid²]`` int64, the place of each token's patch in O orders; see
                ``scan_orders``.

        Returns:
            ``[B, OF]`` int64, the tokens' numbers among all; and ``[B, F, O]`` int64, where in this
            list each patch has its token of each order.
        """
        batch, total = len(self.index), self.grid**2
        orders = len(scan) // total
        inside = self.valid.new_zeros(batch, total)
        inside = inside.scatter_reduce(1, self.index, self.valid, "amax")[:, scan]
        kept = torch.argsort(~inside, dim=1, stable=True)[:, : orders * self.index.shape[1]]
        places = inside.cumsum(1) - 1  # in the list, of each token that is in it
        starts = total * torch.arange(orders, device=scan.device)[:, None]
        tokens = (
            torch.argsort(scan.view(orders, total), dim=1) + starts
        )  # of a place, in each order
        found = places.gather(1, tokens[:, self.index].permute(1, 2, 0).flatten(1))
        found = found.unflatten(1, (-1, orders))
        return kept, torch.where(self.valid[..., None], found, 0)


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
        F is the largest number of a picture in the batch; it may be 0. On CUDA the number is read
        back.

    Raises:
        ValueError: a negative margin.
    """
    near = near_patches(alpha > 0, size, margin)
    counts = near.sum(1)
    most = int(counts.max()) if len(counts) else 0
    index = torch.argsort(~near, dim=1, stable=True)[:, :most]
    valid = torch.arange(most, device=alpha.device) < counts[:, None]
    return Patches(index, valid, alpha.shape[-1] // size, size)


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
