"""Counts of the work that a call did, computed only when somebody looks."""

import torch
from torch import Tensor

from .project import STATUS_NAMES
from .tiles import Bins, Tiling, Walk


class Meta(dict):
    """A dict; these keys are computed at the first look, as ints (which synchronises on CUDA).

    ``culled``: dict of counts of (view, Gaussian) by reason; ``pairs_box`` and ``pairs``: (tile,
    Gaussian) pairs without and with the exact test; ``pairs_walked``: until every pixel of the tile
    had stopped; ``blocks_walked``: 4 x 4 blocks of pixels evaluated for them; ``pairs_used``,
    ``blocks_used``, ``gaussians_used``: pairs, blocks, (view, Gaussian) that contributed;
    ``tiles`` and ``tiles_empty``; ``tiles_skipped``: not walked by the latest backward, being empty
    or without upstream gradient. The last one is None before a backward and under torch.compile.

    Attributes:
        tiling: the cut into tiles with which the lists were made.
        bins: the lists themselves.
    """

    def __init__(
        self, tiling: Tiling, bins: Bins, walk: Walk, status: Tensor, skipped: Tensor | None
    ):
        super().__init__()
        self.tiling, self.bins = tiling, bins
        self._walk, self._status, self._skipped = walk, status, skipped

    def __missing__(self, key: str):
        if key == "tiles_skipped":
            return None if self._skipped is None or self._skipped < 0 else int(self._skipped)
        counts = {
            "culled": self._culled,
            "pairs_box": lambda: int(self.bins.box_pairs),
            "pairs": lambda: self.bins.pairs.numel(),
            "pairs_walked": lambda: int(self._walk.walked.sum(dtype=torch.int64)),
            "blocks_walked": lambda: int(self._walk.blocks_walked.sum()),
            "blocks_used": self._blocks_used,
            "pairs_used": lambda: int((self._walk.blocks != 0).sum()),
            "gaussians_used": self._gaussians_used,
            "tiles": lambda: self.bins.starts.numel() - 1,
            "tiles_empty": lambda: int((self.bins.starts.diff() == 0).sum()),
        }
        if key not in counts:
            raise KeyError(key)
        self[key] = counts[key]()
        return self[key]

    def _culled(self) -> dict[str, int]:
        counts = torch.bincount(self._status.view(-1), minlength=len(STATUS_NAMES)).tolist()
        return dict(zip(STATUS_NAMES[1:], counts[1:]))

    def _blocks_used(self) -> int:
        blocks = self._walk.blocks
        return sum(int((blocks >> b & 1).sum()) for b in range(16))

    def _gaussians_used(self) -> int:
        return self.bins.pairs[self._walk.blocks != 0].unique().numel()
