"""A run of ``gamba stress``: operators, cases and files."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import torch

from ..batch import progress_bar
from ..errors import UserError
from ..files import write_json, write_text
from ..kernels.runtime.tables import markdown
from ..kernels.stress.core.case import Case, Op, Outcome, draw_cases, run_case, shrink
from ..untrusted.documents import read_document
from ..versions import __version__, installed

FORMAT = "gamba_warp.stress.1"
# Suite -> modules with an ``OP``, imported when needed.
SUITES = {
    "scan": ("gamba_warp.kernels.stress.cases.scan", "gamba_warp.kernels.stress.cases.conv"),
    "raster": ("gamba_warp.kernels.stress.cases.raster",),
    "model": ("gamba_warp.measure.stress",),
}
_VERSIONS = {"gamba_warp": __version__} | installed("torch", "warp-lang")  # affect results
_SHRUNK = 5  # failures of a run that are shrunk; all are written
_HEAD = (
    *("op", "kind", "cases", "forward error", "of", "gradient error", "of", "error / limit"),
    *("undecided pixels", "steep", "non-finite", "failures"),
)


def choose_ops(what: Sequence[str]) -> list[Op]:
    """Return the operators of the named ``SUITES``.

    Args:
        what: names, or "all".

    Raises:
        UserError: a name is not known.
    """
    unknown = [name for name in what if name not in (*SUITES, "all")]
    if unknown:
        raise UserError(f"unknown '{unknown[0]}'; there are {', '.join(SUITES)} and all")
    wanted = [name for name in SUITES if name in what or "all" in what]
    return [importlib.import_module(module).OP for name in wanted for module in SUITES[name]]


_SUMS = "cases", "nonfinite", "failures", "pixels", "undecided", "steep", "seconds"


def _row(op: str, kind: str) -> dict:
    """Return an empty row of results of a kind of cases; "all" means all kinds of an op.

    It has the largest relative rms errors of a float32 result and of a gradient with their names;
    the largest error over its limit, infinite if something was not finite; and ``_SUMS``, defined
    by ``Outcome``.
    """
    nothing = {"error": 0.0, "of": ""}
    sums = dict.fromkeys(_SUMS, 0)
    return {"op": op, "kind": kind, **sums, "ratio": 0.0, "forward": nothing, "gradient": nothing}


def _count(row: dict, outcome: Outcome, seconds: float) -> None:
    """Count one case."""
    failed = outcome.failure() is not None
    found = vars(outcome) | {"cases": 1, "nonfinite": outcome.nonfinite, "failures": failed}
    for name in _SUMS:
        row[name] += (found | {"seconds": seconds})[name]
    for c in outcome.comparisons:
        row["ratio"] = max(row["ratio"], c.ratio)
        which = "gradient" if c.name.startswith("gradient") else "forward"
        if c.counts and c.error > row[which]["error"]:
            row[which] = {"error": c.error, "of": c.name}


def _plain(value: Any) -> Any:
    """Replace numbers that are not finite, which JSON cannot hold, by None."""
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(rows: Sequence[dict]) -> str:
    """Return a Markdown table aligned for a terminal."""

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
    """One run: its rows, its failures and its files.

    Attributes:
        about: description of the run.
        failures: file and one line of text of each failing case.

    Args:
        ops: the tested operators.
        device: of the kernels.
        folder: for the summary and the failing cases.
        seed: the same seed gives the same cases in the same order.
        shrink_seconds: time for shrinking one failing case.
    """

    def __init__(
        self, ops: list[Op], device: torch.device, folder: Path, seed: int, shrink_seconds: float
    ) -> None:
        self._ops, self._device, self._folder = ops, device, folder
        self._shrink_seconds = shrink_seconds
        self.about = {"seed": seed, "device": str(device), **_VERSIONS}
        self._rows: dict[tuple[str, str], dict] = {}
        self.failures: list[dict[str, str]] = []

    def run(self, count: int | None, seconds: float) -> None:
        """Run cases until ``count``, the time limit or Ctrl-C, with a progress bar.

        Args:
            count: number of cases; None for no limit.
            seconds: may be infinite.
        """
        began, interrupted, worst = time.monotonic(), False, 0.0
        total = count if seconds == math.inf else None
        with progress_bar(total=total, unit="case", desc="stress") as bar:
            try:
                for index, (op, case) in enumerate(draw_cases(self._ops, self.about["seed"])):
                    started = time.monotonic()
                    if index == count or started >= began + seconds:
                        break
                    outcome = run_case(op, case, self._device)
                    for key in ((case.op, "all"), (case.op, case.kind)):
                        row = self._rows.setdefault(key, _row(*key))
                        _count(row, outcome, time.monotonic() - started)
                    if outcome.failure() is not None:
                        bar.set_postfix_str(f"{op.name}: shrinking a failure")
                        self._save_failure(op, case, outcome)
                    worst = max(worst, outcome.worst.ratio if outcome.worst else 0.0)
                    failed = f"{len(self.failures)} failures"
                    bar.set_postfix_str(f"worst {worst:.2f} of its limit, {failed}")
                    bar.update()
            except KeyboardInterrupt:
                interrupted = True
        minutes = round((time.monotonic() - began) / 60, 2)
        self.about |= {"minutes": minutes, "interrupted": interrupted}

    def _save_failure(self, op: Op, case: Case, outcome: Outcome) -> None:
        name = f"failure-{op.name}-{len(self.failures) + 1}.json"
        self.failures.append({"file": name})

        def save(case: Case, outcome: Outcome) -> None:
            write_json(self._folder / name, reproducer(case, outcome))
            self.failures[-1]["text"] = failure_text(case, outcome)

        save(case, outcome)  # first unchanged, because shrinking may be interrupted
        if len(self.failures) <= _SHRUNK:
            small, found, _ = shrink(op, case, self._device, self._shrink_seconds)
            if found.failure() is not None:
                save(small, found)

    def _sorted(self) -> tuple[list[dict], list[dict]]:
        """Return one row per op, and all other rows grouped by op."""
        totals = [row for row in self._rows.values() if row["kind"] == "all"]
        rows = [r for t in totals for r in self._rows.values() if r["op"] == t["op"]]
        return totals, [row for row in rows if row["kind"] != "all"]

    def write(self) -> None:
        """Write stress.json and stress.md."""
        totals, rows = self._sorted()
        lists = {"totals": [*map(_plain, totals)], "rows": [*map(_plain, rows)]}
        content = {"format": FORMAT, **self.about, **lists, "failures": self.failures}
        write_json(self._folder / "stress.json", content)
        about = ", ".join(f"{name} {value}" for name, value in self.about.items())
        parts = ["# Numerical stress test", about, table(totals), table(rows)]
        if self.failures:
            lines = (f"- {f['file']}: {f['text']}" for f in self.failures)
            parts += ["## Failures", "\n".join(lines)]
        write_text(self._folder / "stress.md", "\n\n".join(parts) + "\n")

    def summary(self) -> str:
        """Return the table of the cases, and a line for each failure."""
        totals, rows = self._sorted()
        lines = [table([*rows, *totals])]
        lines += [f"{self._folder / row['file']}: {row['text']}" for row in self.failures]
        cases = sum(row["cases"] for row in totals)
        return "\n".join([*lines, f"{cases} cases, {len(self.failures)} failed"])


def failure_text(case: Case, outcome: Outcome) -> str:
    """Describe a failure in one line."""
    failure = outcome.failure()
    assert failure is not None
    ratio = "" if failure["ratio"] is None else f"{failure['ratio']:.3g}"
    words = {"limit": f" is {ratio} times its limit off", "not finite": " is not finite"}
    return f"{case.op}, {case.kind}: {failure['name']}{words.get(failure['what'], '')}"


def reproducer(case: Case, outcome: Outcome) -> dict:
    """Return the content of a file from which ``replay`` repeats a case."""
    failure = _plain(outcome.failure())
    return {"format": FORMAT, "case": asdict(case), "failure": failure, "versions": _VERSIONS}


def read_reproducer(path: Path, ops: dict[str, Op]) -> Case:
    """Read the case of a ``reproducer``.

    Raises:
        UserError: no such file, not JSON, damaged, or from another version.
    """
    document = read_document(path, Any, limit=1 << 20)
    try:
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ValueError(f"not a case of 'gamba stress' (format is not {FORMAT})")
        case = msgspec.convert(document.get("case"), Case)
        op = ops.get(case.op)
        if op is None or case.kind not in op.kinds:
            raise ValueError(f"this version has no case {f'{case.op[:40]}, {case.kind[:40]}'!r}")
        if not 0 <= case.seed < 2**31:
            raise ValueError("damaged: seed is not in 0 to 2147483647")
        _check_options(op, case.options)
    except ValueError as error:  # msgspec's errors are ValueErrors
        raise UserError(f"{path}: {error}") from error
    return case


def _check_options(op: Op, options: dict) -> None:
    for name in sorted(options.keys() | op.plain.keys()):
        if name not in op.plain or name not in options:
            kind = "an unknown" if name in options else "no"
            raise ValueError(f"{kind} option {name[:40]!r}; from another version, or damaged")
        value, plain = options[name], op.plain[name]
        allowed = op.choices.get(name)
        wrong = type(value) is not type(plain) or (allowed and value not in allowed)
        if wrong or (isinstance(value, (int, float)) and not 0 <= value <= 10**6):
            shown = repr(value)[:40]
            raise ValueError(f"option '{name}' is {shown}; from another version, or damaged")
    fitting = op.valid(options)
    for name, value in options.items():
        if fitting[name] != value:
            text = f"'{name}' is {value}, and {fitting[name]} is the nearest that fits"
            raise ValueError(f"damaged: its options do not fit each other: {text}")


def replay(paths: Sequence[Path], device: torch.device) -> Iterator[tuple[bool, str]]:
    """Run the cases in files; all files are read before the first case is run.

    Yields:
        True if a case passes, and lines about it.

    Raises:
        UserError: no such file, not JSON, damaged, or from another version.
    """
    ops = {op.name: op for op in choose_ops(("all",))}
    cases = [(path, read_reproducer(path, ops)) for path in paths]
    for path, case in cases:
        outcome = run_case(ops[case.op], case, device)
        passes, worst = outcome.failure() is None, outcome.worst
        if passes:
            ratio = f"{worst.name} {worst.ratio:.2f} of its limit" if worst else "nothing compared"
            lines = [f"{path}: passes; {case.op}, {case.kind}: {ratio}"]
        else:
            lines = [f"{path}: fails; {failure_text(case, outcome)}"]
        for c in outcome.comparisons:
            lines.append(f"  {c.name:<28} error {c.error:.2e}, {c.ratio:.3g} of its limit")
        yield passes, "\n".join(lines)
