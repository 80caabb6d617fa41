"""Runs the kills and the full disks, and counts what went wrong."""

from __future__ import annotations

import random
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tqdm import tqdm

from ..batch import progress_bar
from ..files import remove_folder, sha256, sha256_of_all
from .child import End, run_child
from .folders import age, contents, leftovers, lost
from .jobs import Job, command, jobs, make_world, training, training_words
from .processes import kill_one_of_two, steps_for

_MODEL = "model.safetensors"


@dataclass
class Count:
    """What happened to one command under one fault.

    Attributes:
        command: its name.
        fault: ``SIGKILL`` or ``full disk``.
        runs: how often it was tried.
        hit: how often the fault came before the command had ended.
        lost: older files that were missing or damaged afterwards.
        not_resumed: runs of the same command afterwards that failed.
        untold: ends that were not told in one line (a traceback, a native death).
        left: unfinished files and folders right after the faults.
        debris: those still there after the next run, two days later.
        notes: what went wrong, a line each.
    """

    command: str
    fault: str
    runs: int = 0
    hit: int = 0
    lost: int = 0
    not_resumed: int = 0
    untold: int = 0
    left: int = 0
    debris: int = 0
    notes: list[str] = field(default_factory=list)

    @property
    def is_clean(self) -> bool:
        """Whether nothing went wrong."""
        return not (self.lost or self.not_resumed or self.untold or self.debris)


@dataclass(frozen=True)
class Plan:
    """How much is tried.

    Attributes:
        kills: of training.
        command_kills: of each other command.
        full: full disks, of each command.
        commands: names of the commands besides training; empty for all.
        seed: of the random moments.
        processes: kills of one of two processes that train together.
    """

    kills: int
    command_kills: int
    full: int
    commands: tuple[str, ...]
    seed: int
    processes: int = 0


def endurance(folder: Path, plan: Plan) -> dict:
    """Makes a small world in a folder and puts every command to the test in it.

    Args:
        folder: an empty one; it is removed by whoever made it.
        plan: how much is tried.

    Returns:
        ``plan``, ``counts`` (one for each command and fault) and ``seconds``.

    Raises:
        RuntimeError: a command fails where nothing disturbs it.
    """
    _import_all()
    started = time.monotonic()
    make_world(folder)
    chosen = [job for job in jobs(folder) if not plan.commands or job.name in plan.commands]
    if any(job.name == "bench" for job in chosen):
        _make_bench(folder)
    total = plan.kills + plan.processes + plan.full + len(chosen) * (plan.command_kills + plan.full)
    rng, counts = random.Random(plan.seed), []
    tqdm.monitor_interval = 0  # its thread could hold a lock at the moment of a fork
    with progress_bar(total=total, unit="fault") as bar:
        for found in _counts(folder, plan, chosen, rng, bar):
            counts.append(found)
    spent = round(time.monotonic() - started, 1)
    return {"plan": asdict(plan), "counts": [asdict(c) for c in counts], "seconds": spent}


def _counts(
    folder: Path, plan: Plan, chosen: list[Job], rng: random.Random, bar: tqdm
) -> Iterator[Count]:
    yield kill_training(folder, plan.kills, rng, bar)
    if plan.processes:
        yield kill_processes(folder, plan.processes, rng, bar)
    yield fill_training(folder, plan.full, rng, bar)
    for job in chosen:
        out = folder / f"out-{job.name.replace(' ', '-')}"
        yield disturb(job, out, "SIGKILL", plan.command_kills, rng, bar)
        yield disturb(job, out, "full disk", plan.full, rng, bar)


def _import_all() -> None:
    """Imports once what every child needs; nothing may be computed here, see ``run_child``."""
    import timm  # noqa: F401
    import trimesh  # noqa: F401

    from ..eval.shapes import pairs  # noqa: F401
    from ..eval.views import evaluate  # noqa: F401
    from ..fitting import objects  # noqa: F401
    from ..measure import suites  # noqa: F401
    from ..model import predict, pretrained, released  # noqa: F401
    from ..pages import export, outputs  # noqa: F401
    from ..train import run  # noqa: F401
    from ..train.data import render  # noqa: F401


def _make_bench(folder: Path) -> None:
    words = ("conv", "--quick", "--device", "cpu", "--out", folder / "bench")
    _undisturbed(run_child(command("bench", *words)), "bench")
    shutil.copyfile(folder / "bench" / "bench.json", folder / "bench.json")


def _undisturbed(end: End, name: str) -> End:
    if end.code:
        raise RuntimeError(f"{name} fails though nothing disturbs it: {end.said[-2000:]}")
    return end


def _note(count: Count, what: str, end: End) -> None:
    lines = end.said.strip().splitlines() or [""]
    count.notes.append(f"{what}: code {end.code}, {lines[-1][-200:]}")


