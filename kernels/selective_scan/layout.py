"""How the CPU kernels see their tensors: channels in lanes, tokens in chunks."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from .lanes import W

CHUNK = 64  # tokens; a state is saved at the start of each chunk
BLOCKS = 4  # lane groups of a task; fixed, so that sums do not depend on the number of threads


class Layout:
    """How channels map to lanes: D = groups × group_width, each group in blocks of W, padded."""

    def __init__(self, u: Tensor, A: Tensor, B: Tensor):
        self.batch, self.length, self.channels = u.shape
        self.states, self.groups = A.shape[1], B.shape[2]
        self.group_width = self.channels // self.groups
        self.group_blocks = -(-self.group_width // W)
        self.parts = -(-self.group_blocks // BLOCKS)
        self.blocks = self.groups * self.group_blocks
        self.tasks = self.batch * self.groups * self.parts
        self.chunks = -(-self.length // CHUNK)

    def pack(self, x: Tensor | None, lead: tuple[int, ...] = ()) -> Tensor:
        """``[.., D, *]`` to float32 ``[.., blocks, *, W]``, a copy; None becomes zeros."""
        if x is None:
            return torch.zeros(*lead, self.blocks, W)
        n = len(lead)
        tail = tuple(x.shape[n + 1 :])
        x = x.float().reshape(*lead, self.groups, self.group_width, *tail)
        x = x.movedim(n + 1, -1)
        x = F.pad(x, (0, self.group_blocks * W - self.group_width))
        x = x.reshape(*lead, self.groups, *tail, self.group_blocks, W).movedim(-2, n + 1)
        return x.reshape(*lead, self.blocks, *tail, W).clone(memory_format=torch.contiguous_format)

    def unpack(self, x: Tensor, lead: tuple[int, ...] = ()) -> Tensor:
        """The inverse of ``pack``, dense."""
        n = len(lead)
        tail = tuple(x.shape[n + 1 : -1])
        x = x.reshape(*lead, self.groups, self.group_blocks, *tail, W).movedim(n + 1, -2)
        x = x.reshape(*lead, self.groups, *tail, self.group_blocks * W)
        x = x[..., : self.group_width].movedim(-1, n + 1)
        return x.reshape(*lead, self.channels, *tail).contiguous()

    def rows(self, x: Tensor) -> Tensor:
        """``[B, L, G, N]`` to float32 ``[B·G·N, L]``: the tokens of one state are adjacent."""
        rows = self.batch * self.groups * self.states
        return x.permute(0, 2, 3, 1).float().reshape(rows, self.length).contiguous()

    def total(self, parts: Tensor, dtype: torch.dtype) -> Tensor:
        """Sums ``[tasks, N, L]`` over the parts of a group: ``[B, L, G, N]``."""
        x = parts.view(self.batch, self.groups, self.parts, self.states, self.length).sum(2)
        return x.permute(0, 3, 1, 2).to(dtype, memory_format=torch.contiguous_format)
