"""``gamba ablate``: training and evaluation of the rows of a plan, and their table.

Slow imports are inside functions, so that ``--help`` is quick.
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
from ..versions import SHAPES, require

if TYPE_CHECKING:
    from .jobs import Settings
    from .plan import Row
    from .tasks import Task

_Count = Annotated[int, Meta(ge=1, le=1_000_000)]


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
    """Train and evaluate the rows of a plan with the same data, seeds and budget; write one table.

    Writes table.json, table.md and index.html. Every row is a few commands, each in its own
    process, so a failed row stops no other. After Ctrl-C the same command resumes and skips
    finished work. Exit code 1 if a row failed.

    Args:
        plan: Name of a shipped plan (paper-table2, questions, ours), or a JSON file.
        data: Dataset of posed views.
        out: Folder of the results; by default out/ablation/NAME of the plan.
        rows: Only these rows; all by default.
        seeds: Seeds of every row, in place of the plan's.
        steps: Training steps of every row, in place of the plan's budget.
        minutes: Training time of every row, in place of the plan's budget.
        split: Part of the dataset that rows are evaluated on.
        objects: Number of its objects, evenly spaced in the order of names.
        views: Views per object, including the input, evenly spaced.
        size: Height of the pictures compared, pixels; by default the plan's, or the files' own.
        meshes: Folder of the meshes that DATA was rendered from: also evaluate shapes.
        geometry_objects: Number of objects whose shapes are evaluated; all by default.
        jobs: Rows that run at once.
        threads: CPU threads of each row; by default the cores are shared among the jobs.
        device: Device of every command; auto is the GPU if there is one.
        restart: Run commands again whose options changed; their former results are deleted.
        retry: Run failed rows again.
        dry_run: Only print the commands.
    """
    options = dict(locals())
    import sys

    from msgspec.structs import replace
    from tqdm import tqdm

    from ..batch import check_not_read, progress_bar, say
    from ..files import only_process, output_folder, write_options
    from ..kernels.runtime.system import cores
    from ..untrusted.children import Failed, end_idle, run_each
    from .jobs import Settings, budget_of, check
    from .plan import named, open_plan, save_plan
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
        raise UserError("--seeds: a seed is repeated")
    # In a child, because the memory of a process counts for the commands that it starts: this
    # process must not load torch.
    for _, answer in run_each(open_inputs, [(settings, wanted)]):
        if isinstance(answer, Failed):
            raise UserError(answer.reason)
    end_idle()
    if meshes is not None:
        require(*SHAPES)
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
                    "(changed commands run again) or another --out"
                )
            if task.record.status == "failed" and retry:
                task.record.status = "begun"
        return found

    if dry_run:
        print_plan(find_tasks())
        return 0
    check_not_read([settings.out / "table.json"], [settings.data, settings.meshes])
    out = output_folder(settings.out)
    with only_process(out, "runs an ablation"):
        save_plan(chosen, out)
        write_options(out, options)
        tasks = find_tasks()
        for task in tasks:
            if task.changed:
                task.restart()
        todo = [task for task in tasks if task.record.status == "begun"]
        for task in tasks:
            if task not in todo:
                print(f"{row_line(task)} (before)", flush=True)
        tqdm.monitor_interval = 0  # its thread could hold a lock during a fork
        with progress_bar(total=len(tasks), initial=len(tasks) - len(todo), unit="run") as bar:

            def on_end(task: Task) -> None:
                say(row_line(task))
                sys.stdout.flush()
                bar.update()

            code = run_tasks(todo, jobs, threads, on_end)
        if code:
            print("stopped; the same command resumes from here")
            return code
        from .page import write_results  # loads torch

        bad = write_results(settings)
        print(f"wrote {out / 'table.md'}, table.json and index.html")
        return 1 if bad or any(task.record.status != "ok" for task in tasks) else 0


def open_inputs(given: tuple[Settings, list[Row]]) -> None:
    """Open the inputs of an ablation's commands.

    Args:
        given: settings shared by all rows, and the rows.

    Raises:
        UserError: an input is missing.
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


def print_plan(tasks: list[Task]) -> None:
    """Print the commands of every row."""
    for name in dict.fromkeys(task.row.name for task in tasks):
        seeds = [task for task in tasks if task.row.name == name]
        print(f"{name}: {seeds[0].row.label}")
        for task in seeds:
            done = task.record.status != "begun" and not task.changed
            print(f"  {task.name}{f' ({task.record.status} before)' if done else ''}")
            for stage in task.stages:
                print(f"    gamba {shlex.join(stage.words_in(task.folder))}")
    print(f"{len(tasks)} runs")
