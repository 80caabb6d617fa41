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
_SUMS = "cases", "nonfinite", "failures", "pixels", "undecided", "steep", "seconds"


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


def _row(op: str, kind: str) -> dict:
    """Return an empty row of results of a kind of cases; "all" means all kinds of an op.

    It has the largest relative rms errors of a float32 result and of a gradient with their names;
    the largest error over its limit, infinite if something was not finite; and ``_SUMS``, defined
    by ``Outcome``.
    """
    nothing = {"error": 0.0, "of": ""}
    sums = dict.fromkeys(_SUMS, 0)
    return {"op": op, "kind": kind, **sums, "ratio": 0.0, "forward": nothing, "gradient": nothing}


def _plain(value: Any) -> Any:
    """Replace numbers that are not finite, which JSON cannot hold, by None."""
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _table(rows: Sequence[dict]) -> str:
    def cells(r: dict) -> Iterator[str]:
        yield from (r["op"], r["kind"], str(r["cases"]))
        for errors in (r["forward"], r["gradient"]):
            yield f"{errors['error']:.1e}" if errors["error"] else "0"
            yield errors["of"].removeprefix("gradient of ")
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
        self._rows: dict[tuple[str, str], dict] = {}
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
        failing: list[
            tuple[RandomCase, Outcome]
        ] = []  # failing ones, each smaller than the one before

        def check(case: RandomCase) -> None:
            nonlocal until
            if time.monotonic() >= until:
                raise _Stop
            started = time.monotonic()
            outcome = run_case(op, case, self._device)
            if not failing:
                self._count(case, outcome, time.monotonic() - started)
            if failure := outcome.failure():
                if not failing:
                    until = time.monotonic() + _SHRINK
                failing.append((case, outcome))
                say("shrinking a failing case")
                raise _FAILURES[failure["what"]]
            say(f"worst {max(r['ratio'] for r in self._rows.values()):.2f} of its limit")

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
            if failing:
                text, case = failure_text(*failing[-1]), failing[-1][0]._asdict()
                self.failures.append({"text": text, "case": case})

    def _count(self, case: RandomCase, outcome: Outcome, seconds: float) -> None:
        failed = outcome.failure() is not None
        sums = vars(outcome) | {"cases": 1, "nonfinite": outcome.nonfinite, "failures": failed}
        for key in ((case.op, "all"), (case.op, case.kind)):
            row = self._rows.setdefault(key, _row(*key))
            for name in _SUMS:
                row[name] += (sums | {"seconds": seconds})[name]
            for c in outcome.comparisons:
                row["ratio"] = max(row["ratio"], c.ratio)
                which = "gradient" if c.name.startswith("gradient") else "forward"
                if c.counts and c.error > row[which]["error"]:
                    row[which] = {"error": c.error, "of": c.name}

    def _sorted(self) -> tuple[list[dict], list[dict]]:
        """Return one row per op, and all other rows grouped by op."""
        totals = [row for row in self._rows.values() if row["kind"] == "all"]
        rows = [r for t in totals for r in self._rows.values() if r["op"] == t["op"]]
        return totals, [row for row in rows if row["kind"] != "all"]

    def document(self) -> dict:
        """Return all results, ready for JSON."""
        totals, rows = self._sorted()
        lists = {"totals": [*map(_plain, totals)], "rows": [*map(_plain, rows)]}
        return self.about | lists | {"failures": self.failures}

    def markdown(self) -> str:
        """Return all results as a page."""
        totals, rows = self._sorted()
        about = ", ".join(f"{name} {value}" for name, value in self.about.items())
        parts = ["# Numerical stress test", about, _table(totals), _table(rows)]
        if self.failures:
            parts += ["## Failures", *(f"{f['text']}\n\n    {f['case']}" for f in self.failures)]
        return "\n\n".join(parts) + "\n"

    def summary(self) -> str:
        """Return the table of the cases, and a line for each failure."""
        totals, rows = self._sorted()
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
