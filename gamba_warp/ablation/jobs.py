"""Commands of a row, and their checks before any of them runs."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ..conventions import DEFAULT_DISTANCE, DeviceChoice
from ..errors import UserError
from ..untrusted.ranges import option
from .plan import Evaluation, FitOptions, Plan, Row, Values

if TYPE_CHECKING:
    from gamba_warp.train.config import TrainConfig

# Set by the command for all rows, or they would give rows different samples.
RESERVED = ("data", "set", "preset", "out", "config", "resume", "init", "seed", "device")
RESERVED += ("threads", "tensorboard")
BUDGET = ("steps", "epochs", "minutes")
STRIPS = 4  # objects whose pictures are on the page
ROW = "ROW"  # placeholder of the row's folder in recorded commands


@dataclass(frozen=True)
class Settings:
    """A plan, and the settings shared by all rows.

    Attributes:
        plan: the plan.
        data: the dataset.
        out: folder of the ablation.
        evaluation: objects and views of the evaluation.
        budget: option ``steps`` or ``minutes``, and its value.
        meshes: folder of the true meshes, or None: no shapes are evaluated.
        device: of all commands that have the option.
    """

    plan: Plan
    data: Path
    out: Path
    evaluation: Evaluation
    budget: tuple[str, float]
    meshes: Path | None
    device: DeviceChoice


class Stage:
    """One command of a row.

    Attributes:
        name: "train", "views", "shapes" or "fit".
        words: of the command, without ``gamba``, with ``ROW`` for the row's folder.
        folder: name of the folder of its results, in that of the row.
        makes: a file in it that exists once the command has succeeded.
    """

    def __init__(self, name: str, *words: object, makes: str = "report.json") -> None:
        self.name, self.folder = name, FOLDERS[name]
        self.words = [*map(str, words), "--out", f"{ROW}/{self.folder}"]
        self.makes = f"{self.folder}/{makes}"

    def words_in(self, folder: Path) -> list[str]:
        """Return the words with the row's folder filled in."""
        mark = f"{ROW}/"
        return [str(folder / w.removeprefix(mark)) if w.startswith(mark) else w for w in self.words]


FOLDERS = {"train": "run", "views": "views", "shapes": "shapes", "fit": "fit"}


def budget_of(plan: Plan, steps: int | None, minutes: float | None) -> tuple[str, float]:
    """Return the budget of every row: the command's, or else the plan's.

    Raises:
        UserError: it is missing or ambiguous, or a row sets its own.
    """
    for row in plan.rows:
        own = [name for name in _merged(row.options) if name in BUDGET and row.kind == "train"]
        if own:
            raise UserError(f"row {row.name}: {own[0]}: the budget is the same for every row")
    given: dict[str, Any] = {"steps": steps, "minutes": minutes}
    given = {name: value for name, value in given.items() if value is not None}
    given = given or {n: v for n, v in _merged(plan.base.options).items() if n in BUDGET}
    if len(given) != 1 or "epochs" in given:
        raise UserError("the budget of a row: expected steps or minutes, once")
    name, value = next(iter(given.items()))
    if type(value) not in (int, float):
        raise UserError(f"base: {name} is {str(value)[:80]}, not a number")
    return name, value


def stages(settings: Settings, row: Row, seed: int) -> list[Stage]:
    """Return the commands of a row, in order.

    Raises:
        UserError: an option or a field of the row is invalid; names the row.
    """
    from gamba_warp.train.config import command_line

    evaluation, distance = settings.evaluation, None
    shared = ["--seed", seed, "--device", settings.device]
    if row.kind == "fit":
        words: list[object] = ["fit", settings.data, "--split", evaluation.split]
        for name, value in msgspec.to_builtins(fit_options(settings, row)).items():
            words += [] if value is None else [option(name), value]
        made = [Stage("fit", *words, *shared)]
    else:
        config = train_config(settings, row)
        distance = config.model_config().distance
        words = ["eval-views", "--checkpoint", f"{ROW}/run/model.safetensors"]
        words += ["--data", settings.data, "--split", evaluation.split]
        words += ["--limit", evaluation.objects, "--views", evaluation.views]
        words += ["--size", evaluation.size] if evaluation.size else []
        words += ["--strips", STRIPS, "--sheet", 0, "--no-baselines", "--device", settings.device]
        words += ["--save-gaussians"] if settings.meshes else []
        if row.background_margin is not None:
            words += ["--background-margin", row.background_margin]
        training = shlex.split(command_line(config.to_dict()))[1:] + [*shared, "--no-tensorboard"]
        made = [Stage("train", *training, makes="model.safetensors"), Stage("views", *words)]
    if settings.meshes:  # of all objects, or of those that ``run.choose`` copies
        count = evaluation.geometry_objects
        folder = f"{made[-1].folder}/gaussians" if count is None else f"chosen-{count}"
        words = ["eval-geometry", f"{ROW}/{folder}", settings.meshes, "--frame", "reference"]
        words += ["--data", settings.data]
        if distance is not None and distance != DEFAULT_DISTANCE:
            words += ["--distance", distance]
        made.append(Stage("shapes", *words))
    return made


