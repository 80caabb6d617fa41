"""AdamW, the exponential moving average of the weights, and the schedules of a run."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from msgspec import Meta
from torch import Tensor

from gamba_warp.errors import UserError
from gamba_warp.model.gamba import Gamba

from .config import OptimConfig

# By name: the rate after the warm-up as a fraction of its peak. Arguments: the options, the step,
# the steps of the warm-up and of the run. A script may add to it (docs/train-your-own.md).
SCHEDULES: dict[str, Callable[[OptimConfig, float, float, float], float]] = {
    "cosine": lambda optim, step, warmup, total: _half_cosine(
        (step - warmup) / max(1e-12, total - warmup)
    ),
    "trapezoid": lambda optim, step, warmup, total: _clamped(
        (total - step) / (optim.decay_fraction * total)
    ),
}
WEIGHT_DECAY = 0.05  # paper, §4.1
BETAS = (0.9, 0.95)
FIRST_VIEWS, LAST_VIEWS = 2, 6  # novel views at the start and at the end (paper, §3.3)
# After a change of length, a learning rate below the fraction _LOW of the new schedule's first
# rises over the fraction _RISE of the remaining steps.
_LOW, _RISE = 0.1, 0.1


def build_optimizer(model: Gamba) -> torch.optim.AdamW:
    """Make AdamW, with weight decay on the matrices that are not flagged ``_no_weight_decay``.

    The loop sets the learning rate of each group before each step.

    Args:
        model: the model; parameters without gradient are left out.
    """
    parts: dict[bool, list[Tensor]] = {True: [], False: []}
    for p in model.parameters():
        if p.requires_grad:
            parts[p.ndim >= 2 and not getattr(p, "_no_weight_decay", False)].append(p)
    groups = [
        {"params": params, "weight_decay": WEIGHT_DECAY if decays else 0.0}
        for decays, params in parts.items()
        if params
    ]
    return torch.optim.AdamW(groups, lr=0.0, betas=BETAS, fused=True)


def checked_moments(
    optimizer: torch.optim.Optimizer, stored: dict[str, Any], source: Path
) -> dict[str, Any]:
    """Check the stored ``state_dict`` of an optimizer against the optimizer itself.

    Args:
        optimizer: of the resumed model.
        stored: the file's ``state_dict``. Its settings are ignored: they follow from the run's
            configuration, which must be the same.
        source: the file, for the error message.

    Returns:
        A state for ``optimizer.load_state_dict``.

    Raises:
        UserError: a moment is unknown, of the wrong shape or type, or not finite.
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    moments = stored.get("state")
    try:
        if not isinstance(moments, dict):
            raise ValueError("the optimizer has no state")
        for index, entry in moments.items():
            if type(index) is not int or not 0 <= index < len(parameters):
                raise ValueError(f"unknown parameter {str(index)[:40]!r} in the optimizer's state")
            names = set(entry) if isinstance(entry, dict) else set()
            if names != {"step", "exp_avg", "exp_avg_sq"}:
                raise ValueError(f"the optimizer's state of parameter {index} has other fields")
            for name, value in entry.items():
                wanted = torch.Size() if name == "step" else parameters[index].shape
                if not isinstance(value, Tensor) or value.dtype != torch.float32:
                    raise ValueError(f"{name} of parameter {index} is not a float32 tensor")
                if value.shape != wanted:
                    raise ValueError(f"{name} of parameter {index} has shape {tuple(value.shape)}")
                if not value.isfinite().all() or (name != "exp_avg" and bool((value < 0).any())):
                    raise ValueError(f"{name} of parameter {index} is not finite, or negative")
    except ValueError as error:
        raise UserError(f"{source}: damaged, {error}") from error
    return {"state": moments, "param_groups": optimizer.state_dict()["param_groups"]}


class Ema:
    """Copy of the model whose weights are an exponential moving average of the trained ones.

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

    def next_fraction(self) -> float:
        """Count an update, and return the fraction of the way that it takes, 1 - the decay."""
        fraction = 1 - ema_decay(self.updates, self.decay)
        self.updates += 1
        return fraction

    @torch.no_grad()
    def update(self, fraction: Tensor) -> None:
        """Move the average towards the model's current weights.

        Args:
            fraction: scalar on their device, the fraction of the way.
        """
        averages, weights = map(list, zip(*self._pairs))
        torch_ops: Any = torch  # the names of its optimizers' own products
        steps = torch_ops._foreach_sub(weights, averages)
        torch_ops._foreach_mul_(steps, fraction)
        torch_ops._foreach_add_(averages, steps)


def novel_views(progress: float) -> int:
    """Return the number of novel views per object, which grows evenly over the run.

    Args:
        progress: fraction of the run that is done, 0 to 1.
    """
    return min(LAST_VIEWS, FIRST_VIEWS + int(progress * (LAST_VIEWS - FIRST_VIEWS + 1)))


def ema_decay(updates: int, decay: float) -> float:
    """Return the moving average's decay after ``updates`` updates; it grows up to ``decay``."""
    return min(decay, (1 + updates) / (10 + updates))


