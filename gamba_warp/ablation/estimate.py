"""What an ablation will run, and about how long that takes, without running it."""

from __future__ import annotations

import shlex

from .figures import read_log, step_seconds
from .jobs import Settings, fit_options, train_config
from .plan import Row
from .tasks import Task

# Seconds on one core of a desktop of about 2020, one row alone. They are fits by eye to a few runs,
# and a machine, an encoder or LPIPS in the loss may differ by a factor of three.
_STEP, _TOKEN, _PIXEL = 0.05, 1.2e-7, 8e-7
_VIEW, _SHAPE, _FIT, _START = 1.3, 9.0, 4e-6, 15.0
_GAIN = 0.7  # n threads are n^0.7 times as fast as one


def row_minutes(settings: Settings, row: Row, threads: int, known: float | None) -> float:
    """About how long a row takes with one seed, minutes.

    Args:
        settings: the plan, and what is the same for every row.
        row: of the plan.
        threads: of each command.
        known: seconds of a step of this row, where it ran before; None: by its size.
    """
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
