"""Schedules: pure functions of the step or of the progress in [0, 1]."""

from __future__ import annotations

import math


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
