"""Runs rows, several at once, each in processes of its own; what is done is not done again."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import UserError, one_line
from ..files import atomic_folder, output_folder
from .figures import read_facts, read_result
from .jobs import ROW, Settings, Stage
from .plan import Plan
from .processes import Child, End, stop_requests, why
from .record import Ended, Record, add_part, write_record

_WAIT = 0.1  # seconds between two looks at the processes
_PATIENCE = 600.0  # seconds in which a command that is asked to stop has saved and ended
ENOUGH = {0, 1}  # exit code 1: some objects failed, and the others have results


@dataclass
class Task:
    """A row with one seed.

    Attributes:
        name: for messages.
        folder: its folder.
        stages: its commands.
        record: what of it is done.
        geometry: number of objects whose shapes are evaluated, or None for all.
        child: the command that runs now.
    """

    name: str
    folder: Path
    stages: list[Stage]
    record: Record
    geometry: int | None = None
    child: Child | None = None
    stage: Stage | None = field(default=None, repr=False)

    def following(self) -> Stage | None:
        """The next command; None where all have ended well."""
        for stage in self.stages:
            done = stage.name in self.record.ended and (self.folder / stage.makes).exists()
            if not done:
                return stage
        return None


def run_tasks(
    tasks: list[Task],
    jobs: int,
    threads: int,
    ended: Callable[[Task], None],
) -> int:
    """Runs tasks until all have ended, or a signal asks to stop.

    A row that fails stops no other. On a signal the commands are asked to stop, and a training
    saves before it ends; a second signal ends them at once.

    Args:
        tasks: in their order.
        jobs: how many at once.
        threads: of each command.
        ended: is called with each task that has ended, well or not.

    Returns:
        0, or 128 + the number of the signal.

    Raises:
        UserError: a folder or a record cannot be written.
    """
    waiting, running = list(tasks), []
    told = 0
    asked = 0.0
    with stop_requests() as received:
        try:
            while running or (waiting and not received):
                while waiting and len(running) < jobs and not received:
                    running.append(waiting.pop(0))
                    _advance(running[-1], jobs, threads)
                if len(received) > told:
                    late = told > 0
                    told, asked = len(received), asked or time.monotonic()
                    _ask(running, at_once=late)
                if asked and time.monotonic() - asked > _PATIENCE:
                    _ask(running, at_once=True)
                for task in list(running):
                    _look(task, jobs, threads, bool(received))
                    if task.child is None:
                        running.remove(task)
                        if task.record.status != "begun":
                            ended(task)
                time.sleep(_WAIT)
        finally:  # also where a record cannot be written
            for task in running:
                if task.child is not None:
                    task.child.kill()
    return 128 + received[0] if received else 0


def _ask(running: list[Task], at_once: bool) -> None:
    for task in running:
        if task.child is not None:
            task.child.ask(at_once)


def _look(task: Task, jobs: int, threads: int, stopping: bool) -> None:
    """Takes note of a command that has ended, and starts the next one."""
    if task.child is None or task.stage is None:
        return
    end = task.child.poll()
    if end is None:
        return
    task.child = None
    _note_end(task, task.stage, end, jobs, threads)
    if task.record.status == "begun" and end.code in ENOUGH and not stopping:
        _advance(task, jobs, threads)


def _note_end(task: Task, stage: Stage, end: End, jobs: int, threads: int) -> None:
    record, log = task.record, _log(task, stage)
    ended = Ended(end.seconds, end.peak_memory, threads, jobs)
    ended = add_part(record.parts.get(stage.name), ended)
    if end.code not in ENOUGH or not (task.folder / stage.makes).exists():
        record.parts[stage.name] = ended
        if not end.stopped:
            record.status, record.reason = "failed", f"{stage.words[0]}: {why(end.code, log)}"
    else:
        ended.note = "" if end.code == 0 else why(end.code, log)
        record.parts.pop(stage.name, None)
        record.ended[stage.name] = ended
        if stage.name == "train" and (reason := diverged(task.folder / "run")):
            record.status, record.reason = "failed", f"train: {reason}"
    if record.status == "begun" and task.following() is None:
        record.status = "ok"
    write_record(task.folder, record)


def diverged(run: Path) -> str | None:
    """Says that a training that ended well has diverged all the same, from its log; or None."""
    facts = read_facts(run / "log.jsonl")
    for name, value in (("loss", facts.last_loss), ("validation's loss", facts.last_val_loss)):
        if value is not None and not math.isfinite(value):
            return f"diverged: its last {name} is not finite"
    if facts.steps and facts.skipped > facts.steps / 2:
        return f"diverged: {facts.skipped} of its {facts.steps} steps were not finite"
    return None


def _advance(task: Task, jobs: int, threads: int) -> None:
    """Starts the next command of a task, if there is one and it can be started."""
    stage = task.following()
    if stage is None:
        task.record.status = "ok"
        write_record(task.folder, task.record)
        return
    output_folder(task.folder)
    task.record.status, task.record.reason = "begun", ""
    write_record(task.folder, task.record)
    words = stage.words_in(task.folder)
    if stage.name == "train":
        words += ["--threads", str(threads)]
    try:
        if stage.name == "shapes" and task.geometry is not None:
            choose(task.folder, stage, task.geometry)
        task.stage, task.child = stage, Child(words, _log(task, stage), threads)
    except (OSError, UserError) as error:
        reason = one_line(str(getattr(error, "strerror", None) or error), 300)
        task.record.status, task.record.reason = "failed", f"{stage.words[0]}: {reason}"
        write_record(task.folder, task.record)


def _log(task: Task, stage: Stage) -> Path:
    return task.folder / f"{stage.name}.log"


def row_line(plan: Plan, task: Task) -> str:
    """One line about a row that has ended, with one seed."""
    record = task.record
    if record.status == "failed":
        return f"{task.name}: failed: {record.reason}"
    try:
        found = read_result(plan.row(record.row), task.folder, record)
    except UserError as error:
        return f"{task.name}: {error}"
    values = [v["psnr"] for v in found.objects.values() if "psnr" in v]
    parts = [f"PSNR {sum(values) / len(values):.2f} dB" if values else "no view could be compared"]
    if found.facts.step_seconds is not None:
        parts.append(f"{found.facts.step_seconds:.3g} s a step")
    if found.missing:
        parts.append(f"{len(found.missing)} objects lack")
    spent = sum(part.seconds for part in record.ended.values())
    return f"{task.name}: {', '.join(parts)}, {spent / 60:.1f} minutes"


def choose(folder: Path, stage: Stage, count: int) -> None:
    """Copies the Gaussians of some objects, evenly spaced by name, into a folder of their own.

    Args:
        folder: of the row.
        stage: the evaluation of its shapes, whose first word names the new folder.
        count: of the objects.

    Raises:
        UserError: there are no Gaussians, or they cannot be copied.
    """
    target = folder / stage.words[1].removeprefix(f"{ROW}/")
    source = next(
        (f for f in (folder / "views", folder / "fit") if (f / "gaussians").is_dir()), None
    )
    found = sorted((source / "gaussians").glob("*.ply")) if source else []
    if not found:
        raise UserError("it has no Gaussians whose shapes could be evaluated")
    if count < len(found):
        found = [found[k * len(found) // count] for k in range(count)]
    try:
        with atomic_folder(target, replace=True) as temporary:
            for path in found:
                shutil.copyfile(path, temporary / path.name)
    except OSError as error:
        raise UserError(f"cannot write {target}: {error.strerror}") from error


def open_inputs(given: tuple[Settings, list[str]]) -> None:
    """Opens what the commands of an ablation will read.

    It is called in a process of its own. What a command's process held before it became that
    command counts as its memory, so the process that starts commands must not load torch.

    Args:
        given: what is the same for every row, and the names of the rows that need VGG16.

    Raises:
        UserError: something is not there.
    """
    from ..data.dataset import open_dataset
    from ..devices import pick_device
    from ..vision.weights import FETCH, lpips_available

    settings, weights = given
    pick_device(settings.device)
    for split in ("train", settings.evaluation.split):
        if not open_dataset(settings.data, split).uids:
            raise UserError(f"{settings.data}: its part {split} has no objects")
    if settings.meshes is not None and not settings.meshes.is_dir():
        raise UserError(f"--meshes {settings.meshes}: no such folder")
    if weights and not lpips_available():
        raise UserError(f"row {weights[0]}: needs the weights of VGG16; fetch them with: {FETCH}")
