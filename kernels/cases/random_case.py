"""A random case as plain data: its values, its run, and its comparison with float64."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .case import gradients_of
from .rounding import UNDERFLOW, UNIT

FACTOR = 8.0  # largest error, as a multiple of the effect of rounding on the formula
TRIALS = 5  # evaluations of a case that is over its limit, an odd number; most of them decide
STEEP_TRIALS = 50  # evaluations of a steep case
STEEP_RANGE = 8.0  # how far apart the limits of one result are by trial in such a case
# A result's dtype: its relative error, and its absolute error below its normal numbers.
_STORED = {
    torch.float32: (0.0, UNDERFLOW),
    torch.bfloat16: (2.0**-8, UNDERFLOW),
    torch.float16: (2.0**-11, 2.0**-25),
}

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
RANGES = (
    "normal", "uniform", "zeros", "ones", "alternating", "constant", "tiny", "denormal", "huge",
    "spread", "spikes",
)  # fmt: skip
COTANGENTS = ("normal", "normal", "ones", "spikes", "zeros")


class RandomCase(NamedTuple):
    """All that is needed to build the tensors again.

    Attributes:
        op: name of an ``Op``.
        kind: one of the op's kinds of extreme values.
        seed: seed of the values.
        options: sizes, dtype and switches by name; those not named are plain.
    """

    op: str
    kind: str
    seed: int
    options: dict[str, Any]


@dataclass(frozen=True)
class Comparison:
    """Comparison of one result with float64.

    Attributes:
        name: name of the result, such as "out" or "gradient of u".
        error: rms of the difference over rms of the exact values, of the whole tensor.
        ratio: error of the worst part over its limit; above 1 the result fails.
        nonfinite: count of numbers that are NaN or infinite where the dtype holds the exact value.
        counts: True to show ``error``, as for a float32 result whose exact values are well
            above numbers that may count as 0, and not itself the rounding error of a sum that
            cancels.
        noise: True if rounding changes the worst part by more than half of its exact value.
    """

    name: str
    error: float
    ratio: float
    nonfinite: int = 0
    counts: bool = True
    noise: bool = False


@dataclass
class Outcome:
    """Result of a case.

    Attributes:
        comparisons: comparisons, one per result.
        faults: everything else that is wrong, such as an exception or two runs that differ.
        pixels: number of pixels that were compared (rasterizer).
        undecided: number of those pixels in which rounding decides a cut or an order.
        steep: True to judge each result by the widest limit of many trials.
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

    @property
    def over(self) -> bool:
        """True if a result is over its limit and nothing else is wrong."""
        return (self.failure() or {}).get("what") == "limit"

    def failure(self) -> dict | None:
        """Return the failure's ``what``, ``name``, ``error`` and ``ratio``, or None.

        ``what`` is "fault", "not finite" or "limit".
        """
        nothing = {"error": None, "ratio": None}
        if self.faults:
            return {"what": "fault", "name": self.faults[0], **nothing}
        worst = self.worst
        if worst is None or worst.ratio <= 1:
            return None
        if bad := next((c for c in self.comparisons if c.nonfinite), None):
            return {"what": "not finite", "name": bad.name, **nothing}
        return {"what": "limit", "name": worst.name, "error": worst.error, "ratio": worst.ratio}


@dataclass(frozen=True)
class Op:
    """An operator, or a model, with its random cases.

    Attributes:
        name: name of the op.
        kinds: by kind of values, the options that it fixes: a value, or a tuple of values of which
            one is drawn. The first kind is the plain one.
        options: by name the values to draw from; the first is the plain one.
        fit: function that returns the nearest options that make sense together.
        evaluate: function that runs a case on a device; each trial has other random roundings.
    """

    name: str
    kinds: dict[str, dict[str, Any]]
    options: dict[str, Sequence[Any]]
    fit: Callable[[dict], dict]
    evaluate: Callable[[RandomCase, torch.device, int], Outcome]

    @property
    def plain(self) -> dict[str, Any]:
        """The simplest value of every option."""
        return {name: values[0] for name, values in self.options.items()}


