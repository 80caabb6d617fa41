"""A run of ``gamba stress``: its operators, its cases, and the files that it leaves."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from ..batch import progress_bar
from ..errors import UserError
from ..files import atomic_path, write_json
from ..kernels.stress import (
    Case,
    Op,
    Outcome,
    draw_cases,
    read_reproducer,
    reproducer,
    run_case,
    shrink,
)
from ..kernels.stress.core.report import Tally, document, failure_text, markdown, table
from ..untrusted.documents import read_document
from ..versions import __version__, installed

# What is stressed -> modules with an ``OP``. They are imported when they are asked for.
SUITES = {
    "scan": ("gamba_warp.kernels.stress.cases.scan", "gamba_warp.kernels.stress.cases.conv"),
    "raster": ("gamba_warp.kernels.stress.cases.raster",),
    "model": ("gamba_warp.measure.stress",),
}
_SHRUNK = 5  # failures of a run that are made small; all are written


def choose_ops(what: Sequence[str]) -> list[Op]:
    """The operators of those of ``SUITES`` that are named.

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


def versions() -> dict[str, str]:
    """Versions by name of what decides a result."""
    return {"gamba_warp": __version__} | installed("torch", "warp-lang")


class StressRun:
    """One run: its tally, its failures, and the files that it leaves.

    Attributes:
        about: what is written of the run itself.
        tally: the cases so far.
        failures: the file and a line of text of each failing case.

    Args:
        ops: what is stressed.
        device: where the kernels run.
        folder: for the summary and the failing cases.
        seed: the same seed gives the same cases in the same order.
        shrink_seconds: time for making one failing case small.
    """

    def __init__(
        self, ops: list[Op], device: torch.device, folder: Path, seed: int, shrink_seconds: float
    ) -> None:
        self._ops, self._device, self._folder = ops, device, folder
        self._shrink_seconds = shrink_seconds
        self.about = {"seed": seed, "device": str(device), **versions()}
        self.tally = Tally()
        self.failures: list[dict[str, str]] = []

    def run(self, count: int | None, seconds: float) -> None:
        """Runs cases until there are ``count``, the time is up or Ctrl-C, with a progress bar.

        Args:
            count: of the cases; None for no limit.
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
                    self.tally.add(case, outcome, time.monotonic() - started)
                    if outcome.failure() is not None:
                        bar.set_postfix_str(f"{op.name}: a failure, made small")
                        self._keep_failure(op, case, outcome)
                    worst = max(worst, outcome.worst.ratio if outcome.worst else 0.0)
                    failed = f"{len(self.failures)} failures"
                    bar.set_postfix_str(f"worst {worst:.2f} of its limit, {failed}")
                    bar.update()
            except KeyboardInterrupt:
                interrupted = True
        minutes = round((time.monotonic() - began) / 60, 2)
        self.about |= {"minutes": minutes, "interrupted": interrupted}

    def _keep_failure(self, op: Op, case: Case, outcome: Outcome) -> None:
        name = f"failure-{op.name}-{len(self.failures) + 1}.json"
        self.failures.append({"file": name})

        def keep(case: Case, outcome: Outcome) -> None:
            write_json(self._folder / name, reproducer(case, outcome, versions()))
            self.failures[-1]["text"] = failure_text(case, outcome)

        keep(case, outcome)  # as it is first, because making it small may be interrupted
        if len(self.failures) <= _SHRUNK:
            small, found, _ = shrink(op, case, self._device, self._shrink_seconds)
            if found.failure() is not None:
                keep(small, found)

    def write(self) -> None:
        """Writes stress.json and stress.md."""
        content = self.tally, self.about, self.failures
        write_json(self._folder / "stress.json", document(*content))
        with atomic_path(self._folder / "stress.md") as temporary:
            temporary.write_text(markdown(*content), encoding="utf-8")

    def summary(self) -> str:
        """The table of the cases, and a line for each failure."""
        lines = [table([*self.tally.sorted(), *self.tally.totals()])]
        lines += [f"{self._folder / row['file']}: {row['text']}" for row in self.failures]
        cases = sum(row.cases for row in self.tally.totals())
        return "\n".join([*lines, f"{cases} cases, {len(self.failures)} failed"])


def replay(paths: Sequence[Path], device: torch.device) -> Iterator[tuple[bool, str]]:
    """Runs the cases in files; all files are read before the first case is run.

    Yields:
        Whether a case passes, and lines about it.

    Raises:
        UserError: no such file, not JSON, damaged, or from another version.
    """
    ops = {op.name: op for op in choose_ops(("all",))}
    cases = []
    for path in paths:
        content = read_document(path, Any, limit=1 << 20)
        try:
            cases.append((path, read_reproducer(content, ops)))
        except ValueError as error:
            raise UserError(f"{path}: {error}") from error
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