@dataclass(frozen=True, kw_only=True)
class NewLength:
    """State of a run when it was last resumed with another length.

    Attributes:
        step: optimizer steps done; 0 if the length never changed.
        elapsed: seconds of training done.
        fraction: the learning rate then, as a fraction of its peak.
        rises: True if the rate first moves to the new length's own schedule.
    """

    step: Annotated[int, Meta(ge=0, le=10**12)] = 0
    elapsed: Annotated[float, Meta(ge=0, le=1e12)] = 0.0
    fraction: Annotated[float, Meta(ge=0, le=1)] = 1.0
    rises: bool = False


@dataclass(frozen=True)
class Schedule:
    """Learning rate over a run; continuous even if the run's length changes.

    Attributes:
        optim: the options.
        total: optimizer steps of the run, or None if only ``minutes`` limit it.
        minutes: training time of the run, if it is limited.
        since: last change of the length.
    """

    optim: OptimConfig
    total: int | None
    minutes: float | None
    since: NewLength = NewLength()

    def __post_init__(self) -> None:
        if (name := self.optim.schedule) not in SCHEDULES:
            raise UserError(f"--schedule {name[:60]}: expected one of {', '.join(SCHEDULES)}")

    def progress(self, step: int, elapsed: float) -> float:
        """Return the fraction of the run that is done, 0 to 1, by steps or else by the clock."""
        if self.total is not None:
            return min(1.0, step / self.total)
        assert self.minutes is not None  # a run without steps and epochs has minutes
        return min(1.0, elapsed / (60 * self.minutes))

    def fraction(self, step: int, elapsed: float) -> float:
        """Return the learning rate of the next step, as a fraction of its peak.

        Args:
            step: optimizer steps done.
            elapsed: seconds of training done.
        """
        total, began = self.total, float(self.since.step)
        if total is None:  # estimated from the speed so far
            total = step / max(self.progress(step, elapsed), 1e-6)
            total = max(total, self.optim.warmup_steps + 1)
            began = self.since.elapsed * step / max(elapsed, 1e-9)
        if not self.since.step:
            return self._planned(step, total)
        if total <= began:
            return self.since.fraction
        if self.optim.schedule not in ("cosine", "trapezoid"):
            return self._planned(step, total)
        if not self.since.rises:  # the rest of the fall, to 0 at the new end
            fraction, left = self.since.fraction, (total - step) / (total - began)
            if self.optim.schedule == "trapezoid":
                falls = min(self.optim.decay_fraction * total, total - began)
                return fraction * _clamped((total - step) / falls)
            phase = math.acos(2 * fraction - 1) / math.pi
            return _half_cosine(1 - (1 - phase) * left)
        rise = min(1.0, (step - began + 1) / (_RISE * (total - began) + 1))
        return self.since.fraction + rise * (self._planned(step, total) - self.since.fraction)

    def _planned(self, step: float, total: float) -> float:
        """Rate of a run whose length never changed."""
        warmup = self.optim.warmup_steps
        if self.total is not None:
            warmup = min(warmup, 0.1 * total)
        if step < warmup:
            return (step + 1) / (warmup + 1)
        return SCHEDULES[self.optim.schedule](self.optim, step, warmup, total)

    def after(self, old: Schedule, step: int, elapsed: float) -> tuple[Schedule, str | None]:
        """Continue a run, possibly of another length.

        Args:
            old: the schedule so far.
            step: optimizer steps done.
            elapsed: seconds of training done.

        Returns:
            The schedule from here on, and a line about it if the length changed.
        """
        if (self.total, self.total or self.minutes) == (old.total, old.total or old.minutes):
            return replace(self, since=old.since), None
        fraction, planned = old.fraction(step, elapsed), replace(self, since=NewLength())
        wanted = planned.fraction(step, elapsed)
        rises = step < self.optim.warmup_steps or fraction < _LOW * wanted
        since = NewLength(step=step, elapsed=elapsed, fraction=fraction, rises=rises)
        rates = [f"{self.optim.lr * value:.3g}" for value in (fraction, wanted)]
        text = f"the run's length is now {self}, not {old}: the rate continues from {rates[0]}"
        if rises:
            text += f", goes to {rates[1]}, the new length's own, in a tenth of the rest,"
        text = f"{text} and falls to 0 at the end"
        over = self.progress(step, elapsed) >= 1  # the run is over: no message
        return replace(self, since=since), None if over else text

    def __str__(self) -> str:
        return f"{self.total} steps" if self.total is not None else f"{self.minutes:g} minutes"


def _half_cosine(phase: float) -> float:
    return 0.5 * (1 + math.cos(math.pi * _clamped(phase)))


def _clamped(value: float) -> float:
    return min(1.0, max(0.0, value))
