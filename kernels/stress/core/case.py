"""A case as plain data, what running it found, and when that is a failure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import chain
from random import Random

import torch
from torch import Tensor

from .rounding import UNDERFLOW, UNIT

FACTOR = 8.0  # largest error, as a multiple of what rounding does to the formula
TRIALS = 5  # evaluations of a case that is over its limit, an odd number; most of them decide
STEEP_TRIALS = 50  # evaluations of a steep case
STEEP_RANGE = 8.0  # how far apart the limits of one result are by trial in such a case
# A result's dtype: its relative error, and its absolute error below its normal numbers.
_STORED = {
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
        kind: one of the op's kinds, which says what is hostile about the values.
        seed: seed of the values.
        options: sizes, dtype and switches as JSON values by name; the keys of the op's ``plain``.
    """

    op: str
    kind: str
    seed: int
    options: dict


@dataclass(frozen=True)
class Comparison:
    """One result compared with float64.

    Attributes:
        name: name of the result, such as "out" or "gradient of u".
        error: rms of the difference over rms of the truth, of the whole tensor.
        ratio: error of the worst part over its limit; above 1 the result fails.
        nonfinite: count of numbers that are NaN or infinite although the truth fits in the dtype.
        counts: whether ``error`` is shown. It is shown for a float32 result whose truth is well
            above what may count as 0, and is not itself the rounding error of a sum that cancels.
        noise: whether rounding changes the worst part by more than half of its truth.
    """

    name: str
    error: float
    ratio: float
    nonfinite: int = 0
    counts: bool = True
    noise: bool = False

    @property
    def is_gradient(self) -> bool:
        """Whether the result is a gradient, and not a forward result."""
        return self.name.startswith("gradient")


