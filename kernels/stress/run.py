"""A run of random cases, which the library hypothesis draws and, if they fail, makes smaller."""

from __future__ import annotations

import math
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from typing import Any

import torch
from hypothesis import HealthCheck, Phase, Verbosity, given, seed, settings
from hypothesis import strategies as st
from hypothesis.configuration import set_hypothesis_home_dir

from gamba_warp.versions import __version__, installed

from ..cases.random_case import Op, Outcome, RandomCase, run_case
from ..runtime.tables import markdown

_SLICE = 10.0  # seconds for an operator before the next one has its turn
_SHRINK = 30.0  # seconds for shrinking a failing case
_HEAD = (
    *("op", "kind", "cases", "forward error", "of", "gradient error", "of", "error / limit"),
    *("undecided pixels", "steep", "non-finite", "failures"),
)
_NOTHING = {"error": 0.0, "of": ""}


class _Stop(BaseException):
    """Raised in a case when time is up; hypothesis catches only ``Exception``."""


# Hypothesis makes a case smaller as long as the type of its failure stays the same.
_FAILURES = {what: type(what, (AssertionError,), {}) for what in ("fault", "not finite", "limit")}


def cases_of(op: Op) -> st.SearchStrategy[RandomCase]:
    """Return the strategy of an op's cases; the simplest has plain options and seed 0."""

    @st.composite
    def draw_case(draw: st.DrawFn) -> RandomCase:
        kind = draw(st.sampled_from([*op.kinds]))
        options = {name: draw(st.sampled_from(values)) for name, values in op.options.items()}
        for name, value in op.kinds[kind].items():
            options[name] = draw(st.sampled_from(value)) if isinstance(value, tuple) else value
        return RandomCase(op.name, kind, draw(st.integers(0, 2**31 - 1)), op.fit(options))

    return draw_case()


def _row(op: str, kind: str, results: Sequence[tuple[RandomCase, Outcome, float]]) -> dict:
    """Return a row of results; the kind "all" means all kinds of an op.

    It has the largest relative rms errors of a float32 result and of a gradient with their names;
    the largest error over its limit, infinite if something was not finite; and sums of values
    defined by ``Outcome``.
    """
    outcomes = [outcome for _, outcome, _ in results]
    comparisons = [comparison for outcome in outcomes for comparison in outcome.comparisons]

    def worst(of_gradient: bool) -> dict:
        shown = [
            c for c in comparisons if c.counts and c.name.startswith("gradient") == of_gradient
        ]
        most = max(shown, key=lambda c: c.error, default=None)
        return {"error": most.error, "of": most.name} if most and most.error else dict(_NOTHING)

    return {
        "op": op,
        "kind": kind,
        "cases": len(results),
        "nonfinite": sum(o.nonfinite for o in outcomes),
        "failures": sum(o.failure() is not None for o in outcomes),
        "pixels": sum(o.pixels for o in outcomes),
        "undecided": sum(o.undecided for o in outcomes),
        "steep": sum(o.steep for o in outcomes),
        "seconds": sum(seconds for _, _, seconds in results),
        "ratio": max((c.ratio for c in comparisons), default=0.0),
        "forward": worst(False),
        "gradient": worst(True),
    }


def _plain(value: Any) -> Any:
    """Replace numbers that are not finite, which JSON cannot hold, by None."""
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _table(rows: Sequence[dict]) -> str:
    def cells(r: dict) -> Iterator[str]:
        yield from (r["op"], r["kind"], str(r["cases"]))
        for found in (r["forward"], r["gradient"]):
            yield f"{found['error']:.1e}" if found["error"] else "0"
            yield found["of"].removeprefix("gradient of ")
        yield f"{r['ratio']:.2f}"
        yield f"{r['undecided'] / r['pixels']:.2%}" if r["pixels"] else ""
        yield from (str(r[name]) for name in ("steep", "nonfinite", "failures"))

    return markdown(_HEAD, [[*cells(row)] for row in rows], aligned=True)


