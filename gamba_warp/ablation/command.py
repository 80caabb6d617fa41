"""``gamba ablate``: rows of a plan, trained and evaluated alike, and their table.

``--help`` answers at once, so what is slow to import is imported by the functions.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from msgspec import Meta

from ..conventions import DeviceChoice
from ..errors import UserError
from ..untrusted.ranges import Minutes, Seed, Threads, ranged
from ..versions import NEEDS, require

if TYPE_CHECKING:
    from .jobs import Settings
    from .plan import Plan, Row
    from .run import Task

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
    from ..kernels.runtime.system import cores
    from .jobs import budget_of, check
    from .plan import named, open_plan

    chosen = open_plan(plan)
    if steps is not None and minutes is not None:
        raise UserError("--steps and --minutes: give one of them")
    changes: dict[str, Any] = {"split": split, "objects": objects, "views": views, "size": size}
    changes["geometry_objects"] = geometry_objects
    with named(plan):
        budget = budget_of(chosen, steps, minutes)
        settings = _settings(chosen, data, out, budget, meshes, device, changes)
        check(chosen, settings, chosen.rows)
    wanted = [chosen.row(name) for name in dict.fromkeys(rows)] or chosen.rows
    if len({*seeds}) != len(seeds):
        raise UserError("--seeds: one is there twice")
    _check_inputs(chosen, settings, wanted)
    if threads is None:
        threads = max(1, cores() // jobs)
    if meshes is not None:
        require(*NEEDS["eval-geometry"])
    if dry_run:
        from .estimate import print_plan

        tasks = _tasks(chosen, settings, wanted, seeds, restart, retry)
        by_row = {row.name: [t for t in tasks if t.record.row == row.name] for row in wanted}
        print_plan(chosen, settings, by_row, jobs, threads)
        return 0
    return _run(chosen, settings, wanted, seeds, (jobs, threads), restart, retry)


def _settings(
    plan: Plan,
    data: Path,
    out: Path | None,
    budget: tuple[str, float],
    meshes: Path | None,
    device: DeviceChoice,
    changes: dict[str, Any],
) -> Settings:
    import msgspec

    from .jobs import Settings

    evaluation = msgspec.structs.replace(
        plan.evaluation, **{name: value for name, value in changes.items() if value is not None}
    )
    folder = Path("out/ablation") / plan.name if out is None else out
    true = None if meshes is None else meshes.resolve()
    return Settings(data.resolve(), folder, evaluation, budget, true, device)


def _check_inputs(plan: Plan, settings: Settings, rows: list[Row]) -> None:
    """Checks what the commands will read, in a child: see ``run.open_inputs``."""
    from ..untrusted.children import Failed, end_idle, run_each
    from .jobs import train_config
    from .run import open_inputs

    weights = []
    for row in rows:
        config = train_config(plan, row, settings) if row.kind == "train" else None
        model = config and config.model_config()
        if model and (model.encoder == "vgg16" and model.prepend):
            weights.append(row.name)
        elif config and config.loss.lpips == "on":
            weights.append(row.name)
    for _, answer in run_each(open_inputs, [(settings, weights)]):
        if isinstance(answer, Failed):
            raise UserError(answer.reason)
    end_idle()


def _tasks(
    plan: Plan,
    settings: Settings,
    rows: list[Row],
    seeds: tuple[int, ...],
    restart: bool,
    retry: bool,
    clean: bool = False,
) -> list[Task]:
    """The wanted rows with their seeds, and what of each is done.

    Seeds are the outer loop: all rows have one seed before one has two.

    Args:
        plan: the plan.
        settings: what is the same for every row.
        rows: those wanted.
        seeds: in place of the plan's; none for those.
        restart: whether commands that are others now are done anew.
        retry: whether rows that failed are run again.
        clean: whether what is done anew is removed here.

    Raises:
        UserError: a row was run with other commands, and not ``restart``.
    """
    from .jobs import stages
    from .record import begin_anew, changed, new_record, read_record, row_folder
    from .run import Task

    found = []
    for row in rows:
        for rank, seed in enumerate(seeds or plan.seeds_of(row)):
            made = stages(plan, row, seed, settings)
            folder, record = row_folder(settings.out, row.name, seed), None
            record = read_record(folder)
            wanted = new_record(row.name, seed, made)
            name = f"{row.name}, seed {seed}"
            if record is not None and (other := changed(record, wanted)):
                if not restart:
                    raise UserError(
                        f"row {name}: was run with another plan: {other}; give --restart (what is "
                        "another now is done anew) or another --out"
                    )
                record = begin_anew(folder, record, wanted) if clean else wanted
            if record is not None and record.status == "failed" and retry:
                record.status, record.reason = "begun", ""
            task = Task(name, folder, made, record or wanted, settings.evaluation.geometry_objects)
            found.append((rank, task))
    return [task for _, task in sorted(found, key=lambda pair: pair[0])]


def _run(
    plan: Plan,
    settings: Settings,
    rows: list[Row],
    seeds: tuple[int, ...],
    how: tuple[int, int],
    restart: bool,
    retry: bool,
) -> int:
    """Runs what is not done, and writes the results."""
    import sys

    from tqdm import tqdm

    from ..batch import check_not_read, progress_bar
    from ..files import only_process, output_folder
    from .plan import keep_plan
    from .run import row_line, run_tasks

    check_not_read([settings.out / "table.json"], [settings.data, settings.meshes])
    out = output_folder(settings.out)
    with only_process(out, "runs an ablation"):
        keep_plan(plan, out)
        tasks = _tasks(plan, settings, rows, seeds, restart, retry, clean=True)
        todo = [task for task in tasks if task.record.status == "begun"]
        for task in tasks:
            if task not in todo:
                print(f"{row_line(plan, task)} (before)", flush=True)
        tqdm.monitor_interval = 0  # its thread could hold a lock at the moment of a fork
        begun = len(tasks) - len(todo)
        with progress_bar(total=len(tasks), initial=begun, unit="run") as bar:

            def ended(task: Task) -> None:
                tqdm.write(row_line(plan, task), sys.stdout)
                sys.stdout.flush()
                bar.update()

            code = run_tasks(todo, *how, ended)
        if code:
            print("stopped; the same command goes on from here")
            return code
        from .write import write_results  # not before: see ``run.open_inputs``

        bad = write_results(plan, settings, out)
        print(f"wrote {out / 'table.md'}, table.json and index.html")
        unfinished = [task for task in tasks if task.record.status != "ok"]
        return 1 if bad or unfinished else 0
