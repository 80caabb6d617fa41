"""Counts of the work that a call did, computed only when somebody looks."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .autograd import bin_op
from .constants import TILE
from .projection import STATUS_NAMES, Projected
from .tiles import Bins, Limits, Saved, Size, Tiling


class Call(NamedTuple):
    """Arguments of a call: enough to make the lists again.

    Attributes:
        splats: the projection, without gradients.
        size: argument of ``composite``.
        limits: argument of ``composite``.
    """

    splats: Projected
    size: Size
    limits: Limits

    def tiling(self) -> Tiling:
        """The cut into tiles."""
        return Tiling(self.size.width, self.size.height)

    def bins(self) -> Bins:
        """The lists."""
        s, size = self.splats, self.size
        splats = s.means2d, s.conics, s.depths, s.view_opacities, s.extents
        numbers = size.width, size.height, self.limits.alpha_min, size.skip
        return Bins(*bin_op(*splats, *numbers))


class Meta(dict):
    """A dict; these keys are computed at the first look, as ints (which synchronises on CUDA).

    ``culled``: dict of counts of (view, Gaussian) by reason; ``pairs_box`` and ``pairs``: (tile,
    Gaussian) pairs without and with the exact test; ``pairs_traversed``: until every pixel of the
    tile had stopped; ``blocks_traversed``: 4 x 4 blocks of pixels evaluated for them;
    ``pairs_used``, ``blocks_used``, ``gaussians_used``: pairs, blocks, (view, Gaussian) that
    contributed; ``tiles`` and ``tiles_empty``; ``tiles_skipped``: traversed by no backward so far,
    being empty or without upstream gradient. The last one is None before a backward and under
    torch.compile.
    ``radii``, a tensor, is computed at the first look too.

    A key keeps its first value; after the replay of a CUDA graph ``bins.count``, a tensor, has the
    graph's number of pairs.

    Attributes:
        tiling: the cut into tiles with which the lists were made.
        bins: the lists themselves.
    """

    def __init__(self, call: Call, bins: Bins, saved: Saved, skipped: Tensor | None):
        super().__init__()
        self.tiling, self.bins, self._call = call.tiling(), bins, call
        self._saved, self._skipped = saved, skipped

    def __missing__(self, key: str):
        if key == "tiles_skipped":
            skipped = 0 if self._skipped is None else int((self._skipped == 1).sum())
            return skipped if skipped or self._skipped is not None and self._skipped.any() else None
        if key == "radii":
            self[key] = self._call.splats.extents.ceil().int()
            return self[key]
        if key not in _COUNTS:
            raise KeyError(key)
        self[key] = _COUNTS[key](self.bins, self._saved, self._call)
        return self[key]


def _culled(bins: Bins, saved: Saved, call: Call) -> dict[str, int]:
    status = call.splats.status.view(-1)
    counts = torch.bincount(status, minlength=len(STATUS_NAMES)).tolist()
    return dict(zip(STATUS_NAMES[1:], counts[1:]))


def _pairs_of_boxes(bins: Bins, saved: Saved, call: Call) -> int:
    # as the lists have them where tiles are not tested; rows have a pixel to spare
    means2d, extents = call.splats.means2d, call.splats.extents
    last = extents.new_tensor([call.size.width - 1, call.size.height - 1])
    spare = extents.new_tensor([0.0, 1.0])
    ends = [means2d - extents - spare, means2d + extents + spare]
    begin, end = (x.clamp(min=0).minimum(last).long() // TILE for x in ends)
    seen = extents[..., 0] > 0
    return int((end - begin + 1)[seen].prod(-1).sum())


_COUNTS: dict[str, Callable[[Bins, Saved, Call], Any]] = {
    "culled": _culled,
    "pairs_box": _pairs_of_boxes,
    "pairs": lambda bins, saved, call: int(bins.count),
    "pairs_traversed": lambda bins, saved, call: int(saved.traversed.sum(dtype=torch.int64)),
    "blocks_traversed": lambda bins, saved, call: int(saved.blocks_traversed.sum()),
    "blocks_used": lambda bins, saved, call: sum(
        int((saved.blocks >> b & 1).sum()) for b in range(16)
    ),
    "pairs_used": lambda bins, saved, call: int((saved.blocks != 0).sum()),
    "gaussians_used": lambda bins, saved, call: bins.pairs[saved.blocks != 0].unique().numel(),
    "tiles": lambda bins, saved, call: bins.starts.numel() - 1,
    "tiles_empty": lambda bins, saved, call: int((bins.starts.diff() == 0).sum()),
}
