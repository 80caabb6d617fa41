"""Draws cases, runs and counts them, and makes failing cases small."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from random import Random

import torch

from .case import Case, Comparison, Op, Outcome, run_case


def draw_cases(ops: Sequence[Op], seed: int) -> Iterator[tuple[Op, Case]]:
    """Draws cases endlessly, the same ones for the same ops and seed; ops and kinds take turns."""
    count = 0
    while True:
        op = ops[count % len(ops)]
        kind = op.kinds[count // len(ops) % len(op.kinds)]
        rng = Random(f"{seed} {op.name} {count}")
        options = op.draw(rng, kind)
        yield op, Case(op.name, kind, rng.randrange(2**31), options)
        count += 1


@dataclass
class Row:
    """What the cases of one kind found so far.

    Attributes:
        op: name of the op.
        kind: kind of values.
        cases: number of cases that were run.
        forward: largest relative rms error of a forward result in float32, and its name.
        gradient: largest relative rms error of a gradient, and its name.
        ratio: largest error over its limit; infinite if something was not finite.
        nonfinite: count of numbers that are not finite and should be.
        failures: number of cases that failed in any way.
        pixels: number of pixels compared (rasterizer).
        undecided: number of those pixels in which rounding decides a cut or an order.
        steep: number of cases that are judged by the widest limit of many trials.
        seconds: time spent.
    """

    op: str
    kind: str
    cases: int = 0
    forward: tuple[float, str] = (0.0, "")
    gradient: tuple[float, str] = (0.0, "")
    ratio: float = 0.0
    nonfinite: int = 0
    failures: int = 0
    pixels: int = 0
    undecided: int = 0
    steep: int = 0
    seconds: float = 0.0

    def add(self, outcome: Outcome, seconds: float) -> None:
        """Counts one case."""
        self.cases += 1
        self.seconds += seconds
        self.nonfinite += outcome.nonfinite
        self.failures += outcome.failure() is not None
        self.pixels += outcome.pixels
        self.undecided += outcome.undecided
        self.steep += outcome.steep
        for c in outcome.comparisons:
            self.ratio = max(self.ratio, c.ratio)
            if c.is_gradient:
                self.gradient = max(self.gradient, _entry(c))
            else:
                self.forward = max(self.forward, _entry(c))


_COUNTS = ("cases", "nonfinite", "failures", "pixels", "undecided", "steep", "seconds")


def _entry(c: Comparison) -> tuple[float, str]:
    return (c.error, c.name) if c.counts else (0.0, "")


class Tally:
    """Rows by op and kind, in the order in which they first appeared."""

    def __init__(self) -> None:
        self.rows: dict[tuple[str, str], Row] = {}

    def add(self, case: Case, outcome: Outcome, seconds: float) -> None:
        """Counts one case."""
        key = case.op, case.kind
        self.rows.setdefault(key, Row(*key)).add(outcome, seconds)

    def sorted(self) -> list[Row]:
        """Returns all rows, with those of an op together."""
        ops = list(dict.fromkeys(op for op, _ in self.rows))
        return sorted(self.rows.values(), key=lambda row: ops.index(row.op))

    def totals(self) -> list[Row]:
        """Returns one row per op, of kind "all"."""
        made: dict[str, Row] = {}
        for row in self.rows.values():
            total = made.setdefault(row.op, Row(row.op, "all"))
            for name in _COUNTS:
                setattr(total, name, getattr(total, name) + getattr(row, name))
            for name in ("forward", "gradient", "ratio"):
                setattr(total, name, max(getattr(total, name), getattr(row, name)))
        return list(made.values())


def run_cases(
    ops: Sequence[Op],
    seed: int,
    device: torch.device,
    *,
    count: int | None = None,
    seconds: float = math.inf,
) -> Iterator[tuple[Op, Case, Outcome, float]]:
    """Runs ``count`` cases, or as many as fit in ``seconds``; yields each with its own seconds."""
    end = time.monotonic() + seconds
    for index, (op, case) in enumerate(draw_cases(ops, seed)):
        begin = time.monotonic()
        if index == count or begin >= end:
            return
        yield op, case, run_case(op, case, device), time.monotonic() - begin


def _simpler(op: Op, case: Case, name: str) -> Iterator[Case]:
    """Yields cases with one option (or "kind") nearer to its plain value, largest step first."""
    if name == "kind":
        if case.kind != op.kinds[0]:
            yield replace(case, kind=op.kinds[0])
        return
    value, plain = case.options[name], op.plain[name]
    steps = [plain]
    if isinstance(value, int) and not isinstance(value, bool):
        steps += [(value + plain) // 2, value - 1]
    for step in steps:
        if step != value:
            yield replace(case, options=op.valid(case.options | {name: step}))


def _size(op: Op, case: Case) -> float:
    """Measures how far the options are from plain; shrinking only ever lowers it."""
    far = float(case.kind != op.kinds[0])
    for name, plain in op.plain.items():
        value = case.options[name]
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        far += abs(value - plain) if number else value != plain
    return far


def shrink(
    op: Op, case: Case, device: torch.device, seconds: float = 30.0
) -> tuple[Case, Outcome, int]:
    """Looks greedily, for at most ``seconds``, for a smaller case that fails in the same way.

    Returns:
        The case, its outcome, and the number of cases tried.
    """
    outcome = run_case(op, case, device)
    failure, tried = outcome.failure(), 0
    end = time.monotonic() + seconds
    if failure is None:
        return case, outcome, tried
    improved = True
    while improved:
        improved = False
        for name in ("kind", *op.plain):
            for candidate in _simpler(op, case, name):
                if time.monotonic() >= end:
                    return case, outcome, tried
                if _size(op, candidate) >= _size(op, case):
                    continue
                tried += 1
                found = run_case(op, candidate, device)
                other = found.failure()
                if other is not None and other["what"] == failure["what"]:
                    case, outcome, improved = candidate, found, True
                    break
    return case, outcome, tried