def mostly(plain: Any, values: Sequence[Any]) -> tuple:
    """Return values with ``plain`` first, which is drawn in seven cases of ten."""
    return (plain,) * (7 * len(values) // 3) + (*values,)


def run_case(op: Op, case: RandomCase, device: torch.device) -> Outcome:
    """Run a case and turn an exception into a fault.

    A case that is over its limit is run ``TRIALS`` times, and the middle one of these counts. If it
    is steep, up to ``STEEP_TRIALS`` count, each result by its widest limit. README.md of
    kernels/stress says why.
    """
    case = case._replace(options=op.plain | case.options)
    try:
        outcomes = [op.evaluate(case, device, 0)]
        if not outcomes[0].over:
            return outcomes[0]
        outcomes += [op.evaluate(case, device, trial) for trial in range(1, TRIALS)]
        outcomes.sort(key=lambda o: o.worst.ratio if o.worst else 0.0)
        bad = next((o for o in outcomes if o.faults or o.nonfinite), None)
        by_result = list(zip(*(o.comparisons for o in outcomes)))
        steep = any(c.noise and c.ratio > 1 for results in by_result for c in results)
        for ratios in ([c.ratio for c in results] for results in by_result):
            steep |= max(ratios) > max(1.0, STEEP_RANGE * min(ratios))
        middle = outcomes[TRIALS // 2]
        if bad or not (middle.over and steep):
            return bad or middle
        least = replace(middle, steep=True)
        more = (op.evaluate(case, device, trial) for trial in range(TRIALS, STEEP_TRIALS))
        for other in chain(outcomes, more):
            if other.faults or other.nonfinite:
                return other
            pairs = zip(least.comparisons, other.comparisons)
            least.comparisons = [replace(c, ratio=min(c.ratio, o.ratio)) for c, o in pairs]
            if not least.over:
                break
        return least
    except Exception as error:
        text = str(error).strip().splitlines() or [""]
        return Outcome(faults=[f"{type(error).__name__}: {text[0]}"])


def generator(case: RandomCase, name: str) -> torch.Generator:
    """Make the source of chance for one tensor of a case, independent of its other tensors."""
    return torch.Generator().manual_seed(case.seed * 1009 + sum(name.encode()))


def fill(shape: Sequence[int], kind: str, g: torch.Generator) -> Tensor:
    """Draw float32 numbers of one of ``RANGES``.

    "alternating" changes sign along dimension 1, "tiny" is around 1e-12, "denormal" around 1e-40
    and "huge" around 1e4. "spread" is log-uniform in 1e-6..1e4 with either sign. "spikes" is 0,
    except for one number in sixteen, which is around 1e3.
    """
    normal = torch.randn(shape, generator=g)
    if kind == "uniform":
        return torch.rand(shape, generator=g)
    if kind == "spread":
        return normal.sign() * 10 ** (10 * torch.rand(shape, generator=g) - 6)
    if kind == "spikes":
        return 1e3 * normal * (torch.rand(shape, generator=g) < 1 / 16)
    if kind == "constant":
        return torch.full(shape, torch.randn((), generator=g).item())
    if kind in ("zeros", "ones", "alternating"):
        values = torch.full(shape, float(kind != "zeros"))
        if kind == "alternating" and len(shape) > 1:
            values[:, 1::2] = -1
        return values
    return normal * {"tiny": 1e-12, "denormal": 1e-40, "huge": 1e4}.get(kind, 1.0)


def fits(exact: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the mask of the exact values that a dtype holds; others may come out infinite."""
    return exact.detach().abs() < 0.99 * torch.finfo(dtype).max


def judge(
    name: str,
    got: Tensor,
    samples: Tensor,
    parts: tuple[int, ...],
    extra: Tensor | None = None,
    shown: Tensor | None = None,
) -> Comparison:
    """Compare a result with the samples of its formula; kernels/stress/README.md has the limit.

    Args:
        name: name of the result.
        got: the result, float dtype.
        samples: ``[SAMPLES, *got.shape]`` float64; sample 0 is exact.
        parts: dimensions of ``got`` that are taken together as one rms; () compares each number.
        extra: addition to the limit, of ``got``'s shape without ``parts``.
        shown: mask of the numbers that make up ``error``; the limit holds for all numbers.

    Raises:
        ValueError: the shapes do not fit.
    """
    samples, value = samples.detach(), got.detach().cpu().double()
    want = samples[0]
    if value.shape != want.shape:
        raise ValueError(f"{name} has shape {tuple(value.shape)}, not {tuple(want.shape)}")
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


class Runs:
    """Two runs of a case, their gradients, and the samples of the formula.

    Args:
        case: its option "cotangent" names the range of the cotangents.
        run: returns the results by name.
        leaves: tensors that need a gradient, by name.
        expected: the formula's results, and perhaps more, ``[SAMPLES, ..]``.
        samples: the formula's leaves.
        without: mask of the results that need no gradient.
    """

    def __init__(
        self,
        case: RandomCase,
        run: Callable[[], dict[str, Tensor]],
        leaves: dict[str, Tensor],
        expected: dict[str, Tensor],
        samples: dict[str, Tensor],
        without: Tensor | None = None,
    ) -> None:
        self.results, self.cotangents = run(), {}
        for n, x in self.results.items():
            v = fill(x.shape, case.options.get("cotangent", "normal"), generator(case, f"v_{n}"))
            v = v if without is None else torch.where(without, 0.0, v)
            self.cotangents[n] = v.to(x.dtype)
        self.grads = gradients_of(self.results, leaves, self.cotangents)
        again = run()
        others = gradients_of(again, leaves, self.cotangents)
        pairs = [(n, x, again[n]) for n, x in self.results.items()]
        pairs += [(f"gradient of {k}", g, others[k]) for k, g in self.grads.items()]
        self.faults = [
            f"two runs differ in {name}"
            for name, a, b in pairs
            if not torch.equal(a.nan_to_num(1.5), b.nan_to_num(1.5))
        ]
        self.expected = {n: expected[n] for n in self.results}
        self.expected_grads = gradients_of(self.expected, samples, self.cotangents)

    def outcome(self, parts: dict[str, tuple[int, ...]], **extra: dict[str, Any]) -> Outcome:
        """Judge all results, then all gradients.

        Args:
            parts: of ``judge`` by name; () without parts.
            extra: further arguments of ``judge`` by name of the result.
        """
        comparisons = [
            judge(n, x, self.expected[n], parts.get(n, ()), **extra.get(n, {}))
            for n, x in self.results.items()
        ]
        comparisons += [
            judge(f"gradient of {k}", g, self.expected_grads[k], parts.get(k, ()))
            for k, g in self.grads.items()
        ]
        return Outcome(comparisons, self.faults)
