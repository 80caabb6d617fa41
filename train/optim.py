"""AdamW's parameter groups and the running average of the weights."""

from __future__ import annotations

import copy
import math

import torch

from gamba_warp.model.gamba import Gamba


def build_optimizer(model: Gamba, weight_decay: float, beta2: float) -> torch.optim.AdamW:
    """AdamW with decay on matrices alone, not on those flagged ``_no_weight_decay``.

    The learning rate is set before each step by the loop.
    """
    trained = [p for p in model.parameters() if p.requires_grad]
    decayed = [p for p in trained if p.ndim >= 2 and not getattr(p, "_no_weight_decay", False)]
    chosen = {id(p) for p in decayed}
    groups = [
        {"params": decayed, "weight_decay": weight_decay},
        {"params": [p for p in trained if id(p) not in chosen], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=0.0, betas=(0.9, beta2), fused=True)


class Ema:
    """A copy of the model whose trained weights follow by exponential averaging.

    Attributes:
        model: the copy, in eval mode; a frozen encoder is shared, not copied.
        updates: number of updates so far; the decay is short at first (``ema_decay``).
    """

    def __init__(self, model: Gamba, decay: float) -> None:
        encoder = model.encoder
        shared = {id(encoder): encoder} if encoder is not None and encoder.frozen else {}
        self.model = copy.deepcopy(model, shared).eval()
        self.decay, self.updates = decay, 0
        pairs = [(a, b) for a, b in zip(self.model.parameters(), model.parameters())]
        self._pairs = [(a, b) for a, b in pairs if b.requires_grad]
        for average, _ in self._pairs:
            average.requires_grad_(False)

    @torch.no_grad()
    def update(self) -> None:
        """Moves the average towards the model's weights."""
        averages, weights = zip(*self._pairs)
        torch._foreach_lerp_(averages, weights, 1 - ema_decay(self.updates, self.decay))
        self.updates += 1


def learning_rate(step: float, total: float, base: float, warmup: float) -> float:
    """Linear warm-up from 0, then a half cosine down to 0.

    Args:
        step: optimizer steps done, 0 to ``total``.
        total: steps of the whole run, > 0.
        base: peak value.
        warmup: steps of the rise; the first step already moves.
    """
    if step < warmup:
        return base * (step + 1) / (warmup + 1)
    progress = min(1.0, (step - warmup) / max(1e-12, total - warmup))
    return 0.5 * base * (1 + math.cos(math.pi * progress))


def novel_views(progress: float, first: int, last: int) -> int:
    """Novel views per object: ``first`` to ``last`` in equal shares of the run (paper: 2 to 6)."""
    if last < first:
        return last
    return min(last, first + int(progress * (last - first + 1)))


def radial_weight(step: float, base: float, span: float) -> float:
    """Weight of the radial mask constraint: ``base``, falling linearly to 0 at ``span`` steps."""
    return base * max(0.0, 1.0 - step / span) if span > 0 else 0.0


def ema_decay(updates: int, decay: float) -> float:
    """Decay of the running average after ``updates`` updates: short at first, then ``decay``."""
    return min(decay, (1 + updates) / (10 + updates))
