"""Run rows in child processes, several at once; finished work is skipped."""

from __future__ import annotations

import contextlib
import math
import re
import shutil
import signal
import time
from collections.abc import Callable, Generator
from pathlib import Path

from .. import processes
from ..errors import UserError, one_line
from ..files import atomic_folder, output_folder
from .figures import read_log, read_result
from .jobs import ROW, Stage
from .tasks import Ended, Task

_STOP_SECONDS = 600.0  # time for a command to save and end after a request to stop
_ACCEPTED = {0, 1}  # exit code 1: some objects failed, and the others have results
_TAIL = 1 << 14  # bytes of a log searched for the error


def run_tasks(tasks: list[Task], jobs: int, threads: int, on_end: Callable[[Task], None]) -> int:
    """Run tasks until all have ended, or a signal asks to stop.

    A failed row stops no other. On a signal the commands are asked to stop, and training saves
    before it ends; a second signal kills them.

    Args:
        tasks: in order.
        jobs: number of tasks at once.
        threads: of each command.
        on_end: called with each task that has ended, successful or not.

    Returns:
        0, or 128 + the number of the signal.

    Raises:
        UserError: a folder or a record cannot be written.
    """
    waiting, handled, deadline = list(tasks), 0, math.inf
    running: list[tuple[Task, Generator[processes.Child, None, None]]] = []
    with processes.stop_requests() as received, contextlib.ExitStack() as ending:
        while running or (waiting and not received):
            while waiting and len(running) < jobs and not received:
                commands = _commands(waiting[0], jobs, threads, received)
                running.append((waiting.pop(0), ending.enter_context(contextlib.closing(commands))))
            asked, handled = len(received) > handled, len(received)
            kill = handled > 1 or time.monotonic() > deadline
            deadline = min(deadline, time.monotonic() + _STOP_SECONDS) if handled else deadline
            for task, commands in list(running):
                child = next(commands, None)
                if child is None:
                    running.remove((task, commands))
                    if task.record.status != "begun":
                        on_end(task)
                elif kill:
                    child.kill()
                elif asked:
                    child.ask(signal.SIGTERM)
            time.sleep(processes.LOOK)
    return 128 + received[0] if received else 0


def _commands(
    task: Task, jobs: int, threads: int, stopping: list[int]
) -> Generator[processes.Child, None, None]:
    """Run the unfinished commands of a task; yield the running one at every poll."""
    while not stopping and (stage := task.next_stage()) is not None:
        log = output_folder(task.folder) / f"{stage.name}.log"
        task.write("begun")
        words = stage.words_in(task.folder)
        words += ["--threads", str(threads)] if stage.name == "train" else []
        environment = {"TQDM_MININTERVAL": "30"}  # else a bar logs ten lines a second
        environment |= {f"{library}_NUM_THREADS": str(threads) for library in ("OMP", "MKL")}
        try:
            if stage.name == "shapes" and task.geometry is not None:
                choose(task.folder, stage, task.geometry)
            with open(log, "ab") as output:
                output.write(f"$ gamba {' '.join(words)}\n".encode(errors="replace"))
                output.flush()
                child = processes.Child([*processes.GAMBA, *words], output, environment)
        except (OSError, UserError) as error:
            reason = one_line(str(getattr(error, "strerror", None) or error), 300)
            return task.write("failed", f"{stage.words[0]}: {reason}")
        try:
            while (end := child.poll()) is None:
                yield child
        finally:  # also if a record cannot be written
            child.kill()
        before = task.record.parts.pop(stage.name, Ended())  # of a stopped run that was resumed
        memory = max(before.peak_memory or 0, end.peak_memory or 0) or None
        part = Ended(before.seconds + end.seconds, memory, threads, jobs)
        reason = failure_reason(end.code, log)
        if end.code not in _ACCEPTED or not (task.folder / stage.makes).exists():
            task.record.parts[stage.name] = part
            stopped = end.stopped or stopping
            return task.write(None if stopped else "failed", f"{stage.words[0]}: {reason}")
        part.note = reason if end.code else ""
        task.record.ended[stage.name] = part
        if stage.name == "train" and (reason := diverged(task.folder / "run")):
            return task.write("failed", f"train: {reason}")
        task.write()
    if task.next_stage() is None:
        task.write("ok")


def diverged(run: Path) -> str | None:
    """Return a reason if the log of a finished training shows divergence; else None."""
    log = read_log(run / "log.jsonl")
    for event, loss in log.losses.items():
        if not math.isfinite(loss):
            name = "loss" if event == "train" else "validation's loss"
            return f"diverged: its last {name} is not finite"
    if log.step and log.skipped > log.step / 2:
        return f"diverged: {log.skipped} of its {log.step} steps were not finite"
    return None


def row_line(task: Task) -> str:
    """Return one line about a finished row with one seed."""
    record = task.record
    if record.status == "failed":
        return f"{task.name}: failed: {record.reason}"
    try:
        found = read_result(task)
    except UserError as error:
        return f"{task.name}: {error}"
    values = [v["psnr"] for v in found.objects.values() if "psnr" in v]
    parts = [f"PSNR {sum(values) / len(values):.2f} dB" if values else "no view could be compared"]
    if found.step_seconds is not None:
        parts.append(f"{found.step_seconds:.3g} s a step")
    if found.missing:
        parts.append(f"{len(found.missing)} objects missing")
    spent = sum(part.seconds for part in record.ended.values())
    return f"{task.name}: {', '.join(parts)}, {spent / 60:.1f} minutes"


def choose(folder: Path, stage: Stage, count: int) -> None:
    """Copy the Gaussians of some objects, evenly spaced by name, into a new folder.

    Args:
        folder: of the row.
        stage: the evaluation of its shapes, whose first argument names the new folder.
        count: number of objects.

    Raises:
        UserError: Gaussians are missing or cannot be copied.
    """
    target = folder / stage.words[1].removeprefix(f"{ROW}/")
    found = sorted(p for of in ("views", "fit") for p in folder.glob(f"{of}/gaussians/*.ply"))
    if not found:
        raise UserError("it has no Gaussians to evaluate shapes of")
    count = min(count, len(found))
    found = [found[k * len(found) // count] for k in range(count)]
    try:
        with atomic_folder(target, replace=True) as temporary:
            for path in found:
                shutil.copyfile(path, temporary / path.name)
    except OSError as error:
        raise UserError(f"cannot write {target}: {error.strerror}") from error


def failure_reason(code: int, log: Path) -> str:
    """Return why a command failed, in one line, from its exit code and its outputs.

    Args:
        code: as in ``processes.End``.
        log: the file of its outputs.
    """
    try:
        with open(log, "rb") as file:
            file.seek(max(0, log.stat().st_size - _TAIL))
            text = file.read().decode(errors="replace")
    except OSError:
        text = ""
    mark = "\n$ gamba "
    if mark in f"\n{text}":  # only of the last run
        text = f"\n{text}".rpartition(mark)[2].partition("\n")[2]
    lines = [line.strip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    messages = [line for line in lines if line.startswith(("gamba: ", "failed: "))]
    if code > 128:
        number = code - 128
        name = signal.Signals(number).name if number in {*signal.Signals} else "unknown"
        memory = ", perhaps out of memory" if name == "SIGKILL" else ""
        return f"died of signal {number} ({name}){memory}"
    if messages:
        return one_line(messages[-1].removeprefix("gamba: "), 300)
    return one_line(f"exit code {code}: {lines[-1] if lines else 'no output'}", 300)
