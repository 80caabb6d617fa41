"""AdamW, the running average of the weights, and the schedules of a run."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from gamba_warp.errors import UserError
from gamba_warp.model.gamba import Gamba


def build_optimizer(model: Gamba, weight_decay: float, beta2: float) -> torch.optim.AdamW:
    """Makes AdamW with weight decay on the matrices that are not flagged ``_no_weight_decay``.

    The loop sets the learning rate before each step.
    """
    trained = [p for p in model.parameters() if p.requires_grad]
    decayed = [p for p in trained if p.ndim >= 2 and not getattr(p, "_no_weight_decay", False)]
    chosen = {id(p) for p in decayed}
    groups = [
        {"params": decayed, "weight_decay": weight_decay},
        {"params": [p for p in trained if id(p) not in chosen], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=0.0, betas=(0.9, beta2), fused=True)


def checked_moments(
    optimizer: torch.optim.AdamW, stored: dict[str, Any], source: Path
) -> dict[str, Any]:
    """Checks what an optimizer's ``state_dict`` gave a file against the optimizer itself.

    Args:
        optimizer: of the model that goes on.
        stored: the file's ``state_dict``. Its settings are not taken: they follow from the run's
            configuration, which must be the same.
        source: the file, for the error's message.

    Returns:
        What ``optimizer.load_state_dict`` takes.

    Raises:
        UserError: a moment is unknown, of another shape or kind, or not finite.
    """
    try:
        _check_moments(optimizer, stored.get("state"))
    except ValueError as error:
        raise UserError(f"{source}: damaged, {error}") from error
    return {"state": stored["state"], "param_groups": optimizer.state_dict()["param_groups"]}


def _check_moments(optimizer: torch.optim.AdamW, moments: object) -> None:
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    if not isinstance(moments, dict):
        raise ValueError("the optimizer has no state")
    for index, entry in moments.items():
        if type(index) is not int or not 0 <= index < len(parameters):
            raise ValueError(f"the optimizer has a state of parameter {str(index)[:40]!r}")
        names = set(entry) if isinstance(entry, dict) else set()
        if names != {"step", "exp_avg", "exp_avg_sq"}:
            raise ValueError(f"the optimizer's state of parameter {index} has other fields")
        shape = parameters[index].shape
        for name, value in entry.items():
            wanted = torch.Size() if name == "step" else shape
            if not isinstance(value, Tensor) or value.dtype != torch.float32:
                raise ValueError(f"{name} of parameter {index} is no float32 tensor")
            if value.shape != wanted:
                raise ValueError(f"{name} of parameter {index} is {tuple(value.shape)}")
            if not value.isfinite().all() or (name != "exp_avg" and bool((value < 0).any())):
                raise ValueError(f"{name} of parameter {index} is not finite, or negative")


class Ema:
    """A copy of the model whose weights are an exponential average of the trained ones.

    Attributes:
        model: the copy, in eval mode; a frozen encoder is shared, not copied.
        updates: number of updates so far, on which the decay depends (``ema_decay``).
    """

    def __init__(self, model: Gamba, decay: float) -> None:
        encoder = model.encoder
        shared = {id(encoder): encoder} if encoder is not None and encoder.frozen else {}
        self.model = copy.deepcopy(model, shared).eval()
        self.decay, self.updates = decay, 0
        pairs = zip(self.model.parameters(), model.parameters())
        self._pairs = [(average, weight) for average, weight in pairs if weight.requires_grad]
        for average, _ in self._pairs:
            average.requires_grad_(False)

    @torch.no_grad()
    def update(self) -> None:
        """Moves the average towards the model's present weights."""
        averages, weights = map(list, zip(*self._pairs))
        move = get_ema_multi_avg_fn(ema_decay(self.updates, self.decay))
        move(averages, weights, None)
        self.updates += 1


def learning_rate(step: float, total: float, base: float, warmup: float) -> float:
    """Returns the learning rate: a linear warm-up from 0, then a half cosine down to 0.

    Args:
        step: optimizer steps done, 0 to ``total``.
        total: steps of the whole run, > 0.
        base: peak value.
        warmup: steps of the rise; the first step has a rate above 0.
    """
    if step < warmup:
        return base * (step + 1) / (warmup + 1)
    progress = min(1.0, (step - warmup) / max(1e-12, total - warmup))
    return 0.5 * base * (1 + math.cos(math.pi * progress))


def novel_views(progress: float, first: int, last: int) -> int:
    """Returns the novel views per object, which grow evenly over the run (paper: 2 to 6).

    Args:
        progress: share of the run that is done, 0 to 1.
        first: number at the start.
        last: number at the end; if it is below ``first``, it holds for the whole run.
    """
    if last < first:
        return last
    return min(last, first + int(progress * (last - first + 1)))


def radial_weight(step: float, base: float, span: float) -> float:
    """Returns the radial mask constraint's weight, which falls from ``base`` to 0 in ``span``."""
    return base * max(0.0, 1.0 - step / span) if span > 0 else 0.0


def ema_decay(updates: int, decay: float) -> float:
    """Returns the running average's decay after ``updates`` updates; it grows up to ``decay``."""
    return min(decay, (1 + updates) / (10 + updates))
