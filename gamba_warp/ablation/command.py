"""``gamba ablate``: rows of a plan, trained and evaluated alike, and their table.

``--help`` answers at once, so what is slow to import is imported by the functions.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from msgspec import Meta

from ..conventions import DeviceChoice
from ..errors import UserError
from ..untrusted.ranges import Minutes, Seed, Threads, ranged
from ..versions import NEEDS, require

if TYPE_CHECKING:
    from .jobs import Settings
    from .plan import Row
    from .tasks import Task

_Count = Annotated[int, Meta(ge=1, le=1_000_000)]
# Seconds on one core of a desktop of about 2020, one row alone. They are fits by eye to a few runs,
# and a machine, an encoder or LPIPS in the loss may differ by a factor of three.
_STEP, _TOKEN, _PIXEL = 0.05, 1.2e-7, 8e-7
_VIEW, _SHAPE, _FIT, _START = 1.3, 9.0, 4e-6, 15.0
_GAIN = 0.7  # n threads are n^0.7 times as fast as one


@ranged
def ablate_command(
    plan: tyro.conf.Positional[str],
    data: tyro.conf.Positional[Path],
    out: Path | None = None,
    rows: tuple[str, ...] = (),
    seeds: tuple[Seed, ...] = (),
    steps: Annotated[int, Meta(ge=1, le=10**12)] | None = None,
    minutes: Minutes | None = None,
    split: Literal["val", "test"] | None = None,
    objects: _Count | None = None,
    views: Annotated[int, Meta(ge=2, le=100_000)] | None = None,
    size: Annotated[int, Meta(ge=16, le=4096)] | None = None,
    meshes: Path | None = None,
    geometry_objects: _Count | None = None,
    jobs: Annotated[int, Meta(ge=1, le=256)] = 1,
    threads: Threads | None = None,
    device: DeviceChoice = "auto",
    restart: bool = False,
    retry: bool = False,
    dry_run: bool = False,
) -> int:
    """Trains and evaluates the rows of a plan alike: same data, seeds and budget, one table.

    Writes table.json, table.md and index.html. Every row is a few commands, each a process of its
    own, so one that fails stops no other. Ctrl-C stops; the same command goes on, and what is done
    is not done again. Exit code 1 where a row failed.

    Args:
        plan: Name of a shipped plan (paper-table2, questions, ours), or a JSON file.
        data: Dataset of posed views.
        out: Folder of the results; out/ablation/NAME of the plan if not given.
        rows: Only these rows; all if not given.
        seeds: Seeds of every row, in place of the plan's.
        steps: Training steps of every row, in place of the plan's budget.
        minutes: Training time of every row, in place of the plan's budget.
        split: Part of the dataset that rows are evaluated on.
        objects: So many of its objects, evenly spaced in the order of names.
        views: Views of an object, the input included, evenly spaced.
        size: Height of the pictures compared, pixels; if not given, the plan's, or the files' own.
        meshes: Folder of the meshes that DATA was rendered from: also evaluate shapes.
        geometry_objects: So many of the objects have their shapes evaluated; all by default.
        jobs: Rows that run at once.
        threads: CPU threads of each; the cores shared among the jobs by default.
        device: Device of every command; auto is the GPU if there is one.
        restart: Do commands anew whose options are others now; what they made before goes.
        retry: Run rows again that failed.
        dry_run: Print the commands and about how long they take, and do nothing.
    """
    import sys

    from msgspec.structs import replace
    from tqdm import tqdm

    from ..batch import check_not_read, progress_bar
    from ..files import only_process, output_folder
    from ..kernels.runtime.system import cores
    from ..untrusted.children import Failed, end_idle, run_each
    from .jobs import Settings, budget_of, check
    from .plan import keep_plan, named, open_plan
    from .run import row_line, run_tasks
    from .tasks import task_of

    chosen = open_plan(plan)
    if steps is not None and minutes is not None:
        raise UserError("--steps and --minutes: give one of them")
    changes = {"split": split, "objects": objects, "views": views, "size": size}
    changes["geometry_objects"] = geometry_objects
    evaluation = replace(
        chosen.evaluation, **{name: value for name, value in changes.items() if value is not None}
    )
    folder = Path("out/ablation") / chosen.name if out is None else out
    true = None if meshes is None else meshes.resolve()
    with named(plan):
        budget = budget_of(chosen, steps, minutes)
        settings = Settings(chosen, data.resolve(), folder, evaluation, budget, true, device)
        check(settings)
    wanted = [chosen.row(name) for name in dict.fromkeys(rows)] or chosen.rows
    if len({*seeds}) != len(seeds):
        raise UserError("--seeds: one is there twice")
    # In a child: what a process held before it became a command counts as that command's memory, so
    # the one that starts commands must not load torch.
    for _, answer in run_each(open_inputs, [(settings, wanted)]):
        if isinstance(answer, Failed):
            raise UserError(answer.reason)
    end_idle()
    if meshes is not None:
        require(*NEEDS["eval-geometry"])
    threads = threads or max(1, cores() // jobs)

    def find_tasks() -> list[Task]:
        pairs = [
            p for row in wanted for p in enumerate((row, n) for n in seeds or chosen.seeds_of(row))
        ]
        # All rows have one seed before one has two.
        found = [task_of(settings, *pair) for _, pair in sorted(pairs, key=lambda pair: pair[0])]
        for task in found:
            if task.changed and not restart:
                raise UserError(
                    f"row {task.name}: was run with another plan: {task.changed}; give --restart "
                    "(what is another now is done anew) or another --out"
                )
            if task.record.status == "failed" and retry:
                task.record.status = "begun"
        return found

    if dry_run:
        print_plan(settings, find_tasks(), jobs, threads)
        return 0
    check_not_read([settings.out / "table.json"], [settings.data, settings.meshes])
    out = output_folder(settings.out)
    with only_process(out, "runs an ablation"):
        keep_plan(chosen, out)
        tasks = find_tasks()
        for task in tasks:
            if task.changed:
                task.begin_anew()
        todo = [task for task in tasks if task.record.status == "begun"]
        for task in tasks:
            if task not in todo:
                print(f"{row_line(task)} (before)", flush=True)
        tqdm.monitor_interval = 0  # its thread could hold a lock at the moment of a fork
        with progress_bar(total=len(tasks), initial=len(tasks) - len(todo), unit="run") as bar:

            def ended(task: Task) -> None:
                tqdm.write(row_line(task), sys.stdout)
                sys.stdout.flush()
                bar.update()

            code = run_tasks(todo, jobs, threads, ended)
        if code:
            print("stopped; the same command goes on from here")
            return code
        from .page import write_results  # not before: it loads torch

        bad = write_results(settings)
        print(f"wrote {out / 'table.md'}, table.json and index.html")
        return 1 if bad or any(task.record.status != "ok" for task in tasks) else 0


def open_inputs(given: tuple[Settings, list[Row]]) -> None:
    """Opens what the commands of an ablation will read.

    Args:
        given: what is the same for every row, and the rows.

    Raises:
        UserError: something is not there.
    """
    from ..data.dataset import open_dataset
    from ..devices import pick_device
    from ..vision.weights import FETCH, lpips_available
    from .jobs import train_config

    settings, rows = given
    pick_device(settings.device)
    for split in ("train", settings.evaluation.split):
        if not open_dataset(settings.data, split).uids:
            raise UserError(f"{settings.data}: its part {split} has no objects")
    if settings.meshes is not None and not settings.meshes.is_dir():
        raise UserError(f"--meshes {settings.meshes}: no such folder")
    for row in (row for row in rows if row.kind == "train"):
        config = train_config(settings, row)
        model = config.model_config()
        if config.loss.lpips == "on" or (model.encoder == "vgg16" and model.prepend):
            if not lpips_available():
                reason = f"needs the weights of VGG16; fetch them with: {FETCH}"
                raise UserError(f"row {row.name}: {reason}")


def row_minutes(settings: Settings, row: Row, threads: int, known: float | None) -> float:
    """About how long a row takes with one seed, minutes.

    Args:
        settings: the plan, and what is the same for every row.
        row: of the plan.
        threads: of each command.
        known: seconds of a step of this row, where it ran before; None: by its size.
    """
    from .jobs import fit_options, train_config

    faster, what = threads**_GAIN, settings.evaluation
    shapes = 0.0
    if row.kind == "fit":
        fit = fit_options(settings, row)
        step = known or (_STEP + _FIT * fit.gaussians) / faster
        objects, spent = fit.limit, step * fit.steps * fit.limit
    else:
        config = train_config(settings, row)
        model, name = config.model_config(), settings.budget[0]
        views = config.views.views_per_object
        views = 1 + (config.views.views_last if views is None else views)
        batch = (config.views.batch_size or 8) * config.views.accumulate
        work = _TOKEN * model.num_tokens * model.depth * model.width
        step = _STEP + batch * (work + _PIXEL * views * config.views.size**2)
        step = known or step / faster
        spent = settings.budget[1] * (60 if name == "minutes" else step)
        objects = what.objects
        spent += objects * what.views * _VIEW / faster
    if settings.meshes is not None:
        shapes = min(objects, what.geometry_objects or objects) * _SHAPE
    return (spent + shapes + _START) / 60


def print_plan(settings: Settings, tasks: list[Task], jobs: int, threads: int) -> None:
    """Prints the commands of every row and an estimate of the time.

    Args:
        settings: the plan, and what is the same for every row.
        tasks: rows with their seeds.
        jobs: rows at once.
        threads: of each command.
    """
    from .figures import read_log, step_seconds

    total = 0.0
    for name in dict.fromkeys(task.row.name for task in tasks):
        seeds = [task for task in tasks if task.row.name == name]
        steps = [step_seconds(read_log(task.folder / "run" / "log.jsonl")) for task in seeds]
        known = next((step for step in steps if step is not None), None)
        minutes = row_minutes(settings, seeds[0].row, threads, known)
        print(f"{name}: {seeds[0].row.label}, about {minutes:.1f} minutes a seed")
        for task in seeds:
            done = task.record.status != "begun" and not task.changed
            total += 0 if done else minutes
            print(f"  {task.name}{f' ({task.record.status} before)' if done else ''}")
            for stage in task.stages:
                print(f"    gamba {shlex.join(stage.words_in(task.folder))}")
    print(
        f"{len(tasks)} runs, {jobs} at once with {threads} threads each: roughly "
        f"{total / jobs / 60:.1f} hours of what is not done (within a factor of three)"
    )
