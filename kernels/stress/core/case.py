"""A case as plain data, what running it found, and when that is a failure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

import torch
from torch import Tensor

from .rounding import UNDERFLOW, UNIT

FACTOR = 8.0  # how often an error may be what rounding does to the formula
_STORED = {  # of a result: relative error of its dtype, absolute error below its normal numbers
    torch.float32: (0.0, UNDERFLOW),
    torch.bfloat16: (2.0**-8, UNDERFLOW),
    torch.float16: (2.0**-11, 2.0**-25),
}
DTYPES = {str(d).removeprefix("torch."): d for d in _STORED}


@dataclass(frozen=True)
class Case:
    """All that is needed to build the tensors again.

    Attributes:
        op: name of an ``Op``.
        kind: one of the op's kinds: what is hostile about the values.
        seed: of the values.
        options: JSON values by name: sizes, dtype, switches; the keys of the op's ``plain``.
    """

    op: str
    kind: str
    seed: int
    options: dict


@dataclass(frozen=True)
class Comparison:
    """One result against float64.

    Attributes:
        name: "out", "gradient of u", ...
        error: rms of the difference over rms of the truth, of the whole tensor.
        ratio: of the worst part: its error over its limit; a failure above 1.
        nonfinite: numbers that are NaN or infinite where the truth fits in the dtype.
        counts: whether ``error`` is shown: of a float32 result, whose truth is well above what may
            count as 0 and is not itself what rounding leaves of a sum that cancels.
    """

    name: str
    error: float
    ratio: float
    nonfinite: int = 0
    counts: bool = True

    @property
    def is_gradient(self) -> bool:
        """Whether it counts as a gradient or as the forward result."""
        return self.name.startswith("gradient")


@dataclass
class Outcome:
    """What a case found.

    Attributes:
        comparisons: one for each result.
        faults: what is wrong otherwise: an exception, two runs that differ.
        pixels: that were compared (rasterizer).
        undecided: of them, those where rounding decides a cut or an order.
    """

    comparisons: list[Comparison] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    pixels: int = 0
    undecided: int = 0

    @property
    def nonfinite(self) -> int:
        """How many numbers are not finite that should be."""
        return sum(c.nonfinite for c in self.comparisons)

    @property
    def worst(self) -> Comparison | None:
        """The comparison that is nearest to its limit, or farthest beyond."""
        return max(self.comparisons, key=lambda c: c.ratio, default=None)

    def failure(self) -> dict | None:
        """``what`` ("fault", "not finite" or "limit"), ``name``, ``error``, ``ratio``; or None."""
        if self.faults:
            return {"what": "fault", "name": self.faults[0], "error": None, "ratio": None}
        worst = self.worst
        if worst is None or worst.ratio <= 1:
            return None
        bad = next((c for c in self.comparisons if c.nonfinite), None)
        if bad:
            return {"what": "not finite", "name": bad.name, "error": None, "ratio": None}
        return {"what": "limit", "name": worst.name, "error": worst.error, "ratio": worst.ratio}


@dataclass(frozen=True)
class Op:
    """Something to be stressed.

    Attributes:
        name: of the op.
        kinds: of values; the first is the plain one.
        plain: every option at its simplest; a shrinking case goes there.
        choices: what an option may be, where that is not any number or switch.
        draw: random options for a kind.
        valid: the nearest options that make sense, for options changed one at a time.
        evaluate: runs a case on a device.
    """

    name: str
    kinds: tuple[str, ...]
    plain: dict
    choices: dict[str, tuple]
    draw: Callable[[Random, str], dict]
    valid: Callable[[dict], dict]
    evaluate: Callable[[Case, torch.device], Outcome]


def run_case(op: Op, case: Case, device: torch.device) -> Outcome:
    """Runs a case; an exception becomes a fault."""
    try:
        return op.evaluate(case, device)
    except Exception as error:
        text = str(error).strip().splitlines() or [""]
        return Outcome(faults=[f"{type(error).__name__}: {text[0]}"])


def generator(case: Case, name: str) -> torch.Generator:
    """Random numbers for one tensor of a case, whatever else the case holds."""
    return torch.Generator().manual_seed(case.seed * 1009 + sum(name.encode()))


def judge(
    name: str,
    got: Tensor,
    samples: Tensor,
    parts: tuple[int, ...],
    extra: Tensor | None = None,
    shown: Tensor | None = None,
) -> Comparison:
    """Compares a result with the samples of its formula; README.md says what the limit means.

    Args:
        name: of the result.
        got: the result, float dtype.
        samples: ``[SAMPLES, *got.shape]`` float64; sample 0 is the truth.
        parts: dimensions of ``got`` that are taken together, as one rms; () compares each number.
        extra: added to the limit, of ``got``'s shape without ``parts``.
        shown: which numbers make up ``error``; the limit holds for all.

    Raises:
        ValueError: the shapes do not fit.
    """
    samples, value = samples.detach(), got.detach().cpu().double()
    want = samples[0]
    if value.shape != want.shape:
        raise ValueError(f"{name} has shape {tuple(value.shape)}, the truth {tuple(want.shape)}")
    if not want.numel():
        return Comparison(name, 0.0, 0.0)
    relative, absolute = _STORED[got.dtype]
    fits = want.abs() < 0.99 * torch.finfo(got.dtype).max
    nonfinite = int((fits & ~value.isfinite()).sum())
    if nonfinite:
        return Comparison(name, math.inf, math.inf, nonfinite)

    def rms(x: Tensor) -> Tensor:
        x = torch.where(fits, x, 0.0).nan_to_num(0.0, 0.0, 0.0)
        scale = x.abs().amax().clamp_min(1e-300) if x.numel() else 1.0  # squares must not underflow
        dims = tuple(d % want.dim() - want.dim() for d in parts)
        return (x / scale).square().mean(dims).sqrt() * scale if dims else x.abs()

    difference = value - want
    size = rms(want)
    limit = FACTOR * rms(samples[1:] - want).amax(0) + (relative + FACTOR * UNIT) * size
    limit = limit + absolute * FACTOR + (0.0 if extra is None else extra)
    ratio = (rms(difference) / limit).max().item()
    parts = tuple(range(want.dim()))
    fits = fits if shown is None else fits & shown
    total, spread = rms(want).item(), rms(samples[1:] - want).max().item()
    counts = got.dtype == torch.float32 and total > 1e-30 and spread < 1e-3 * total
    return Comparison(name, rms(difference).item() / total if total else 0.0, ratio, 0, counts)