def fit_options(settings: Settings, row: Row) -> FitOptions:
    """Return the options of a row's fit. Raises UserError, which names the row."""
    try:
        return msgspec.convert(_merged(settings.plan.base.fit, row.options), FitOptions)
    except msgspec.ValidationError as error:
        raise UserError(f"row {row.name}: gamba fit: {error}") from error


def gaussians_of(settings: Settings, row: Row) -> int:
    """Return N, the number of Gaussians of a row (the maximum for the decoder "rays")."""
    if row.kind == "fit":
        return fit_options(settings, row).gaussians
    return train_config(settings, row).model_config().num_gaussians


def _merged(*groups: Values) -> Values:
    """Merge groups of values; later ones win, null removes; names get underscores."""
    both = {name.replace("-", "_"): value for group in groups for name, value in group.items()}
    return {name: value for name, value in both.items() if value is not None}


def train_config(settings: Settings, row: Row) -> TrainConfig:
    """Return the options of a row's training.

    Raises:
        UserError: an option is unknown, or its value is invalid; names the row.
    """
    from gamba_warp.train.config import GROUPS, config_of

    base, source = settings.plan.base, f"row {row.name}"
    of = {f.name: group for group, kind in GROUPS.items() for f in fields(kind) if group != "model"}
    changes = _merged(base.set, row.set)
    for name in changes.keys() - {field.name for field in fields(GROUPS["model"])}:
        raise UserError(f"{source}: set: GambaConfig has no field {name}")
    values: dict[str, Any] = {
        "data": str(settings.data),
        "preset": base.preset,
        "set": [f"{n}={v if isinstance(v, str) else json.dumps(v)}" for n, v in changes.items()],
    }
    options = {n: v for n, v in _merged(base.options, row.options).items() if n not in BUDGET}
    for name, value in {**options, settings.budget[0]: settings.budget[1]}.items():
        if name in RESERVED:
            raise UserError(f"{source}: options: {name} cannot be set by a plan")
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, str) and (item.startswith("-") or not item.isprintable()):
                raise UserError(f"{source}: {name}: {item!r} is not a valid value of an option")
        values.setdefault(of.get(name, "run"), {})[name] = value
    return config_of(values, source)


def check(settings: Settings) -> None:
    """Check the commands of every row of the plan.

    Raises:
        UserError: names the first invalid row, and its fault.
    """
    plan = settings.plan
    for row in plan.rows:
        stages(settings, row, plan.seeds_of(row)[0])
    for name in {row.series for row in plan.rows} - {None}:
        numbers = [gaussians_of(settings, row) for row in plan.rows if row.series == name]
        if len({*numbers}) != len(numbers):
            raise UserError(f"series {name}: two of its rows have the same number of Gaussians")


def difference(old: dict[str, list[str]], new: dict[str, list[str]]) -> str | None:
    """Return the first option that differs between two sets of commands; None if they are equal."""
    if old == new:
        return None
    before, after = (
        [f"{words[0]} {part}" for words in of.values() for part in _options(words[1:])]
        for of in (old, new)
    )
    removed = [part for part in before if part not in after]
    added = [part for part in after if part not in before]
    return f"{next(iter(removed), 'nothing')} then, {next(iter(added), 'nothing')} now"


def _options(words: Sequence[str]) -> list[str]:
    """Split the words of a command into options with their values."""
    return re.split(" (?=--)", shlex.join(words))