def kill_training(folder: Path, kills: int, rng: random.Random, bar: tqdm) -> Count:
    """Kills training again and again; each time it goes on, to the same bits in the end."""
    count, out = Count("train", "SIGKILL"), folder / "killed"
    steps = 12 if kills < 20 else 60
    quiet = _undisturbed(run_child(training(folder, folder / "quiet", steps)), "train")
    model = sha256(folder / "quiet" / _MODEL)
    saved = _checkpoint(folder / "quiet")
    newest = -1
    while count.runs < kills:
        end = run_child(training(folder, out, steps), rng.uniform(0, 0.7 * quiet.seconds))
        count.runs += 1
        count.hit += end.killed
        bar.update()
        if end.code == 0 or (count.runs == kills):
            if end.code:
                end = run_child(training(folder, out, steps))
            if end.code:
                count.not_resumed += 1
                _note(count, "train did not go on", end)
            elif sha256(out / _MODEL) != model or _checkpoint(out) != saved:
                count.lost += 1
                count.notes.append(f"train: after {count.runs} kills the weights differ")
            count.debris += len(leftovers(out))
            remove_folder(out)
            newest = -1
            continue
        if not end.killed:
            count.not_resumed += 1
            _note(count, "train did not go on", end)
        count.left += len(leftovers(out)) if out.exists() else 0
        found = _newest(out)
        if found < newest:
            count.lost += 1
            count.notes.append(f"train: step {newest} is gone, {found} is the newest")
        newest = found
    return count


def kill_processes(folder: Path, kills: int, rng: random.Random, bar: tqdm) -> Count:
    """Kills one of two training processes again and again; the end has one process's bits."""
    count, words = Count("train, 2 processes", "SIGKILL", kills, kills), training_words(folder)
    quiet, out, steps = folder / "quiet-2", folder / "killed-2", steps_for(kills)
    halves = ["--batch-size", 1, "--accumulate", 2, "--steps", steps, "--out", quiet]
    _undisturbed(run_child(command("train", *words, *halves)), "train")
    try:
        found = kill_one_of_two([*map(str, words), "--batch-size", "1"], out, kills, rng)
    except RuntimeError as error:
        count.not_resumed += 1
        count.notes.append(str(error))
        return count
    finally:
        bar.update(kills)
    count.untold += "Traceback" in found.said
    if found.steps != steps or sha256(out / _MODEL) != sha256(quiet / _MODEL):
        count.lost += 1
        count.notes.append("train, 2 processes: the weights differ from those of one")
    count.debris = len(leftovers(out))
    return count


def _newest(out: Path) -> int:
    """The step of the newest whole checkpoint; -1 where there is none."""
    from ..train.checkpoint import damage, list_checkpoints

    steps = [int(p.name.split("_")[1]) for p in list_checkpoints(out) if not damage(p)]
    return max(steps, default=-1)


def _checkpoint(out: Path) -> str:
    """The SHA-256 of the newest checkpoint's weights."""
    from ..train.checkpoint import list_checkpoints

    found = list_checkpoints(out)[-1]
    return sha256_of_all(found.glob("*.safetensors"), found)


def fill_training(folder: Path, times: int, rng: random.Random, bar: tqdm) -> Count:
    """Lets training meet a full disk at random bytes; its checkpoint stays, and it goes on."""
    count, out = Count("train", "full disk"), folder / "filled"
    steps = 4
    _undisturbed(run_child(training(folder, out, steps)), "train")
    largest = max(len(data) for data in contents(out).values())
    for _ in range(times):
        before, steps = _newest(out), steps + 4
        end = run_child(training(folder, out, steps), file_limit=rng.randrange(largest))
        count.runs += 1
        count.hit += end.code != 0
        bar.update()
        if end.code and not end.is_one_line:
            count.untold += 1
            _note(count, "train ended untold", end)
        if _newest(out) < before:
            count.lost += 1
        count.left += len(leftovers(out))
        again = run_child(training(folder, out, steps))
        if again.code:
            count.not_resumed += 1
            _note(count, "train did not go on", again)
    count.debris = len(leftovers(out))
    return count


def disturb(job: Job, out: Path, fault: str, times: int, rng: random.Random, bar: tqdm) -> Count:
    """Disturbs a command that writes over its own older results.

    Args:
        job: the command.
        out: its folder of results.
        fault: ``SIGKILL`` or ``full disk``.
        times: how often.
        rng: of the moments and bytes.
        bar: moves on with each.
    """
    count = Count(job.name, fault)
    first = run_child(job.function(out))
    if job.undo is not None and not first.code:  # what is done is not done again
        job.undo(out)
        first = run_child(job.function(out))
    if first.code:
        count.not_resumed += 1
        _note(count, f"{job.name} fails though nothing disturbs it", first)
        return count
    whole = contents(out)
    largest = max(len(data) for data in whole.values())
    for turn in range(times):
        if job.undo is not None:
            job.undo(out)
        before = contents(out)
        function = job.function(out, other=turn % 2 == 0)
        if fault == "SIGKILL":
            end = run_child(function, kill_after=rng.uniform(0.02, 1.1) * first.seconds)
            count.hit += end.killed
        else:
            end = run_child(function, file_limit=rng.randrange(1, largest))
            count.hit += end.code != 0
            if end.code and not end.is_one_line:
                count.untold += 1
                _note(count, f"{job.name} ended untold", end)
        count.runs += 1
        bar.update()
        gone = lost(before, contents(out))
        count.lost += len(gone)
        count.notes += [f"{job.name}: {name} is lost" for name in gone]
        count.left = len(leftovers(out))
    age(out)
    end = run_child(job.function(out))
    if end.code or contents(out).keys() != whole.keys():
        count.not_resumed += 1
        _note(count, f"{job.name} did not run again", end)
    count.debris = len(leftovers(out))
    return count