@dataclass
class Outcome:
    """What a case found.

    Attributes:
        comparisons: comparisons, one per result.
        faults: everything else that is wrong, such as an exception or two runs that differ.
        pixels: number of pixels that were compared (rasterizer).
        undecided: number of those pixels in which rounding decides a cut or an order.
        steep: whether each result is judged by the widest limit of many trials.
    """

    comparisons: list[Comparison] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    pixels: int = 0
    undecided: int = 0
    steep: bool = False

    @property
    def nonfinite(self) -> int:
        """The count of numbers that are not finite and should be."""
        return sum(c.nonfinite for c in self.comparisons)

    @property
    def worst(self) -> Comparison | None:
        """The comparison that is nearest to its limit, or farthest beyond it."""
        return max(self.comparisons, key=lambda c: c.ratio, default=None)

    def failure(self) -> dict | None:
        """Returns the failure's ``what``, ``name``, ``error`` and ``ratio``, or None.

        ``what`` is "fault", "not finite" or "limit".
        """
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
        name: name of the op.
        kinds: kinds of values; the first is the plain one.
        plain: simplest value of every option, at which the shrinking of a case aims.
        choices: allowed values of those options that are neither a number nor a switch.
        draw: function that draws random options for a kind.
        valid: function that returns the nearest options that make sense together.
        evaluate: function that runs a case on a device; each trial has other random roundings.
    """

    name: str
    kinds: tuple[str, ...]
    plain: dict
    choices: dict[str, tuple]
    draw: Callable[[Random, str], dict]
    valid: Callable[[dict], dict]
    evaluate: Callable[[Case, torch.device, int], Outcome]


def run_case(op: Op, case: Case, device: torch.device) -> Outcome:
    """Runs a case and turns an exception into a fault.

    A case that is over its limit is run ``TRIALS`` times, and the middle one of these counts. If it
    is steep, up to ``STEEP_TRIALS`` count, each result by its widest limit. README.md says why.
    """
    try:
        outcome = op.evaluate(case, device, 0)
        if not _over(outcome):
            return outcome
        found = [outcome, *(op.evaluate(case, device, trial) for trial in range(1, TRIALS))]
        found.sort(key=lambda o: o.worst.ratio if o.worst else 0.0)
        middle = found[TRIALS // 2]
        if bad := [o for o in found if o.faults or o.nonfinite]:
            return bad[0]
        steep = _over(middle) and _is_steep(found)
        return _widest(op, case, device, found) if steep else middle
    except Exception as error:
        text = str(error).strip().splitlines() or [""]
        return Outcome(faults=[f"{type(error).__name__}: {text[0]}"])


def _over(outcome: Outcome) -> bool:
    failure = outcome.failure()
    return failure is not None and failure["what"] == "limit"


def _is_steep(found: list[Outcome]) -> bool:
    """Whether a result that is over its limit is noise, or its limit differs much by trial."""
    ratios: dict[str, list[float]] = {}
    for c in (c for o in found for c in o.comparisons):
        if c.noise and c.ratio > 1:
            return True
        ratios.setdefault(c.name, []).append(c.ratio)
    return any(max(r) > max(1.0, STEEP_RANGE * min(r)) for r in ratios.values())


def _widest(op: Op, case: Case, device: torch.device, found: list[Outcome]) -> Outcome:
    """What is left over its widest limit, in the trials found and as many more as it takes."""
    least = replace(found[0], steep=True)
    more = (op.evaluate(case, device, trial) for trial in range(len(found), STEEP_TRIALS))
    for other in chain(found, more):
        if other.faults or other.nonfinite:
            return other
        ratios = {c.name: c.ratio for c in other.comparisons}
        least.comparisons = [
            replace(c, ratio=min(c.ratio, ratios[c.name])) for c in least.comparisons
        ]
        if not _over(least):
            break
    return least


def fitted(options: dict, sizes: tuple[str, ...], largest: int) -> dict:
    """Halves the largest of some sizes until their product is small enough; a 0 counts as 1.

    Args:
        options: of a case.
        sizes: names of options that are numbers.
        largest: product of the sizes, at most.
    """
    o = dict(options)
    while math.prod(max(1, o[name]) for name in sizes) > largest:
        widest = max(sizes, key=lambda name: o[name])
        o[widest] //= 2
    return o


def generator(case: Case, name: str) -> torch.Generator:
    """Makes the source of chance for one tensor of a case, independent of its other tensors."""
    return torch.Generator().manual_seed(case.seed * 1009 + sum(name.encode()))


def fits(truth: Tensor, dtype: torch.dtype) -> Tensor:
    """Which numbers of a truth a dtype holds for sure; beyond them a result may be infinite."""
    return truth.detach().abs() < 0.99 * torch.finfo(dtype).max


def judge(
    name: str,
    got: Tensor,
    samples: Tensor,
    parts: tuple[int, ...],
    extra: Tensor | None = None,
    shown: Tensor | None = None,
) -> Comparison:
    """Compares a result with the samples of its formula; README.md explains the limit.

    Args:
        name: name of the result.
        got: the result, float dtype.
        samples: ``[SAMPLES, *got.shape]`` float64; sample 0 is the truth.
        parts: dimensions of ``got`` that are taken together as one rms; () compares each number.
        extra: addition to the limit, of ``got``'s shape without ``parts``.
        shown: mask of the numbers that make up ``error``; the limit holds for all numbers.

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
    held = fits(want, got.dtype)
    nonfinite = int((held & ~value.isfinite()).sum())
    if nonfinite:
        return Comparison(name, math.inf, math.inf, nonfinite)

    def rms(x: Tensor) -> Tensor:
        x = torch.where(held, x, 0.0).nan_to_num(0.0, 0.0, 0.0)
        scale = x.abs().amax().clamp_min(1e-300) if x.numel() else 1.0  # squares must not underflow
        dims = tuple(d % want.dim() - want.dim() for d in parts)
        return (x / scale).square().mean(dims).sqrt() * scale if dims else x.abs()

    difference = value - want
    size = rms(want)
    by_rounding = rms(samples[1:] - want).amax(0)
    limit = FACTOR * by_rounding + (relative + FACTOR * UNIT) * size
    limit = limit + absolute * FACTOR + (0.0 if extra is None else extra)
    ratios = (rms(difference) / limit).flatten()
    worst = int(ratios.argmax())
    noise = bool((by_rounding > size / 2).flatten()[worst])
    parts = tuple(range(want.dim()))
    held = held if shown is None else held & shown
    total, spread = rms(want).item(), rms(samples[1:] - want).max().item()
    counts = got.dtype == torch.float32 and total > 1e-30 and spread < 1e-3 * total
    error = rms(difference).item() / total if total else 0.0
    return Comparison(name, error, ratios[worst].item(), 0, counts, noise)
