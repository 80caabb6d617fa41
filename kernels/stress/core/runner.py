"""Draws cases, and makes failing ones small."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from random import Random

import torch

from .case import Case, Op, Outcome, run_case


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


def _size(op: Op, case: Case) -> float:
    """Measures how far the options are from plain; shrinking only ever lowers it."""
    pairs = [(case.options[name], plain) for name, plain in op.plain.items()]
    far = (abs(a - b) if type(a) in (int, float) else float(a != b) for a, b in pairs)
    return sum(far, float(case.kind != op.kinds[0]))


def shrink(
    op: Op, case: Case, device: torch.device, seconds: float = 30.0
) -> tuple[Case, Outcome, int]:
    """Looks greedily, for at most ``seconds``, for a smaller case that fails in the same way.

    Returns:
        The case, its outcome, and the number of cases tried.
    """
    outcome, tried, end = run_case(op, case, device), 0, time.monotonic() + seconds
    failure = outcome.failure() or {}
    improved = bool(failure)
    while improved:
        improved = False
        for name in ("kind", *op.plain):
            if name == "kind":
                simpler = [replace(case, kind=op.kinds[0])]
            else:  # the largest step towards the plain value first
                value, plain = case.options[name], op.plain[name]
                whole = type(value) is int
                steps = [plain, (value + plain) // 2, value - 1] if whole else [plain]
                options = [op.valid(case.options | {name: step}) for step in steps]
                simpler = [replace(case, options=o) for o in options]
            for candidate in simpler:
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
