"""``gamba stress``: random and hostile cases, each against float64."""

from __future__ import annotations

import importlib
import json
import math
import time
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
import warp
from tqdm import tqdm

from ..devices import pick_device
from ..errors import UserError
from ..files import atomic_path, output_folder, write_json
from ..kernels.stress import (
    Case,
    Op,
    Outcome,
    Tally,
    document,
    failure_text,
    markdown,
    read_reproducer,
    reproducer,
    run_case,
    run_cases,
    shrink,
    table,
)
from ..versions import __version__

# what is stressed -> modules with an ``OP``, loaded when asked for
SUITES = {
    "scan": ("gamba_warp.kernels.stress.cases.scan", "gamba_warp.kernels.stress.cases.conv"),
    "raster": ("gamba_warp.kernels.stress.cases.raster",),
    "model": ("gamba_warp.measure.stress",),
}
_MINUTES = 1.0
_SHRUNK = 5  # failures of a run that are made small; all are written


def stress_command(
    what: tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT ...")]] = (
        "all",
    ),
    *,
    seed: int = 0,
    minutes: float | None = None,
    cases: int | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    threads: int | None = None,
    out: Path = Path("out/stress"),
    shrink_seconds: float = 30.0,
    replay: tuple[Path, ...] = (),
) -> int:
    """Runs random and hostile cases of the kernels and the model, each against float64.

    Forward results and all gradients; a failing case is made small and written to a file that
    --replay runs again. Writes stress.json and stress.md. Ctrl-C keeps what was found.

    Args:
        what: scan (with the convolution), raster, model, or all.
        seed: The same seed gives the same cases in the same order.
        minutes: How long; default 1, or no limit with --cases.
        cases: How many; default as many as fit in --minutes.
        device: Where the kernels run; auto is the GPU if there is one.
        threads: CPU threads; default: torch's.
        out: Folder for the summary and the failing cases.
        shrink_seconds: At most so long for making one failing case small.
        replay: Run only these files of failing cases.
    """
    where = pick_device(device)
    if threads is not None:
        if threads < 1:
            raise UserError(f"--threads is {threads}, it must be positive")
        torch.set_num_threads(threads)
    if replay:
        return _replay(replay, where)
    ops = _ops(what)
    if minutes is not None and not minutes > 0:
        raise UserError(f"--minutes is {minutes}, it must be positive")
    if cases is not None and cases < 1:
        raise UserError(f"--cases is {cases}, it must be positive")
    limits = {"count": cases, "seconds": math.inf}
    if minutes is not None or cases is None:
        limits["seconds"] = 60 * (minutes or _MINUTES)
    run = _Run(ops, where, output_folder(out), seed, shrink_seconds)
    return run.finish(run.run(**limits))


def _ops(what: tuple[str, ...]) -> list[Op]:
    unknown = [name for name in what if name not in (*SUITES, "all")]
    if unknown:
        raise UserError(f"unknown '{unknown[0]}'; there are {', '.join(SUITES)} and all")
    wanted = [name for name in SUITES if name in what or "all" in what]
    return [importlib.import_module(module).OP for name in wanted for module in SUITES[name]]


def versions() -> dict[str, str]:
    """Of what decides a result."""
    return {"gamba_warp": __version__, "torch": torch.__version__, "warp": warp.__version__}


class _Run:
    """One run: its tally, its failures, and the files that it leaves."""

    def __init__(
        self, ops: list[Op], device: torch.device, folder: Path, seed: int, seconds: float
    ) -> None:
        self.ops, self.device, self.folder, self.seconds = ops, device, folder, seconds
        self.about = {"seed": seed, "device": str(device), **versions()}
        self.tally, self.failures = Tally(), []

    def run(self, count: int | None, seconds: float) -> bool:
        """Runs the cases; returns whether Ctrl-C ended it."""
        begin, interrupted = time.monotonic(), False
        total = count if seconds == math.inf else None
        with tqdm(total=total, unit="case", desc="stress", disable=None) as bar:
            worst = 0.0
            try:
                found = run_cases(
                    self.ops, self.about["seed"], self.device, count=count, seconds=seconds
                )
                for op, case, outcome, spent in found:
                    self.tally.add(case, outcome, spent)
                    if outcome.failure() is not None:
                        bar.set_postfix_str(f"{op.name}: a failure, made small")
                        self._fail(op, case, outcome)
                    worst = max(worst, outcome.worst.ratio if outcome.worst else 0.0)
                    bar.set_postfix_str(
                        f"worst {worst:.2f} of its limit, {len(self.failures)} failures"
                    )
                    bar.update()
            except KeyboardInterrupt:
                interrupted = True
        self.about["minutes"] = round((time.monotonic() - begin) / 60, 2)
        return interrupted

    def _fail(self, op: Op, case: Case, outcome: Outcome) -> None:
        name = f"failure-{op.name}-{len(self.failures) + 1}.json"
        # first as it is: making it small may be interrupted
        self._write(name, case, outcome)
        self.failures.append({"file": name, "text": failure_text(case, outcome.failure())})
        if len(self.failures) <= _SHRUNK:
            small, found, _ = shrink(op, case, self.device, self.seconds)
            if found.failure() is not None:
                self._write(name, small, found)
                self.failures[-1]["text"] = failure_text(small, found.failure())

    def _write(self, name: str, case: Case, outcome: Outcome) -> None:
        write_json(self.folder / name, reproducer(case, outcome, versions()))

    def finish(self, interrupted: bool) -> int:
        """Writes and prints the summary; returns the exit code."""
        about = self.about | {"interrupted": interrupted}
        write_json(self.folder / "stress.json", document(self.tally, about, self.failures))
        with atomic_path(self.folder / "stress.md") as temporary:
            temporary.write_text(markdown(self.tally, about, self.failures), encoding="utf-8")
        print(table([*self.tally.sorted(), *self.tally.totals()]))
        for failure in self.failures:
            print(f"{self.folder / failure['file']}: {failure['text']}")
        run = sum(row.cases for row in self.tally.totals())
        print(f"{run} cases, {len(self.failures)} failed; wrote {self.folder / 'stress.json'}")
        if interrupted:
            print("interrupted; what was found is kept")
            return 130
        return 1 if self.failures else 0


def _replay(paths: tuple[Path, ...], device: torch.device) -> int:
    """Runs files of failing cases; 1 if any still fails."""
    ops = {op.name: op for op in _ops(("all",))}
    cases = [(path, _read(path, ops)) for path in paths]
    failed = 0
    for path, case in cases:
        outcome = run_case(ops[case.op], case, device)
        failure = outcome.failure()
        failed += failure is not None
        if failure is None:
            worst = outcome.worst
            ratio = f"{worst.name} {worst.ratio:.2f} of its limit" if worst else "nothing compared"
            print(f"{path}: passes; {case.op}, {case.kind}: {ratio}")
        else:
            print(f"{path}: fails; {failure_text(case, failure)}")
        for c in outcome.comparisons:
            print(f"  {c.name:<28} error {c.error:.2e}, {c.ratio:.3g} of its limit")
    return 1 if failed else 0


def _read(path: Path, ops: dict[str, Op]) -> Case:
    """The case in a file.

    Raises:
        UserError: no such file, not JSON, damaged, or from another version.
    """
    try:
        content = json.loads(path.read_text())
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or 'cannot be read'}") from error
    except ValueError as error:
        raise UserError(f"{path}: not JSON ({error})") from error
    try:
        return read_reproducer(content, ops)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
