"""How the CPU kernels see their tensors: channels in lanes, tokens in chunks, work in tasks."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ...runtime.lanes import W

BLOCKS = 4  # lane groups whose dB and dC are one partial sum, whatever the number of threads
_SEGMENT = 4  # chunks of a segment at least


class Layout:
    """How channels map to lanes: D = groups × group_width, each group in blocks of W, padded.

    A task is a segment of one batch element's tokens and a span of blocks of one group. The blocks
    of a span are walked side by side, so that rows are read in long parts. Segments are for inputs
    with too few channels for torch's threads; finding their first states costs a second walk.
    """

    def __init__(self, u: Tensor, A: Tensor, B: Tensor, most: int, chunk: int, split: bool = True):
        """
        Args:
            u: ``[B, L, D]``.
            A: ``[D, N]``.
            B: ``[B, L, G, N]``.
            most: blocks of a span at most, a multiple of BLOCKS.
            chunk: tokens; a state is saved at the start of each chunk.
            split: whether there may be several segments.
        """
        self.batch, self.length, self.channels = u.shape
        self.states, self.groups = A.shape[1], B.shape[2]
        self.group_width = self.channels // self.groups
        self.group_blocks = -(-self.group_width // W)
        self.blocks = self.groups * self.group_blocks
        self.chunks = -(-self.length // chunk)
        threads = torch.get_num_threads()
        per_thread = max(1, min(self.group_blocks, -(-self.batch * self.blocks // threads)))
        self.span = min(most, -(-per_thread // BLOCKS) * BLOCKS)
        spans = self.batch * self.groups * -(-self.group_blocks // self.span)
        self.segments = 1
        if split and 0 < spans < threads:
            self.segments = max(1, min(-(-threads // spans), self.length // (_SEGMENT * chunk)))
        self.segment = max(1, -(-self.chunks // self.segments)) * chunk
        self.segments = max(1, -(-self.length // self.segment))
        self.tasks = self.segments * spans
        self.parts = self.batch * self.groups * -(-self.group_blocks // BLOCKS)

    def pack(self, x: Tensor | None, lead: tuple[int, ...] = ()) -> Tensor:
        """Brings ``[.., D, *]`` to float32 ``[.., blocks, *, W]``; None becomes zeros.

        The result may lie in the memory of ``x``.
        """
        if x is None:
            return torch.zeros(*lead, self.blocks, W)
        n = len(lead)
        tail, x = tuple(x.shape[n + 1 :]), x.float()
        if missing := self.group_blocks * W - self.group_width:
            x = x.reshape(*lead, self.groups, self.group_width, *tail)
            x = F.pad(x, (0, 0) * len(tail) + (0, missing))
        x = x.reshape(*lead, self.blocks, W, *tail)
        return x.movedim(n + 1, -1).contiguous()

    def unpack(self, x: Tensor, lead: tuple[int, ...] = ()) -> Tensor:
        """The inverse of ``pack``, dense, in the memory of ``x`` if that is its order."""
        n = len(lead)
        tail, x = tuple(x.shape[n + 1 : -1]), x.movedim(-1, n + 1)
        if self.group_blocks * W > self.group_width:
            x = x.reshape(*lead, self.groups, self.group_blocks * W, *tail)
            x = x.narrow(n + 1, 0, self.group_width)
        return x.reshape(*lead, self.channels, *tail).contiguous()

    def states_of(self, x: Tensor | None) -> Tensor:
        """Packs states ``[B, D, N]``, or None for 0, to ``[B, blocks, N, W]``."""
        if x is None:
            return torch.zeros(self.batch, self.blocks, self.states, W)
        return self.pack(x, (self.batch,))

    def total(self, parts: Tensor, dtype: torch.dtype) -> Tensor:
        """Sums ``[B·G·parts, N·L]`` over the parts of a group: ``[B, L, G, N]``."""
        of_group = -(-self.group_blocks // BLOCKS)
        x = parts.view(self.batch, self.groups, of_group, self.states, self.length).sum(2)
        return x.permute(0, 3, 1, 2).to(dtype, memory_format=torch.contiguous_format)
