"""The commands of a row, and the checks that nothing is wrong with any of them before one runs."""

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

# The command gives these to every row alike, or they would make rows see different samples.
RESERVED = ("data", "set", "preset", "out", "config", "resume", "init", "seed", "device")
RESERVED += ("threads", "tensorboard")
BUDGET = ("steps", "epochs", "minutes")
STRIPS = 4  # objects whose pictures are on the page
ROW = "ROW"  # stands for the row's folder in the commands that are kept


@dataclass(frozen=True)
class Settings:
    """A plan, and what is the same for every row of it.

    Attributes:
        plan: the plan.
        data: the dataset.
        out: folder of the ablation.
        evaluation: what every row is evaluated on.
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
        name: "train", "views", "shapes" or "fit"; its results lie in a folder.
        words: of the command, without ``gamba``; ``ROW`` stands for the row's folder.
        folder: name of the folder of the results, in that of the row.
        makes: the file in it that is there when the command has ended well.
    """

    def __init__(self, name: str, *words: object, makes: str = "report.json") -> None:
        self.name, self.folder = name, FOLDERS[name]
        self.words = [*map(str, words), "--out", f"{ROW}/{self.folder}"]
        self.makes = f"{self.folder}/{makes}"

    def words_in(self, folder: Path) -> list[str]:
        """The words with the row's folder in its place."""
        mark = f"{ROW}/"
        return [str(folder / w.removeprefix(mark)) if w.startswith(mark) else w for w in self.words]


FOLDERS = {"train": "run", "views": "views", "shapes": "shapes", "fit": "fit"}


def budget_of(plan: Plan, steps: int | None, minutes: float | None) -> tuple[str, float]:
    """The budget of every row: the command's, or else the plan's.

    Raises:
        UserError: there is none or more than one, or a row has one of its own.
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
    """The commands of a row, in their order.

    Raises:
        UserError: an option or a field of the row is wrong; names the row.
    """
    from gamba_warp.train.config import command_line

    what, distance = settings.evaluation, None
    alike = ["--seed", seed, "--device", settings.device]
    if row.kind == "fit":
        words: list[object] = ["fit", settings.data, "--split", what.split]
        for name, value in msgspec.to_builtins(fit_options(settings, row)).items():
            words += [] if value is None else [option(name), value]
        made = [Stage("fit", *words, *alike)]
    else:
        config = train_config(settings, row)
        distance = config.model_config().distance
        words = ["eval-views", "--checkpoint", f"{ROW}/run/model.safetensors"]
        words += ["--data", settings.data, "--split", what.split, "--limit", what.objects]
        words += ["--views", what.views, *(["--size", what.size] if what.size else [])]
        words += ["--strips", STRIPS, "--sheet", 0, "--no-baselines", "--device", settings.device]
        words += ["--save-gaussians"] if settings.meshes else []
        if row.background_margin is not None:
            words += ["--background-margin", row.background_margin]
        training = shlex.split(command_line(config.to_dict()))[1:] + [*alike, "--no-tensorboard"]
        made = [Stage("train", *training, makes="model.safetensors"), Stage("views", *words)]
    if settings.meshes:  # of all objects, or of some that ``run.choose`` copies
        count = what.geometry_objects
        folder = f"{made[-1].folder}/gaussians" if count is None else f"chosen-{count}"
        words = ["eval-geometry", f"{ROW}/{folder}", settings.meshes, "--frame", "reference"]
        words += ["--data", settings.data]
        if distance is not None and distance != DEFAULT_DISTANCE:
            words += ["--distance", distance]
        made.append(Stage("shapes", *words))
    return made


def fit_options(settings: Settings, row: Row) -> FitOptions:
    """The options of a row's fit. Raises UserError, which names the row."""
    try:
        return msgspec.convert(_merged(settings.plan.base.fit, row.options), FitOptions)
    except msgspec.ValidationError as error:
        raise UserError(f"row {row.name}: gamba fit: {error}") from error


def gaussians_of(settings: Settings, row: Row) -> int:
    """N, the number of Gaussians of a row (with the decoder "rays" the most there can be)."""
    if row.kind == "fit":
        return fit_options(settings, row).gaussians
    return train_config(settings, row).model_config().num_gaussians


def _merged(*groups: Values) -> Values:
    """Groups joined, the later ones first; null takes away; names with underscores."""
    both = {name.replace("-", "_"): value for group in groups for name, value in group.items()}
    return {name: value for name, value in both.items() if value is not None}


def train_config(settings: Settings, row: Row) -> TrainConfig:
    """The options of a row's training: on what, with which model, how and how long.

    Raises:
        UserError: one of them is unknown, or its value is wrong; names the row.
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
            raise UserError(f"{source}: options: {name} is not for a plan to give")
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, str) and (item.startswith("-") or not item.isprintable()):
                raise UserError(f"{source}: {name}: {item!r} is no value of an option")
        values.setdefault(of.get(name, "run"), {})[name] = value
    return config_of(values, source)


def check(settings: Settings) -> None:
    """Checks the commands of every row of the plan.

    Raises:
        UserError: names the first row that is wrong, and what of it.
    """
    plan = settings.plan
    for row in plan.rows:
        stages(settings, row, plan.seeds_of(row)[0])
    for name in {row.series for row in plan.rows} - {None}:
        numbers = [gaussians_of(settings, row) for row in plan.rows if row.series == name]
        if len({*numbers}) != len(numbers):
            raise UserError(f"series {name}: two of its rows have the same number of Gaussians")


def difference(old: dict[str, list[str]], new: dict[str, list[str]]) -> str | None:
    """The first option that is another in the commands of a row; None where there is none."""
    if old == new:
        return None
    there, here = (
        [f"{words[0]} {part}" for words in of.values() for part in _options(words[1:])]
        for of in (old, new)
    )
    gone, come = [p for p in there if p not in here], [p for p in here if p not in there]
    return f"{next(iter(gone), 'nothing')} then, {next(iter(come), 'nothing')} now"


def _options(words: Sequence[str]) -> list[str]:
    """The words of a command, each option with its values."""
    return re.split(" (?=--)", shlex.join(words))