class StressRun:
    """One run: its rows, and its failures.

    Attributes:
        about: description of the run; "interrupted" is True after Ctrl-C.
        failures: a line of text and the case of each failure.

    Args:
        ops: the tested operators.
        device: of the kernels.
        seed: the same seed gives the same cases in the same order.
    """

    def __init__(self, ops: Sequence[Op], device: torch.device, seed: int) -> None:
        self._ops, self._device = ops, device
        versions = {"gamba_warp": __version__} | installed("torch", "warp-lang")
        self.about = {"seed": seed, "device": str(device), **versions, "interrupted": False}
        self._results: list[tuple[RandomCase, Outcome, float]] = []
        self._worst = 0.0  # error over its limit
        self.failures: list[dict] = []

    def run(
        self, cases: int | None, seconds: float, say: Callable[[str], None] = lambda text: None
    ) -> None:
        """Run cases until their number, the time limit or Ctrl-C.

        Operators take turns; one that fails has no more turns.

        Args:
            cases: of each operator; None for no limit.
            seconds: may be infinite.
            say: function that gets the state of the run after each case.
        """
        began, home = time.monotonic(), tempfile.TemporaryDirectory()
        set_hypothesis_home_dir(home.name)  # else it makes a folder in the current one
        try:
            ops, slice_ = self._ops, math.inf if cases else min(_SLICE, seconds / len(self._ops))
            for turn in count():
                for op in ops:
                    now = time.monotonic()
                    if now - began >= seconds:
                        return
                    self._take_turn(op, turn, cases, min(began + seconds, now + slice_), say)
                failed = {failure["case"]["op"] for failure in self.failures}
                ops = [op for op in ops if op.name not in failed]
                if cases or not ops:
                    return
        except KeyboardInterrupt:
            self.about["interrupted"] = True
        finally:
            set_hypothesis_home_dir(None)
            home.cleanup()
            self.about["minutes"] = round((time.monotonic() - began) / 60, 2)

    def _take_turn(
        self, op: Op, turn: int, cases: int | None, until: float, say: Callable[[str], None]
    ) -> None:
        found: list[
            tuple[RandomCase, Outcome]
        ] = []  # failing ones, each smaller than the one before

        def check(case: RandomCase) -> None:
            nonlocal until
            if time.monotonic() >= until:
                raise _Stop
            started = time.monotonic()
            outcome = run_case(op, case, self._device)
            if not found:
                self._results.append((case, outcome, time.monotonic() - started))
                ratio = outcome.worst.ratio if outcome.worst else 0.0
                self._worst = max(self._worst, ratio)
            if failure := outcome.failure():
                if not found:
                    until = time.monotonic() + _SHRINK
                found.append((case, outcome))
                say("shrinking a failing case")
                raise _FAILURES[failure["what"]]
            say(f"worst {self._worst:.2f} of its limit")

        options = settings(
            max_examples=cases or 10**6,
            phases=[Phase.generate, Phase.shrink],
            deadline=None,
            database=None,
            report_multiple_bugs=False,
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.large_base_example],
            verbosity=Verbosity.quiet,
        )
        number = zlib.crc32(f"{self.about['seed']} {op.name} {turn}".encode())
        try:
            seed(number)(options(given(cases_of(op))(check)))()
        except (_Stop, *_FAILURES.values()):
            pass
        finally:
            if found:
                text, case = failure_text(*found[-1]), found[-1][0]._asdict()
                self.failures.append({"text": text, "case": case})

    def _rows(self) -> tuple[list[dict], list[dict]]:
        """Return one row per op, and the rows of its kinds grouped by op."""
        totals, rows = [], []
        for op in dict.fromkeys(case.op for case, *_ in self._results):
            of_op = [result for result in self._results if result[0].op == op]
            totals.append(_row(op, "all", of_op))
            for kind in dict.fromkeys(case.kind for case, *_ in of_op):
                rows.append(_row(op, kind, [r for r in of_op if r[0].kind == kind]))
        return totals, rows

    def document(self) -> dict:
        """Return all results, ready for JSON."""
        totals, rows = self._rows()
        lists = {"totals": [*map(_plain, totals)], "rows": [*map(_plain, rows)]}
        return self.about | lists | {"failures": self.failures}

    def markdown(self) -> str:
        """Return all results as a page."""
        totals, rows = self._rows()
        about = ", ".join(f"{name} {value}" for name, value in self.about.items())
        parts = ["# Numerical stress test", about, _table(totals), _table(rows)]
        if self.failures:
            parts += ["## Failures", *(f"{f['text']}\n\n    {f['case']}" for f in self.failures)]
        return "\n\n".join(parts) + "\n"

    def summary(self) -> str:
        """Return the table of the cases, and a line for each failure."""
        totals, rows = self._rows()
        lines = [_table([*rows, *totals]), *(f["text"] for f in self.failures)]
        cases = sum(row["cases"] for row in totals)
        return "\n".join([*lines, f"{cases} cases, {len(self.failures)} failed"])


def failure_text(case: RandomCase, outcome: Outcome) -> str:
    """Describe a failure in one line."""
    failure = outcome.failure()
    assert failure is not None
    ratio = "" if failure["ratio"] is None else f"{failure['ratio']:.3g}"
    words = {"limit": f" is {ratio} times its limit off", "not finite": " is not finite"}
    return f"{case.op}, {case.kind}: {failure['name']}{words.get(failure['what'], '')}"
